"""Noise: how much of what is put into labeled clouds is found, and how many good points are marked.

python benchmarks/noise.py --data FOLDER
python benchmarks/noise.py --data FOLDER --classify
python benchmarks/noise.py --data FOLDER --terrain
python benchmarks/noise.py --data FOLDER --surveys
python benchmarks/noise.py --data FOLDER --thinned
python benchmarks/noise.py --data FOLDER --canopies
python benchmarks/noise.py --places

Noise as the field knows it is put into each cloud: points and clusters of 2 to 30 within a meter,
half of them 1 to 30 m below the ground (the lowest of what is labeled ground, and of all points,
near by), half 3 to 300 m above the highest point near by. `good` are labeled points other than
noise; speed is in points per CPU second of one thread. With --classify and --terrain, clusters of
all sizes are put below the ground: what the shipped model then calls right of the labeled points,
and how far off the ground filter's heights are, with noise marked first and without. With --surveys, copies of the 29 training surveys with ten kinds of
noise at once (:func:`kinds_of_noise`): how much of each is found, in all and of what is more than
5 m from every good point, and how many good points are marked, by this stage, by PDAL's
filters.outlier (statistical, 8 neighbors, multiplier 3) and by counts in voxels of 1 m (lasR's ivf:
at most 6 points in 27 voxels). With --thinned, how
many good points of the 29 surveys are marked as flown and thinned, and how many of the power line's
wires. With --canopies, real woods that lose ground until hardly any is left: how much of the rest is
marked. With --places, generated land that holds no noise: how much of its ground is marked.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

import laspy
import numpy as np
from scipy.spatial import cKDTree
from woods import closed_wood

sys.path.insert(0, str(Path(__file__).resolve().parent / "surveys"))
from clouds import published
from surveys import SURVEYS

from pdal_stages import detached_noise, filtered_ground
from pdal_stages.base.hashing import hash_rows
from pdal_stages.cli import main as command

CLOUDS = (
    "montpellier/train_77050_627755.laz", "montpellier/train_77055_627755.laz", "delft/train.laz", "seville/plazanueva.laz",
    "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz", "rural/lidarhd_bank.laz", "rural/ahn3_achterhoek.laz",
    "rural/ahn4_powerline.laz", "forest/neon_osbs.laz", "rural/ign_0p3ppm2.laz", "bridge/ign_0299_6802.laz",
)  # fmt: skip
#: What the ground filter is tried on.
UNDER = (
    "montpellier/train_77055_627755.laz", "seville/plazanueva.laz", "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz",
    "rural/lidarhd_bank.laz", "forest/neon_osbs.laz", "rural/ign_0p3ppm2.laz", "delft/train.laz",
)  # fmt: skip
#: What is classified: a dense town, a bank, a town with noise of its own, a hamlet, a farm, an old
#: town with canals.
CLASSIFIED = (
    "montpellier/train_77055_627755.laz", "rural/lidarhd_bank.laz", "seville/plazanueva.laz",
    "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz", "delft/train.laz",
)  # fmt: skip
#: Labels of points that are what they are called.
GOOD = (2, 3, 4, 5, 6, 9, 12, 14, 15, 17)
SHARES = (0.0001, 0.001, 0.01)
#: Points per m2 that surveys are thinned to.
THINNED = (4, 1, 0.3, 0.1, 0.04)
#: Clusters below the ground: points, meters across, meters below; one and five per hectare by
#: turns.
CLUSTERS = (
    (1, 0.5, 3), (1, 0.5, 30), (2, 2, 60), (10, 0.5, 3), (10, 2, 10), (30, 4, 22), (30, 10, 60), (100, 5, 10), (128, 7, 22),
    (100, 10, 40), (300, 2, 5), (300, 10, 60), (1000, 2, 3), (1000, 10, 30), (1000, 10, 3),
)  # fmt: skip


def injected(
    xyz: np.ndarray, codes: np.ndarray, share: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Noise of that share of a cloud's points: coordinates, and 7 or 18."""
    rng = np.random.default_rng(seed)
    ground = xyz[codes == 2]
    nearest, cloud_tree = cKDTree(ground[:, :2]), cKDTree(xyz[:, :2])
    parts, kinds = [], []
    while sum(map(len, parts)) < max(share * len(xyz), 1):
        size = 1 if rng.random() < 0.5 else rng.integers(2, 31)
        at = xyz[rng.integers(len(xyz)), :2] + rng.uniform(-1, 1, 2)
        near = xyz[cloud_tree.query_ball_point(at, 2.0), 2]
        part = rng.normal(0, 0.4, (size, 3)) * (size > 1)
        if low := rng.random() < 0.5:
            level = ground[nearest.query(at, 3)[1], 2].min()
            top = min([level, *near]) - rng.uniform(1, 30)
            part += [*at, top - part[:, 2].max()]
        else:
            part += [
                *at,
                near.max(initial=xyz[:, 2].min()) + rng.uniform(3, 300) - part[:, 2].min(),
            ]
        parts.append(part)
        kinds += [7 if low else 18] * size
    return np.round(np.vstack(parts), 3), np.array(kinds)


def planted(
    xyz: np.ndarray,
    codes: np.ndarray,
    size: int,
    extent: float,
    depth: float,
    per_hectare: int,
    seed: int,
) -> np.ndarray:
    """Clusters of `size` points, `extent` meters across, `depth` below all near by, under land that
    holds points."""
    rng = np.random.default_rng(seed)
    squares = np.unique(np.floor(xyz[:, :2] / 10).astype(int), axis=0)
    spacing = np.sqrt(100 * len(squares) / len(xyz))
    ground = xyz[codes == 2]
    nearest, cloud_tree = cKDTree(ground[:, :2]), cKDTree(xyz[:, :2])
    parts: list[np.ndarray] = []
    taken: set[tuple[int, ...]] = set()
    for i, j in rng.permutation(squares).tolist():
        if len(parts) >= max(1, per_hectare * len(squares) / 100):
            break
        at = xyz[cloud_tree.query((np.array([i, j]) + rng.random(2)) * 10)[1], :2]
        part = rng.normal(0, 1, (size, 3))
        part *= (
            rng.random((size, 1)) ** (1 / 3)
            * extent
            / 2
            / np.linalg.norm(part, axis=1, keepdims=True)
        )
        part[:, :2] += at
        if (i, j) in taken or np.quantile(cloud_tree.query(part[:, :2])[0], 0.8) > max(
            0.75, 1.2 * spacing
        ):
            continue
        near = xyz[cloud_tree.query_ball_point(at, extent / 2 + 1), 2]
        level = ground[nearest.query(at, 3)[1], 2].min()
        part[:, 2] += min([level, *near]) - depth - part[:, 2].max()
        parts.append(part)
        taken |= {(i + a, j + b) for a in range(-2, 3) for b in range(-2, 3)}
    return np.round(np.vstack([np.empty((0, 3)), *parts]), 3)


def right(
    xyz: np.ndarray, truth: np.ndarray, returns: np.ndarray, noise: np.ndarray, word: str
) -> float:
    """Overall accuracy (2, 5, 6) of points, in %, by the shipped model, classified with noise among
    them."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, np.floor(xyz.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.vstack([xyz, noise]).T
    las.return_number, las.number_of_returns = np.vstack([returns, np.ones((len(noise), 2), int)]).T
    with TemporaryDirectory() as scratch:
        source, target = str(Path(scratch) / "in.laz"), str(Path(scratch) / "out.laz")
        las.write(source)
        with redirect_stdout(io.StringIO()):
            if command(["classify", source, target, word, "--no-progress"]):
                raise SystemExit("the cloud could not be classified")
        classes = np.asarray(laspy.read(target).classification)[: len(xyz)]
    scored = np.isin(truth, (2, 5, 6))
    return 100 * float((np.where(np.isin(classes, (3, 4, 5)), 5, classes) == truth)[scored].mean())


def classified(folder: Path) -> None:
    """Print by how much overall accuracy (2, 5, 6) changes with clusters below, marked by default
    and not looked for.

    Of the labeled points alone; the first line of a cloud says what is without them.
    """
    print("| cloud | clusters: points / across / below, m; per hectare | OA | not marked |")
    print("|---|---|---:|---:|")
    for name in CLASSIFIED:
        las = laspy.read(folder / name)
        good = np.asarray(las.classification) != 7
        xyz, codes = (
            np.column_stack([las.x, las.y, las.z])[good],
            np.asarray(las.classification)[good],
        )
        returns = np.column_stack([las.return_number, las.number_of_returns])[good]
        truth = np.where(np.isin(codes, (3, 4, 5)), 5, codes)
        cloud = xyz, truth, returns
        print(f"| {name} | none | {right(*cloud, np.empty((0, 3)), '--noise'):.2f} | |", flush=True)
        for number, (size, extent, depth) in enumerate(CLUSTERS):
            each = 5 if number % 2 else 1
            noise = planted(xyz, codes, size, extent, depth, each, number)
            shown = " | ".join(
                f"{right(*cloud, noise, word):.2f}" for word in ("--noise", "--no-noise")
            )
            print(f"| | {size} / {extent:g} / {depth:g}; {each} | {shown} |", flush=True)


def terrain(folder: Path) -> None:
    """Print the RMSE of heights of labeled ground that clusters below it make, alone and after
    those found were left out."""
    print(
        "| cloud | clusters: points / across / below, m; per hectare | found, % | RMSE, m | alone |"
    )
    print("|---|---|---:|---:|---:|")
    for name in UNDER:
        las = laspy.read(folder / name)
        xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
        good = np.isin(codes, GOOD)
        xyz, codes = xyz[good], codes[good]
        clean, labeled = filtered_ground(*xyz.T)["HeightAboveGround"], codes == 2
        for number, (size, extent, depth) in enumerate(CLUSTERS):
            each = 5 if number % 2 else 1
            both = np.vstack([xyz, planted(xyz, codes, size, extent, depth, each, number)])
            marked = detached_noise(both)
            shown = []
            for use in (marked == 0, np.ones(len(both), bool)):
                heights = filtered_ground(*both.T, mask=use)["HeightAboveGround"][: len(xyz)]
                shown.append(f"{np.sqrt(np.mean((heights - clean)[labeled] ** 2)):.2f}")
            share = 100 * (marked[len(xyz) :] == 7).mean() if len(both) > len(xyz) else np.nan
            cells = f"{size} / {extent:g} / {depth:g}; {each} | {share:.0f} | {' | '.join(shown)}"
            print(f"| {name} | {cells} |", flush=True)


def steep_place(what: str, density: float, seed: int) -> np.ndarray:
    """All ground: 200 x 200 m with a steep place."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-100, 100, (2, int(40_000 * density)))
    z = 0.1 * x + rng.normal(0, 0.04, len(x))
    if what == "cliff":
        z += 40 * (y + 6 * np.sin(x / 15) > 0)
    elif what == "overhang":  # the ground goes on 6 m under the edge, seen aslant
        z += 25 * ((y > 0) & ((y > 6) | (rng.random(len(x)) < 0.9)))
    elif what == "tunnel mouth":  # a cutting of 8 m that runs 5 m into the hill
        inside = (abs(x) < 5) & (y < 5) & ((y < 0) | (rng.random(len(x)) < 0.15))
        z += 12 * (y > 0) - np.where(inside, 8 + 12 * (y > 0), 0)
    elif what == "quarry":
        z -= 10 * np.ceil(np.clip(50 - np.hypot(x, y), 0, 29) / 10)
    elif what == "gorge":
        z -= 40 * (abs(x - 8 * np.sin(y / 20)) < 5)
    return np.column_stack([x, y, z])


def places() -> None:
    """Print how much ground is marked as low noise in a closed wood, and of steep places."""
    densities = (0.3, 0.5, 1.0, 2.0, 5.0)
    print("| place | " + " | ".join(f"{d:g} points/m²" for d in densities) + " |")
    print("|---|" + "---:|" * len(densities))
    for slope in (0.0, 0.46, 0.8):
        for seen in (0.01, 0.03, 0.1, 0.2):
            shown = []
            for density in densities:
                woods = [closed_wood(slope, density, seen, seed, 300) for seed in range(3)]
                marked = [
                    (detached_noise(xyz) == 7)[ground & wood].mean() for xyz, ground, wood in woods
                ]
                shown.append(f"{100 * np.mean(marked):.2f}")
            print(f"| wood, slope {slope:g}, {seen:.0%} ground | {' | '.join(shown)} |", flush=True)
    for what in ("cliff", "overhang", "tunnel mouth", "quarry", "gorge"):
        marked = [
            np.mean([(detached_noise(steep_place(what, d, seed)) == 7).mean() for seed in range(3)])
            for d in densities
        ]
        print(f"| {what} | {' | '.join(f'{100 * share:.3f}' for share in marked)} |", flush=True)


def kinds_of_noise(xyz: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return noise of each kind, its coordinates, for a cloud without any.

    Veils are even from the ground to 60 m above, with 0.1, 0.5 and 2 % as many points as the cloud;
    single points and birds (2 to 30 points) hang above the canopy; blobs, columns and sheets hold the
    points of 0.5 to 4 m2 of ground, thin clouds 30 to 60 points over 20 m, swarms those of 1 to 5 m2.
    """
    rng, tree = np.random.default_rng(seed), cKDTree(xyz[:, :2])
    squares = np.unique(np.floor(xyz[:, :2] / 2), axis=0)
    density = len(xyz) / (4 * len(squares))

    def places(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = xyz[rng.integers(len(xyz), size=number), :2] + rng.uniform(-1, 1, (number, 2))
        near = xyz[tree.query(at, 12)[1], 2]
        return at, near.min(axis=1), near.max(axis=1)

    def groups(number: int, points: tuple, shape: tuple, size: tuple, height: tuple) -> np.ndarray:
        parts = []
        for at, top in zip(*places(number)[::2], strict=True):
            part = rng.normal(0, 1, (int(rng.uniform(*points)), 3)) * shape * rng.uniform(*size)
            part[:, 2] += top + rng.uniform(*height) - part[:, 2].min()
            parts.append(part + np.append(at, 0))
        return np.vstack(parts)

    noise = {}
    for share in (0.001, 0.005, 0.02):
        at, ground, _ = places(max(int(share * len(xyz)), 20))
        noise[f"veil {share:.1%}"] = np.column_stack([at, ground + rng.uniform(0, 60, len(at))])
    at, _, top = places(max(len(xyz) // 2000, 30))
    noise["single"] = np.column_stack([at, top + rng.uniform(3, 200, len(at))])
    flocks = max(len(xyz) // 15_000, 6)
    noise["birds"] = groups(flocks, (2, 31), (1, 1, 1), (0.4, 0.4), (4, 100))
    noise["thin clouds"] = groups(3, (30, 60), (1, 1, 1), (4, 4), (30, 100))
    few, many = (np.clip(np.array(m2) * density, 10, 2000) for m2 in ((0.5, 4), (1, 5)))
    for name, shape in (("blobs", (1, 1, 1)), ("columns", (0.4, 0.4, 3)), ("sheets", (2, 2, 0.3))):
        noise[name] = groups(4, tuple(few), shape, (0.7, 1.5), (4, 30))
    noise["swarms"] = groups(3, tuple(many), (1, 1, 1), (2, 4), (0, 8))
    return noise


def find_outliers(xyz: np.ndarray) -> np.ndarray:
    """Return what PDAL's filters.outlier finds (statistical, 8 neighbors, multiplier 3)."""
    mean = cKDTree(xyz).query(xyz, 9)[0][:, 1:].mean(axis=1)
    return mean > mean.mean() + 3 * mean.std()


def find_isolated_voxels(xyz: np.ndarray) -> np.ndarray:
    """Return what lasR's ivf finds: at most 6 points in a voxel of 1 m and the 26 around it."""
    place = np.floor(xyz).astype(np.int64)
    place -= place.min(axis=0) - 1
    size = place.max(axis=0) + 2
    steps = [np.ravel_multi_index(step, size) for step in np.ndindex(3, 3, 3)]
    keys, voxel, count = np.unique(
        np.ravel_multi_index(tuple(place.T), size), return_inverse=True, return_counts=True
    )
    around = np.zeros(len(keys), int)
    for step in steps:
        other = keys + step - np.ravel_multi_index((1, 1, 1), size)
        at = np.minimum(np.searchsorted(keys, other), len(keys) - 1)
        around += np.where(keys[at] == other, count[at], 0)
    return (around <= 6)[voxel]


#: What finds noise, by name.
FINDERS = {
    "this stage": lambda xyz: detached_noise(xyz) > 0,
    "filters.outlier": find_outliers,
    "voxels of 1 m": find_isolated_voxels,
}


def surveys(folder: Path) -> None:
    """Print what each finder marks of the surveys' good points, and of noise put into copies."""
    shares: dict[str, list] = {name: [] for name in FINDERS}
    print("| survey | finder | good points marked | of wires, towers | noise found, all / far |")
    print("|---|---|---:|---:|---|")
    for name, known in SURVEYS.items():
        xyz, codes, _ = published(folder, known)
        good = ~np.isin(codes, known.dropped)
        xyz, codes = xyz[good], codes[good]
        noise, tree = kinds_of_noise(xyz, 0), cKDTree(xyz)
        far = {kind: tree.query(part)[0] > 5 for kind, part in noise.items()}
        for finder, find in FINDERS.items():
            marked = find(xyz)
            row = [100 * marked.mean()]
            lines = [f"{100 * marked[codes == c].mean():.2f}" for c in (14, 15) if c in codes]
            every = np.split(
                find(np.vstack([xyz, *noise.values()]))[len(xyz) :],
                np.cumsum([len(part) for part in noise.values()])[:-1],
            )
            for kind, found in zip(noise, every, strict=True):
                row += [
                    100 * found.mean(),
                    100 * found[far[kind]].mean() if any(far[kind]) else np.nan,
                ]
            shares[finder].append(row)
            shown = "; ".join(
                f"{kind} {row[1 + 2 * k]:.0f} / {row[2 + 2 * k]:.0f}"
                for k, kind in enumerate(noise)
            )
            print(
                f"| {name} | {finder} | {row[0]:.4f} % | {', '.join(lines)} | {shown} |", flush=True
            )
    print("\n| finder | good points marked, mean | worst | " + " | ".join(noise) + " |")
    print("|---" + "|---:" * (2 + len(noise)) + "|")
    for finder, rows in shares.items():
        means = np.nanmean(rows, axis=0)
        cells = [f"{means[1 + 2 * k]:.0f} / {means[2 + 2 * k]:.0f}" for k in range(len(noise))]
        worst = max(row[0] for row in rows)
        print(f"| {finder} | {means[0]:.4f} % | {worst:.3f} % | {' | '.join(cells)} |")


def wires(xyz: np.ndarray, codes: np.ndarray, order: np.ndarray) -> list[str]:
    """Return what share of the wires is marked at some densities, by points/m2 that keep points."""
    out = []
    for points in (np.inf, 7, 4, 2, 1, 0.3):
        kept = order < points
        marked = detached_noise(xyz[kept])[codes[kept] == 14] > 0
        out.append(f"{points:g} points/m²: {marked.sum()} of {len(marked)}")
    return out


def thinned(folder: Path) -> None:
    """Print how many good points of the surveys are marked, in percent, as flown and thinned."""
    print("| survey | as flown | " + " | ".join(f"{d:g} points/m²" for d in THINNED) + " |")
    print("|---" + "|---:" * (1 + len(THINNED)) + "|")
    shares = []
    for name, known in SURVEYS.items():
        xyz, codes, _ = published(folder, known)
        good = ~np.isin(codes, known.dropped)
        xyz, codes = xyz[good], codes[good]
        density, order = density_of(xyz), hash_rows(xyz.T, 0)
        row = [
            100 * (detached_noise(xyz[order < np.uint64(least)]) > 0).mean() if part < 1 else np.nan
            for part, least in ((d / density, min(d / density, 0.999) * 2.0**64) for d in THINNED)
        ]
        shares.append([100 * (detached_noise(xyz) > 0).mean(), *row])
        print(
            f"| {name} | " + " | ".join(f"{share:.4f}" for share in shares[-1]) + " |", flush=True
        )
        if (codes == 14).any():
            print(f"| its wires at {', '.join(wires(xyz, codes, order / 2.0**64 * density))} |")
    for word, value in (("mean", np.nanmean), ("worst", np.nanmax)):
        print(f"| {word} | " + " | ".join(f"{v:.4f}" for v in value(shares, axis=0)) + " |")


def density_of(xyz: np.ndarray) -> float:
    """Return the points per m2 of squares of 5 m that hold any."""
    return len(xyz) / (25 * len(np.unique(np.floor(xyz[:, :2] / 5), axis=0)))


def wooded(xyz: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return which points (n,) lie in woods, by squares of 20 m.

    More than half of a square's points are plants, which are 8 m high; hardly any are buildings.
    """
    square = np.unique(np.floor(xyz[:, :2] / 20), axis=0, return_inverse=True)[1]
    count = np.bincount(square)
    low, high = np.full((2, len(count)), np.nan)
    np.fmin.at(low, square, xyz[:, 2])
    np.fmax.at(high, square, xyz[:, 2])
    plants = np.bincount(square, np.isin(codes, (1, 3, 4, 5))) / count
    houses = np.bincount(square, codes == 6) / count
    return ((plants > 0.5) & (houses < 0.02) & (high - low > 8) & (count > 20))[square]


def canopies(folder: Path) -> None:
    """Print how much of the ground that woods have left is marked low and high, in percent."""
    print("| points/m² | share of ground | clouds | low, mean | worst | high, mean | worst |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    rows: dict[tuple[float, float], list[list[float]]] = {}
    for known in SURVEYS.values():
        xyz, codes, _ = published(folder, known)
        good = ~np.isin(codes, known.dropped)
        xyz, codes = xyz[good], codes[good]
        under = wooded(xyz, codes) & (codes == 2)
        if under.sum() < 200:
            continue
        density, order = density_of(xyz), hash_rows(xyz.T, 0) / 2.0**64
        beside = wooded(xyz, codes) & (codes != 2)
        for points in (np.inf, 1.0, 0.3):
            if density < points < np.inf:
                continue
            kept = order < points / density
            for share in (0.005, 0.01, 0.03):
                left = share / (1 - share) * (kept & beside).sum() / max((kept & under).sum(), 1)
                use = kept & (
                    ~under | (hash_rows(xyz.T, 1) < np.uint64(min(left, 0.999) * 2.0**64))
                )
                if left < 1 and (use & under).any():
                    marked = detached_noise(xyz[use])[under[use]]
                    rows.setdefault((points, share), []).append(
                        [100 * (marked == code).mean() for code in (7, 18)]
                    )
    for (points, share), values in rows.items():
        flown = "as flown" if np.isinf(points) else f"{points:g}"
        cells = [f"{np.mean(v):.3f} | {np.max(v):.2f}" for v in zip(*values, strict=True)]
        print(f"| {flown} | {share:.1%} | {len(values)} | {' | '.join(cells)} |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required="--places" not in sys.argv)
    parser.add_argument("--classify", action="store_true")
    parser.add_argument("--terrain", action="store_true")
    parser.add_argument("--surveys", action="store_true")
    parser.add_argument("--thinned", action="store_true")
    parser.add_argument("--canopies", action="store_true")
    parser.add_argument("--places", action="store_true")
    options = parser.parse_args()
    folder = options.data
    if options.places:
        places()
        return
    if options.canopies:
        canopies(folder)
        return
    if options.thinned:
        thinned(folder)
        return
    if options.surveys:
        surveys(folder)
        return
    if options.classify:
        classified(folder)
        return
    if options.terrain:
        terrain(folder)
        return
    detached_noise(np.random.default_rng(0).uniform(0, 30, (500, 3)))
    print(
        "| cloud | million points/s | good points marked | found of 0.01 % | 0.1 % | 1 % (low / "
        "high) |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    for name in CLOUDS:
        las = laspy.read(folder / name)
        xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
        start = time.process_time()
        marked = detached_noise(xyz)
        spent = time.process_time() - start
        good = np.isin(codes, GOOD)
        detected = []
        for share in SHARES:
            tally = np.zeros((2, 2))
            for seed in range(5 if share < 0.001 else 1):
                noise, kinds = injected(xyz, codes, share, seed)
                mask = detached_noise(np.vstack([xyz, noise]))[len(xyz) :]
                for row, kind in enumerate((7, 18)):
                    tally[row] += [(mask[kinds == kind] == kind).sum(), (kinds == kind).sum()]
            detected.append(" / ".join(f"{100 * hits / max(n, 1):.0f}" for hits, n in tally))
        rate, false = len(xyz) / spent / 1e6, 100 * (marked[good] > 0).mean()
        print(f"| {name} | {rate:.1f} | {false:.4f} % | {' | '.join(detected)} |", flush=True)


if __name__ == "__main__":
    main()
