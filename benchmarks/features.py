"""Time of features beside libraries that do some of the same: pgeof, jakteristics, PDAL.

    # generated town, 500,000 points, 7 per square meter
    python benchmarks/features.py
    python benchmarks/features.py --cloud file.laz --only moments kopt --repeats 5

All run in one process tree on the same cloud with the same number of threads, one after the other,
each `--repeats` times in turns. Times are CPU seconds of all threads (which other work on the
machine disturbs least) and wall seconds, and include building the search structure from plain
coordinates; a ratio is a peer's time over ours in the same turn, given as least / median / largest.
PDAL runs as a program of its own, since its covariance filter crashes with several threads in some
releases: its time is that of a pipeline with the filter less that of one that only reads, with one
thread.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from pdal_stages.base.threads import resolve_threads
from pdal_stages.features import FeatureEngine, FeaturePlan, warmup

RADII = (1.0, 2.0, 3.0, 5.0)
TWELVE = "covariance,Density,Verticality,HeightRange,HeightStd"
PDAL_FEATURES = (
    "Linearity,Planarity,Scattering,Verticality,Omnivariance,Anisotropy,Eigenentropy,EigenvalueSum,"
    "SurfaceVariation"
)
Times = tuple[float, float]  # CPU and wall seconds


def load(name: str, points: int, density: float) -> np.ndarray:
    """Coordinates of a file, or of a generated town of about so many points."""
    if name == "town":
        from pdal_stages.synthetic import make_town

        return np.ascontiguousarray(
            make_town(size=max((points / density) ** 0.5, 20.0), density=density).xyz
        )
    import laspy

    return np.ascontiguousarray(laspy.read(name).xyz)


def point_density(xyz: np.ndarray) -> float:
    """Points per square meter of the occupied square meters."""
    return len(xyz) / max(len(np.unique(np.floor(xyz[:, :2]), axis=0)), 1)


# ---- what is timed -----------------------------------------------------------------------------------------


Work = Callable[[np.ndarray], Times | None]


def ours(neighborhoods: str, feature_set: str, threads: int) -> Work:
    """Our features, block by block, nothing kept."""
    plan = FeaturePlan.parse(neighborhoods, feature_set)

    def run(xyz: np.ndarray) -> None:
        dimensions = {name: np.zeros(len(xyz), np.float32) for name in plan.dimensions}
        for _ in FeatureEngine(xyz, plan, threads=threads).run(dimensions=dimensions).computed():
            pass

    return run


def pgeof_spheres(xyz: np.ndarray) -> None:
    import pgeof

    ids = pgeof.EFeatureID
    wanted = [
        ids.Linearity,
        ids.Planarity,
        ids.Scattering,
        ids.Verticality,
        ids.Curvature,
        ids.Eigentropy,
    ]
    for radius in RADII:
        pgeof.compute_features_selected(
            xyz, radius, 100_000 if len(xyz) > 100_000 else len(xyz), wanted
        )


def jakteristics_spheres(threads: int) -> Work:
    def run(xyz: np.ndarray) -> None:
        import jakteristics

        wanted = [
            "eigenvalue_sum", "omnivariance", "eigenentropy", "anisotropy", "planarity", "linearity",
            "surface_variation", "sphericity", "verticality", "number_of_neighbors",
        ]  # fmt: skip
        for radius in RADII:
            jakteristics.compute_features(xyz, radius, num_threads=threads, feature_names=wanted)

    return run


def pgeof_optimal(xyz: np.ndarray) -> None:
    """Its own neighbor search for 100 neighbors and its optimal neighborhoods of 10 to 100."""
    import pgeof

    near = np.ascontiguousarray(xyz - xyz[0], dtype=np.float32)
    neighbors = pgeof.knn_search(near, near, 101)[0]
    pointers = np.arange(0, 101 * len(near) + 1, 101, dtype=np.uint32)
    pgeof.compute_features_optimal(near, neighbors.astype(np.uint32).ravel(), pointers, 10, 1, 10)


def cases(threads: int) -> dict[str, tuple[str, Work, dict[str, Work]]]:
    """Case -> (what ours computes, ours, peers)."""
    spheres = ",".join(f"s{r:g}" for r in RADII)
    cylinders = ",".join(f"c{r:g}" for r in RADII)
    near = {"pgeof": pgeof_spheres, "jakteristics": jakteristics_spheres(threads)}
    pdal_spheres = [
        {"type": "filters.covariancefeatures", "radius": r, "feature_set": PDAL_FEATURES}
        for r in RADII
    ]
    pdal_optimal = [{"type": "filters.optimalneighborhood", "min_k": 10, "max_k": 100}]
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
    }


# ---- timing ------------------------------------------------------------------------------------------------


def timed(function: Work, xyz: np.ndarray) -> Times:
    """CPU seconds of all threads, and wall seconds; a function may return its own."""
    cpu, wall = time.process_time(), time.perf_counter()
    ours = function(xyz)
    return ours or (time.process_time() - cpu, time.perf_counter() - wall)


def pdal(stages: list[dict]) -> Work:
    """Seconds that PDAL's own filters take in a process of their own."""

    def run(xyz: np.ndarray) -> Times:
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
                    raise RuntimeError(
                        f"PDAL failed ({done.returncode}): {done.stderr.strip()[:200]}"
                    )
                return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall

            base = pipeline([])
            full = pipeline(stages)
        return full[0] - base[0], full[1] - base[1]

    return run


def measure(
    xyz: np.ndarray, only: Iterable[str], repeats: int, threads: int, peers: bool
) -> list[dict]:
    """Time every case in turns; one entry per case."""
    results = []
    for name, (what, run, others) in cases(threads).items():
        if name not in only:
            continue
        run(xyz[:2000])  # compiled code is loaded before the clock starts
        entry: dict = {"case": name, "what": what, "ours": [], "peers": {}}
        alive = dict(others) if peers else {}
        for turn in range(repeats):
            entry["ours"].append(timed(run, xyz))
            for peer, function in list(alive.items()):
                if peer == "PDAL" and turn:  # a minute a run: once
                    continue
                try:
                    times = timed(function, xyz)
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
        f"{cloud}: {len(xyz):,} points, {point_density(xyz):.1f} per occupied square meter, "
        f"{threads} threads",
        "",
        "| what | who | CPU s | wall s | CPU time over ours | points/s |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for entry in results:
        rows = {"pdal_stages": entry["ours"], **entry["peers"]}
        for who, times in rows.items():
            cpu, wall = zip(*times, strict=True)
            our_cpu = [o[0] for o in entry["ours"]][: len(cpu)]
            ratio = (
                ""
                if who == "pdal_stages"
                else spread((c / o for c, o in zip(cpu, our_cpu, strict=True)), ".1f")
            )
            # What so many quiet cores would do, from CPU time: wall time depends on what else runs.
            cores = 1 if who == "PDAL" else threads
            rate = f"{len(xyz) * cores / np.median(cpu):,.0f}"
            what = entry["what"] if who == "pdal_stages" else ""
            lines.append(f"| {what} | {who} | {spread(cpu)} | {spread(wall)} | {ratio} | {rate} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cloud", nargs="+", default=["town"], help="a generated town, or files")
    parser.add_argument("--points", type=int, default=500_000, help="of the town (default 500000)")
    parser.add_argument(
        "--density", type=float, default=7.0, help="of the town, points per m2 (default 7)"
    )
    parser.add_argument("--only", nargs="+", choices=list(cases(1)), default=list(cases(1)))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=None, help="default: every core on offer")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    threads = resolve_threads(options.threads)
    warmup()
    clouds = {}
    for name in options.cloud:
        xyz = load(name, options.points, options.density)
        clouds[name] = measure(xyz, options.only, options.repeats, threads, not options.no_peers)
        print(table(name, xyz, clouds[name], threads))
    if options.json:
        options.json.write_text(json.dumps({"threads": threads, "clouds": clouds}, indent=1) + "\n")


if __name__ == "__main__":
    main()
