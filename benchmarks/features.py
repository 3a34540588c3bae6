"""Time of features and forests beside libraries that do some of the same: pgeof, jakteristics, PDAL, scikit-learn.

    python benchmarks/features.py                               # generated town, 500,000 points, 7 per square meter
    python benchmarks/features.py --cloud delft montpellier     # real clouds, from PDAL_STAGES_DATA
    python benchmarks/features.py --cloud file.laz --only moments kopt --repeats 5
    python benchmarks/features.py --scaling                     # 0.25 to 16 million points at constant density
    python benchmarks/features.py --profile                     # where the time goes
    python benchmarks/features.py --json out.json --write docs/feature-speed.md

All run in one process tree on the same cloud with the same number of threads, one after the other, each `--repeats`
times in turns. Times are CPU seconds of all threads (which other work on the machine disturbs least) and
wall seconds, and include building the search structure from plain coordinates; a ratio is a peer's time over ours in
the same turn, given as least / median / largest. PDAL runs as a program of its own, since its covariance
filter crashes with several threads in some releases: its time is that of a pipeline with the filter less that of one
that only reads, with one thread.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from forests import Forests, clocked

from pdal_stages.base.threads import resolve_threads
from pdal_stages.features import FeatureEngine, FeaturePlan, compute_features, warmup

RADII = (1.0, 2.0, 3.0, 5.0)
TWELVE = "covariance,Density,Verticality,HeightRange,HeightStd"
PDAL_FEATURES = (
    "Linearity,Planarity,Scattering,Verticality,Omnivariance,Anisotropy,Eigenentropy,EigenvalueSum,"
    "SurfaceVariation"
)
REAL = {
    "delft": "delft/train.laz",
    "montpellier": "montpellier/train_*.laz",
    "oakland": "oakland/train/*.laz",
}

Times = tuple[float, float]  # CPU and wall seconds


class Cloud(NamedTuple):
    """Points and their classes."""

    xyz: np.ndarray
    labels: np.ndarray


# ---- clouds ------------------------------------------------------------------------------------------------


def town(points: int, density: float) -> Cloud:
    """A generated town of about so many points."""
    from pdal_stages.synthetic import make_town

    made = make_town(size=max((points / density) ** 0.5, 20.0), density=density)
    return Cloud(np.ascontiguousarray(made.xyz), made.classification)


def load(name: str, points: int, density: float) -> Cloud:
    """A cloud by name (town, delft, montpellier, oakland) or file."""
    import laspy

    if name == "town":
        return town(points, density)
    if name in REAL:
        folder = os.environ.get("PDAL_STAGES_DATA")
        if not folder:
            sys.exit(f"PDAL_STAGES_DATA must name the folder of the real clouds for '{name}'")
        files = sorted(Path(folder).glob(REAL[name]))
    else:
        files = [Path(name)]
    clouds = [laspy.read(file) for file in files]
    xyz = np.ascontiguousarray(np.vstack([cloud.xyz for cloud in clouds]))
    return Cloud(xyz, np.concatenate([np.asarray(cloud.classification) for cloud in clouds]))


def point_density(xyz: np.ndarray) -> float:
    """Points per square meter of the occupied square meters."""
    return len(xyz) / max(len(np.unique(np.floor(xyz[:, :2]), axis=0)), 1)


# ---- what is timed -----------------------------------------------------------------------------------------


Work = Callable[[np.ndarray, np.ndarray], Times | None]


def ours(neighborhoods: str, feature_set: str, threads: int) -> Work:
    """Our features, block by block, nothing kept."""
    plan = FeaturePlan.parse(neighborhoods, feature_set)

    def run(xyz: np.ndarray, labels: np.ndarray) -> None:
        given = {name: np.zeros(len(xyz), np.float32) for name in plan.dimensions}
        for _ in FeatureEngine(xyz, plan, threads=threads).blocks(dimensions=given):
            pass

    return run


def pgeof_spheres(xyz: np.ndarray, labels: np.ndarray) -> None:
    import pgeof

    ids = pgeof.EFeatureID
    wanted = [ids.Linearity, ids.Planarity, ids.Scattering, ids.Verticality, ids.Curvature, ids.Eigentropy]
    for radius in RADII:
        pgeof.compute_features_selected(xyz, radius, 100_000 if len(xyz) > 100_000 else len(xyz), wanted)


def jakteristics_spheres(threads: int) -> Work:
    def run(xyz: np.ndarray, labels: np.ndarray) -> None:
        import jakteristics

        wanted = [
            "eigenvalue_sum", "omnivariance", "eigenentropy", "anisotropy", "planarity", "linearity",
            "surface_variation", "sphericity", "verticality", "number_of_neighbors",
        ]  # fmt: skip
        for radius in RADII:
            jakteristics.compute_features(xyz, radius, num_threads=threads, feature_names=wanted)

    return run


def pgeof_optimal(xyz: np.ndarray, labels: np.ndarray) -> None:
    """Its own neighbor search for 100 neighbors and its optimal neighborhoods of 10 to 100."""
    import pgeof

    near = np.ascontiguousarray(xyz - xyz[0], dtype=np.float32)
    found = pgeof.knn_search(near, near, 101)[0]
    pointers = np.arange(0, 101 * len(near) + 1, 101, dtype=np.uint32)
    pgeof.compute_features_optimal(near, found.astype(np.uint32).ravel(), pointers, 10, 1, 10)


def cases(threads: int) -> dict[str, tuple[str, Work, dict[str, Work]]]:
    """Case -> (what ours computes, ours, peers)."""
    spheres = ",".join(f"s{r:g}" for r in RADII)
    cylinders = ",".join(f"c{r:g}" for r in RADII)
    near = {"pgeof": pgeof_spheres, "jakteristics": jakteristics_spheres(threads)}
    pdal_spheres = [
        {"type": "filters.covariancefeatures", "radius": r, "feature_set": PDAL_FEATURES} for r in RADII
    ]
    pdal_optimal = [{"type": "filters.optimalneighborhood", "min_k": 10, "max_k": 100}]
    forests = Forests(threads)
    return {
        "moments": (
            "12 features of c1 c2 c3 c5 s1 s2 s3 s5 (peers: of the four spheres alone)",
            ours(f"{cylinders},{spheres}", TWELVE, threads),
            {**near, "PDAL": pdal(pdal_spheres)},
        ),
        "spheres": ("12 features of s1 s2 s3 s5", ours(spheres, TWELVE, threads), near),
        "kopt": (
            "12 features and radius of kopt (peers: PDAL gives the neighborhood, no features)",
            ours("kopt", f"{TWELVE},Radius", threads),
            {"pgeof": pgeof_optimal, "PDAL": pdal(pdal_optimal)},
        ),
        "shapes": (
            "A3 D1 D2 D3 D4 of c1 c2 c3 c5 s1 s2 s3 s5",
            ours(f"{cylinders},{spheres}", "shapes", threads),
            {},
        ),
        "all": ("560 features of weinmann2018", ours("weinmann2018", "all", threads), {}),
        "forest": (
            "a forest of 50 trees over 48 features (peer: the same trees)",
            forests.ours,
            {"scikit-learn": forests.scikit_learn},
        ),
    }


# ---- timing ------------------------------------------------------------------------------------------------


def timed(function: Work, cloud: Cloud) -> Times:
    """CPU seconds of all threads and of programs started, and wall seconds; a function may return its own."""
    own: list[Times | None] = []
    both = clocked(lambda: own.append(function(*cloud)))
    return own[0] or both


def pdal(stages: list[dict]) -> Work:
    """Seconds that PDAL's own filters take in a process of their own."""

    def run(xyz: np.ndarray, labels: np.ndarray) -> Times:
        beside = Path(sys.executable).parent / "pdal"
        program = str(beside) if beside.exists() else shutil.which("pdal")
        if program is None:
            raise ImportError("no pdal program")
        with tempfile.TemporaryDirectory() as folder:
            import laspy

            header = laspy.LasHeader(point_format=0, version="1.2")
            header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
            las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header))
            las.x, las.y, las.z = xyz.T
            las.write(f"{folder}/cloud.las")

            def pipeline(filters: list[dict]) -> Times:
                Path(folder, "job.json").write_text(
                    json.dumps([f"{folder}/cloud.las", *filters, {"type": "writers.null"}])
                )
                before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
                done = subprocess.run(
                    [program, "pipeline", f"{folder}/job.json"], capture_output=True, text=True
                )
                wall = time.perf_counter() - wall
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                if done.returncode:
                    raise RuntimeError(f"PDAL failed ({done.returncode}): {done.stderr.strip()[:200]}")
                return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall

            base = pipeline([])
            full = pipeline(stages)
        return full[0] - base[0], full[1] - base[1]

    return run


def measure(cloud: Cloud, only: Iterable[str], repeats: int, threads: int, peers: bool) -> list[dict]:
    """Time every case in turns; one entry per case."""
    few = Cloud(cloud.xyz[:2000], cloud.labels[:2000])
    results = []
    for name, (what, run, others) in cases(threads).items():
        if name not in only:
            continue
        run(*few)  # compiled code is loaded before the clock starts
        entry: dict = {"case": name, "what": what, "ours": [], "peers": {}}
        alive = dict(others) if peers else {}
        for turn in range(repeats):
            entry["ours"].append(timed(run, cloud))
            for peer, function in list(alive.items()):
                if peer == "PDAL" and turn:  # a minute a run: once
                    continue
                try:
                    times = timed(function, cloud)
                except (ImportError, RuntimeError) as error:
                    print(f"{peer} left out: {error}", file=sys.stderr)
                    del alive[peer]
                else:
                    entry["peers"].setdefault(peer, []).append(times)
        results.append(entry)
        print(
            f"  {name}: {', '.join(f'{cpu:.2f}' for cpu, _ in entry['ours'])} CPU s",
            file=sys.stderr,
            flush=True,
        )
    return results


def spread(values: Iterable[float], form: str = ".2f") -> str:
    """Least / median / largest."""
    values = list(values)
    return " / ".join(format(f(values), form) for f in (np.min, np.median, np.max))


def table(cloud: str, xyz: np.ndarray, results: list[dict], threads: int) -> str:
    lines = [
        f"{cloud}: {len(xyz):,} points, {point_density(xyz):.1f} per occupied square meter, {threads} threads",
        "",
        "| what | who | CPU s | wall s | CPU time over ours | points/s |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for entry in results:
        rows = {"pdal_stages": entry["ours"], **entry["peers"]}
        for who, times in rows.items():
            cpu, wall = zip(*times, strict=True)
            own = [o[0] for o in entry["ours"]][: len(cpu)]
            ratio = (
                "" if who == "pdal_stages" else spread((c / o for c, o in zip(cpu, own, strict=True)), ".1f")
            )
            # What so many quiet cores would do, from CPU time: wall time depends on what else runs.
            cores = 1 if who == "PDAL" else threads
            rate = f"{len(xyz) * cores / np.median(cpu):,.0f}"
            what = entry["what"] if who == "pdal_stages" else ""
            lines.append(f"| {what} | {who} | {spread(cpu)} | {spread(wall)} | {ratio} | {rate} |")
    return "\n".join(lines) + "\n"


# ---- scaling and profile -----------------------------------------------------------------------------------


def scaling(density: float, threads: int) -> list[dict]:
    """Time and memory for a growing cloud of constant density, each size in a process of its own.

    The cloud is a generated town of 250,000 points, laid side by side 1 to 64 times.
    """
    results = []
    code = (
        "import resource, sys; sys.path.insert(0, sys.argv[1]); import features as f, numpy as np\n"
        "one, times, threads = np.load(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])\n"
        "side = np.ceil(np.ptp(one, axis=0).max())\n"
        "xyz = np.empty((len(one) * times, 3))\n"
        "for i in range(times):\n"
        "    xyz[i * len(one) : (i + 1) * len(one)] = one + [i % 8 * side, i // 8 * side, 0]\n"
        "job = f.ours('c1,c2,c3,c5,s1,s2,s3,s5', f.TWELVE, threads)\n"
        "job(xyz[:2000], None)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "cpu, wall = f.timed(job, f.Cloud(xyz, None))\n"
        "after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(len(xyz), cpu, wall, xyz.nbytes / 2**20, before / 1024, after / 1024)\n"
    )
    here = str(Path(__file__).resolve().parent)
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/town.npy"
        np.save(file, town(250_000, density).xyz)
        for times in (1, 2, 4, 8, 16, 32, 64):
            command = [sys.executable, "-c", code, here, file, str(times), str(threads)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            n, cpu, wall, cloud, before, after = map(float, done.stdout.split())
            results.append(
                {
                    "points": int(n),
                    "cpu": cpu,
                    "wall": wall,
                    "cloud_mb": cloud,
                    "before_mb": before,
                    "peak_mb": after,
                }
            )
            print(f"  {int(n):,}: {cpu:.2f} CPU s", file=sys.stderr, flush=True)
    return results


def scaling_table(results: list[dict]) -> str:
    lines = [
        "12 features of c1 c2 c3 c5 s1 s2 s3 s5, a generated town of 250,000 points laid side by side 1 to 64 times",
        "",
        "| points | CPU s | microseconds a point | cloud, MiB | peak of the process over what it was, MiB |",
        "|---:|---:|---:|---:|---:|",
    ]
    for r in results:
        lines.append(
            f"| {r['points']:,} | {r['cpu']:.2f} | {r['cpu'] / r['points'] * 1e6:.2f} | {r['cloud_mb']:.0f} "
            f"| {r['peak_mb'] - r['before_mb']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def profile(xyz: np.ndarray) -> str:
    """CPU microseconds a point of each part, on one thread, by leaving parts out."""
    radii = "c1,c2,c3,c5,s1,s2,s3,s5"
    runs = {
        "index alone": lambda: FeatureEngine(xyz, FeaturePlan.parse("c1", "Density"), threads=1),
        "12 features of s1": lambda: compute_features(xyz, None, "s1", TWELVE, threads=1),
        "12 features of s5": lambda: compute_features(xyz, None, "s5", TWELVE, threads=1),
        "12 features of c1": lambda: compute_features(xyz, None, "c1", TWELVE, threads=1),
        "12 features of c5": lambda: compute_features(xyz, None, "c5", TWELVE, threads=1),
        "12 features of all eight": lambda: compute_features(xyz, None, radii, TWELVE, threads=1),
        "12 features and radius of kopt": lambda: compute_features(
            xyz, None, "kopt", f"{TWELVE},Radius", threads=1
        ),
        "the same and shapes of kopt": lambda: compute_features(xyz, None, "kopt", "all", threads=1),
        "shapes of all eight": lambda: compute_features(xyz, None, radii, "shapes", threads=1),
    }
    lines = ["| part | CPU microseconds a point |", "|---|---:|"]
    for name, run in runs.items():
        run()
        cpu = min(clocked(run)[0] for _ in range(2))
        lines.append(f"| {name} | {cpu / len(xyz) * 1e6:.2f} |")
    return "\n".join(lines) + "\n"


# ---- output ------------------------------------------------------------------------------------------------


def versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "numpy": np.__version__}
    for package in ("pdal-stages", "numba", "pgeof", "jakteristics", "scikit-learn"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "absent"
    beside = Path(sys.executable).parent / "pdal"
    program = str(beside) if beside.exists() else shutil.which("pdal")
    if program:
        said = subprocess.run([program, "--version"], capture_output=True, text=True).stdout
        found["pdal"] = next((w for w in said.split() if w[:1].isdigit()), "?")
    return found


def machine() -> str:
    """The processor, as Linux names it, and how many of its cores are on offer."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    flags = next((line.split() for line in lines if line.startswith("flags")), [])
    vectors = next((name for name in ("avx512f", "avx2", "avx") if name in flags), "")
    return ", ".join(
        filter(None, [names[0] if names else platform.machine(), f"{os.cpu_count()} cores", vectors])
    )


def plot(clouds: dict[str, tuple[int, list[dict]]], path: Path) -> None:
    """Median CPU microseconds a point of every case, a bar each."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    colors = {"pdal_stages": "#1b6ca8", "pgeof": "#b0b7bf", "jakteristics": "#8d97a1", "PDAL": "#6b7682"}
    colors["scikit-learn"] = "#c7ccd1"
    entries = [
        (cloud, n, entry) for cloud, (n, results) in clouds.items() for entry in results if entry["peers"]
    ]
    if not entries:
        return
    bars = sum(1 + len(entry["peers"]) for _, _, entry in entries)
    figure, axis = plt.subplots(figsize=(8, 0.8 + 0.24 * bars + 0.2 * len(entries)), constrained_layout=True)
    place, ticks, labels = 0.0, [], []
    for cloud, n, entry in entries:
        rows = {"pdal_stages": entry["ours"], **entry["peers"]}
        start = place
        for who, times in rows.items():
            each = float(np.median([cpu for cpu, _ in times])) / n * 1e6
            axis.barh(place, each, 0.85, color=colors[who])
            axis.text(each, place, f" {who} {each:.1f}", va="center", fontsize=8)
            place += 1
        ticks.append((start + place - 1) / 2)
        labels.append(f"{entry['case']}, {cloud}")
        place += 0.8
    axis.set_yticks(ticks, labels, fontsize=8)
    axis.invert_yaxis()
    axis.margins(x=0.18)
    axis.set_xlabel("CPU microseconds a point (all threads together)", fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cloud", nargs="+", default=["town"], help=f"town, {', '.join(REAL)}, or files")
    parser.add_argument("--points", type=int, default=500_000, help="of the town (default 500000)")
    parser.add_argument(
        "--density", type=float, default=7.0, help="of the town, per square meter (default 7)"
    )
    parser.add_argument("--only", nargs="+", choices=list(cases(1)), default=list(cases(1)))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=None, help="default: every core on offer")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--scaling", action="store_true", help="0.25 to 16 million points instead")
    parser.add_argument("--profile", action="store_true", help="where the time goes, instead")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--write", type=Path, help="write the tables here as Markdown, and a plot beside it")
    options = parser.parse_args()
    threads = resolve_threads(options.threads)
    warmup()
    if options.write and importlib.util.find_spec("matplotlib") is None:
        parser.error("--write draws a plot, which needs matplotlib: pip install -e '.[benchmarks]'")
    text, shown = "", {}
    data: dict = {"versions": versions(), "threads": threads, "machine": machine()}
    if options.scaling:
        data["scaling"] = scaling(options.density, threads)
        text = scaling_table(data["scaling"])
    elif options.profile:
        text = profile(load(options.cloud[0], options.points, options.density).xyz)
        data["profile"] = text
    else:
        clouds = {}
        for name in options.cloud:
            cloud, label = load(name, options.points, options.density), Path(name).stem
            clouds[label] = measure(cloud, options.only, options.repeats, threads, not options.no_peers)
            shown[label] = len(cloud.xyz), clouds[label]
            text += table(label, cloud.xyz, clouds[label], threads) + "\n"
        data["clouds"] = clouds
    text += "\n" + ", ".join(f"{name} {number}" for name, number in data["versions"].items())
    text += f"; {data['machine']}\n"
    print(text)
    if options.json:
        options.json.write_text(json.dumps(data, indent=1) + "\n")
    if options.write:
        options.write.write_text(text)
        if shown:
            plot(shown, options.write.with_suffix(".png"))


if __name__ == "__main__":
    main()
