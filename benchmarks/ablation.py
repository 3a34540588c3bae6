"""What each rule and parameter of ground, noise and decks does to real labeled clouds.

    python benchmarks/ablation.py --data FOLDER [--of ground noise ...] [--only ROW ...] [--json
    FILE]

FOLDER holds the surveys of `surveys/sources.csv`, the ISPRS filter samples, and bridge/pont.laz;
what is missing is left out and named. Each row switches one rule off, or gives a parameter another
value; an error is the share of scored points, in percent, that are wrong:

- ground: ground against vegetation (4, 5) and buildings, all points of the ISPRS samples. From
twelve surveys clips of 160 m
  are cut, and a basement, a pit or a canal is dug into the middle of each: points of the hole are
  not scored. Six with roofs are stretched to three times their width, heights stay.
- noise: 1 % of points put into each survey as `noise.py` does, and the published noise of surveys
that have it.
- decks: points of that class missed, and others taken for it, on all surveys.
Unclassified points are not
  scored, as cars and poles are among them.

A rule stays only if, on clouds it was not made for, it lowers the mean error of a kind of clouds by
0.05 points or more, or rescues a cloud by a whole point, and harms none by more than 0.3. What a
row changes by more than 0.15 is listed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import laspy
import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parent / "surveys"))
from clouds import mislabeled, published
from noise import injected
from surveys import GROUND, SURVEYS, VEGETATION

from pdal_stages.structures import decks
from pdal_stages.terrain import (
    detached,
    detached_noise,
    filter_options,
    filtered_ground,
    low_outliers,
    noise,
    openings,
    regain,
    smrf,
    wide_roofs,
)
from pdal_stages.terrain.cells import HOLE


class Cloud(NamedTuple):
    """A labeled cloud without points that are not scored in any table."""

    kind: str  #: the column of the ground's table
    xyz: np.ndarray  #: (n, 3) meters
    truth: np.ndarray  #: (n,) 2 ground, 5 and 6 objects, 0 not scored
    codes: np.ndarray  #: (n,) as published; 17 decks, 7 and 18 noise

    def take(self, rows: np.ndarray) -> Cloud:
        return self._replace(xyz=self.xyz[rows], truth=self.truth[rows], codes=self.codes[rows])


#: Codes of noise.
NOISE = (7, 18)
#: Codes of points that LiDAR HD puts on water and under bridges: no scanner has them.
ADDED = (64, 65, 66, 67)
#: Surveys whose decks have another code than 17.
DECKS = {"Delft": 26}
#: Surveys into which holes are dug: of every landscape, country and density.
DUG = (
    "meadows", "Montpellier", "hamlet", "Delft", "town's edge", "river", "pines", "Amsterdam", "firs", "suburb",
    "bridges", "steep",
)  # fmt: skip
#: Half widths west-east and south-north, and depth, in meters.
HOLES = {"basement": (12.5, 7.5, 3.5), "pit": (12.0, 12.0, 8.0), "canal": (np.inf, 4.0, 3.0)}
#: Surveys that are stretched, and how often: roofs of 12 to 30 m are wider than the window then.
STRETCHED = ("Seville", "Amsterdam", "park", "school", "suburb", "Hamburg")
STRETCH = 3.0
#: Half the side of a clip in meters.
CLIP = 80.0
#: Height in meters above the nearest labeled ground from which a point of "everything else" is
#: vegetation.
TALL = 2.0
#: Changes of a cloud's error, in points, that are listed.
LISTED = 0.15


def labeled_survey(data: Path, name: str) -> Cloud:
    """Return a survey with its truth. Heights come from its labeled ground, never from the
    filter."""
    known = SURVEYS[name]
    xyz, codes, _ = published(data, known)
    if name in DECKS:
        codes = np.where(codes == DECKS[name], 17, codes)
    kept = ~np.isin(codes, [code for code in known.dropped if code not in NOISE])
    xyz, codes = xyz[kept], codes[kept]
    truth = np.zeros(len(xyz), np.uint8)
    for code, ours in known.labels.items():
        truth[codes == code] = ours
    ground = truth == GROUND
    if known.tall and ground.any():
        _, nearest = cKDTree(xyz[ground, :2]).query(xyz[:, :2])
        height = xyz[:, 2] - xyz[ground, 2][nearest]
        for code, least in known.tall.items():
            truth[(codes == code) & (height >= max(least, TALL))] = VEGETATION
    truth[mislabeled(known, *xyz[:, :2].T) | np.isin(codes, NOISE)] = 0
    return Cloud("survey", xyz, truth, codes)


def dug(cloud: Cloud, hole: str) -> Cloud:
    """Return a clip of a cloud with a hole dug into its middle."""
    away = np.abs(cloud.xyz[:, :2] - np.median(cloud.xyz[:, :2], axis=0))
    near = (away < CLIP).all(axis=1)
    clip, away = cloud.take(near), away[near]
    west, south, depth = HOLES[hole]
    inside = (away[:, 0] < west) & (away[:, 1] < south)
    xyz = clip.xyz - np.outer(inside, [0, 0, depth])
    return Cloud("dug", xyz, np.where(inside, 0, clip.truth), clip.codes)


def read_labeled(path: Path, kind: str, classes: dict[int, int], other: int) -> Cloud:
    """Return a file's points; codes that `classes` does not name have the truth `other`."""
    las = laspy.read(path)
    codes = np.asarray(las.classification)
    truth = np.full(len(codes), other, np.uint8)
    for code, ours in classes.items():
        truth[codes == code] = ours
    return Cloud(kind, np.column_stack([las.x, las.y, las.z]).astype(float), truth, codes)


def clouds(data: Path) -> Iterator[tuple[str, Cloud]]:
    """Yield the name and the cloud of each that is there and has labeled ground."""
    for name in SURVEYS:
        try:
            cloud = labeled_survey(data, name)
        except FileNotFoundError as error:
            print(f"left out: {error.filename} is missing", file=sys.stderr)
            continue
        if (cloud.truth == GROUND).any():
            yield name, cloud
            if name in DUG:
                for hole in HOLES:
                    yield f"{name} + {hole}", dug(cloud, hole)
            if name in STRETCHED:
                xyz = cloud.xyz * [STRETCH, STRETCH, 1]
                yield f"{name}, stretched", cloud._replace(kind="stretched", xyz=xyz)
    if (path := data / "bridge" / "pont.laz").exists():
        pont = read_labeled(path, "survey", {2: 2, 4: 5, 5: 5, 6: 6}, 0)
        yield "pont", pont.take(~np.isin(pont.codes, ADDED))
    for path in sorted(data.glob("isprs_filter/*.laz")):
        yield path.stem, read_labeled(path, "ISPRS", {2: 2}, 5)


@contextmanager
def changed(module: Any, name: str, value: Any) -> Iterator[None]:
    """Give a module's constant or function another value."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def percent(wrong: np.ndarray) -> float:
    """Return the share of true values in percent."""
    return 100.0 * float(np.mean(wrong))


def ground_error(cloud: Cloud, **options: float) -> float:
    """Return the error of the ground filter."""
    cloud = cloud.take(~np.isin(cloud.codes, NOISE))
    scored = cloud.truth > 0
    ground = filtered_ground(cloud.xyz, **options)["Ground"][scored] == 1
    return percent(ground != (cloud.truth[scored] == GROUND))


def with_noise(cloud: Cloud) -> Cloud:
    """Return the cloud with 1 % of noise put into it, where it has none of its own."""
    if np.isin(cloud.codes, NOISE).any():
        return cloud
    xyz, codes = injected(cloud.xyz, cloud.truth, 0.01, 0)
    return cloud._replace(
        xyz=np.vstack([cloud.xyz, xyz]), codes=np.append(cloud.codes, codes).astype(np.uint8)
    )


def noise_error(cloud: Cloud) -> float:
    """Return the error of noise: low and high are not told apart."""
    marked = detached_noise(cloud.xyz) > 0
    return percent(marked != np.isin(cloud.codes, NOISE))


class Filtered(NamedTuple):
    """A cloud without noise, and its ground."""

    cloud: Cloud
    ground: np.ndarray

    @classmethod
    def of(cls, cloud: Cloud) -> Filtered:
        """Return the ground that the ground filter finds."""
        cloud = cloud.take(~np.isin(cloud.codes, NOISE))
        return cls(cloud, filtered_ground(cloud.xyz)["Ground"] > 0)

    def error(self, detected: np.ndarray, code: int) -> float:
        """Return the error of a class; unclassified points are not scored."""
        scored = self.cloud.codes != 1
        return percent(detected[scored] != (self.cloud.codes[scored] == code))


def deck_error(filtered: Filtered) -> float:
    """Return the error of bridge decks."""
    xyz, use = filtered.cloud.xyz, np.ones(len(filtered.ground), bool)
    return filtered.error(decks.find_decks(*xyz.T.copy(), use, filtered.ground, decks.RULES), 17)


def no_outliers(raster: np.ndarray, *_: Any) -> np.ndarray:
    """Find no low outliers."""
    return np.zeros(raster.shape, bool)


def no_wide_roofs(*cells: Any) -> np.ndarray:
    """Find no wide roofs."""
    return np.full(cells[3].shape, HOLE)


def unchanged(values: np.ndarray) -> np.ndarray:
    """Return what came in."""
    return values


class Row(NamedTuple):
    """What a row of a table changes."""

    module: Any = None
    name: str = "RULES"
    value: Any = None
    options: dict[str, float] = {}


def rule(module: Any, **values: Any) -> Row:
    """Return the row of other thresholds of a detector."""
    return Row(module, "RULES", module.RULES._replace(**values))


def option(**values: float) -> Row:
    """Return the row of other options."""
    return Row(options=values)


#: By table and the words of its row; the first row is what is shipped.
ROWS: dict[str, dict[str, Row]] = {
    "ground": {
        "as it is": Row(),
        "without low outliers": Row(smrf, "find_low_outliers", no_outliers),
        "outliers: no ground as deep is looked for": rule(low_outliers, min_company=10**6),
        "outliers: ground as deep needs no support": rule(
            low_outliers, min_support=-1, min_support_share=0.0
        ),
        "holes stay holes": Row(openings, "fill_holes", unchanged),
        "without regaining ground": Row(regain, "ROUNDS", 0),
        "regained once": Row(regain, "ROUNDS", 1),
        "regained near the surface only": Row(regain, "SPREADS", 0),
        "among a fifth of ground": Row(regain, "SPREAD_SHARE", 0.2),
        "among three tenths of ground": Row(regain, "SPREAD_SHARE", 0.3),
        "surface of 8 m blocks": Row(filter_options, "NEAR", 8.0),
        "without wide roofs": Row(smrf, "level_below_roofs", no_wide_roofs),
        **{
            f"wide roofs: {share:.0%} of an outline are steps": Row(
                wide_roofs, "RULES", replace(wide_roofs.RULES, min_step_share=share)
            )
            for share in (0.5, 0.7, 0.85)
        },
        "window 75": option(window=75.0),
        "window 40": option(window=40.0),
        "window 25": option(window=25.0),
        "window 14": option(window=14.0),
        "slope 0.12": option(slope=0.12),
        "slope 0.15": option(slope=0.15),
        "slope 0.2": option(slope=0.2),
        "threshold 0.3": option(threshold=0.3),
        "threshold 0.5": option(threshold=0.5),
        "scalar 0.9": option(scalar=0.9),
        "cell 0.5": option(cell=0.5),
    },
    "noise": {
        "as it is": Row(),
        "voxels do not widen in thin clouds": rule(detached, sides=(2.0,)),
        "voxels do not widen where company is missing": rule(detached, max_lonely=1.0),
        "sparse swarms hold": rule(detached, min_more=0),
        "nearly empty voxels hold": rule(detached, min_more=0, min_around=0),
        "dense clusters stay small": rule(detached, cluster_area_m2=0.0),
        "long pieces of wires are clusters": rule(detached, line_columns=99),
        "nothing holds what is near": rule(detached, hold_columns=0, hold_sides=0.0),
        "large clusters are never covered": rule(detached, min_covered=2.0),
        "low: crowns are land": Row(noise, "BELOW_RULES", low_outliers.RULES),
        "low: no ground as deep is looked for": Row(
            noise, "BELOW_RULES", noise.BELOW_RULES._replace(min_company=10**6)
        ),
        "low: ground as deep needs no support": Row(
            noise, "BELOW_RULES", noise.BELOW_RULES._replace(min_support=-1, min_support_share=0.0)
        ),
    },
    "decks": {
        "as it is": Row(),
        "water without points is a wall": rule(decks, max_water=0),
        "narrow layers are not grown": rule(decks, grow_rounds=0),
        "ends need not lead on": rule(decks, min_end_ratio=0.0),
        "sides need no drop": rule(decks, min_side_ratio=0.0),
        "walls do not matter": rule(decks, max_wall_ratio=9.0),
        "drops may be gentle": rule(decks, min_wall_slope=0.0),
        "layers need not be solid": rule(decks, min_neighbors=0),
    },
}


def errors_of(what: str, every: dict[str, Cloud], only: list[str]) -> dict[str, dict[str, float]]:
    """Return row -> cloud -> error of a table."""
    score: Callable[..., float]
    if what == "ground":
        inputs, score = every, ground_error
    elif what == "noise":
        inputs = {name: with_noise(cloud) for name, cloud in every.items()}
        score = noise_error
    else:
        inputs = {name: Filtered.of(cloud) for name, cloud in every.items()}
        score = deck_error
    errors: dict[str, dict[str, float]] = {}
    for words, row in ROWS[what].items():
        if only and words not in (*only, "as it is"):
            continue
        began = time.process_time()
        module, value = (row.module, row.value) if row.module else (regain, regain.ROUNDS)
        with changed(module, row.name if row.module else "ROUNDS", value):
            errors[words] = {name: score(at, **row.options) for name, at in inputs.items()}
        print(f"{words}: {time.process_time() - began:.0f} CPU s", file=sys.stderr, flush=True)
    return errors


def table(errors: dict[str, dict[str, float]], kinds: dict[str, str]) -> str:
    """Return means by kind of cloud, and what each row changes, as Markdown."""
    base = next(iter(errors.values()))
    each = list(dict.fromkeys(kinds.values()))
    lines = [f"| | {' | '.join(each)} | changes, points |", f"|---|{'---:|' * len(each)}---|"]
    for row, of in errors.items():
        means = [np.mean([of[name] for name in of if kinds[name] == kind]) for kind in each]
        moved = sorted((of[name] - base[name], name) for name in of)
        shown = "; ".join(f"{name} {by:+.2f}" for by, name in moved if abs(by) > LISTED)
        lines.append(f"| {row} | {' | '.join(f'{mean:.2f}' for mean in means)} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--of", nargs="+", choices=list(ROWS), default=list(ROWS), help="tables")
    parser.add_argument("--only", nargs="+", help="rows beside the first")
    parser.add_argument("--json", type=Path, help="write every cloud's error here")
    options = parser.parse_args()
    if options.data is None:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    every = dict(clouds(Path(options.data)))
    tables = {}
    for what in options.of:
        chosen = every
        if what != "ground":
            chosen = {name: cloud for name, cloud in every.items() if cloud.kind == "survey"}
        errors = tables[what] = errors_of(what, chosen, options.only)
        kinds = {name: cloud.kind for name, cloud in chosen.items()}
        print(f"\n{what}\n\n{table(errors, kinds)}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(tables, indent=1) + "\n")


if __name__ == "__main__":
    main()
