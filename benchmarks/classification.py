"""Accuracy and speed of the classifier on real clouds with fixed training and test parts.

    python benchmarks/classification.py --data DIR                    # both scenes, defaults
    python benchmarks/classification.py --data DIR --count 1000 10000 100000 --json out.json
    python benchmarks/classification.py --data DIR --scene montpellier --target 6    # Building, the rest

DIR (or the environment variable PDAL_STAGES_DATA) holds montpellier/train_*.laz, montpellier/test_*.laz,
delft/train.laz and delft/test.laz. Scores are over the test points of the classes trained; all others
(0 and 1 in Montpellier, 9 and 26 in Delft) are neither trained nor scored, but are neighbors.
Times are wall seconds, with CPU seconds beside them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sys
import time
from pathlib import Path

import laspy
import numpy as np

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.terrain.minima import hag_minima

SCENES = {"montpellier": (2, 3, 4, 5, 6), "delft": (1, 2, 6)}
MERGED = {"montpellier": {5: [3, 4]}, "delft": None}


class Timer:
    """Wall and CPU seconds of parts of the work."""

    def __init__(self) -> None:
        self.parts: dict[str, tuple[float, float]] = {}

    def __call__(self, name: str):
        self.name = name
        return self

    def __enter__(self) -> None:
        self.start = time.perf_counter(), time.process_time()

    def __exit__(self, *exc) -> None:
        wall, cpu = self.parts.get(self.name, (0.0, 0.0))
        self.parts[self.name] = (
            wall + time.perf_counter() - self.start[0],
            cpu + time.process_time() - self.start[1],
        )

    def rounded(self) -> dict[str, dict[str, float]]:
        return {k: {"wall": round(w, 2), "cpu": round(c, 2)} for k, (w, c) in self.parts.items()}


def read(data: Path, scene: str, part: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """(coordinates, labels, dimensions) of a scene's part, all its tiles together, heights included."""
    tiles = [laspy.read(path) for path in sorted((data / scene).glob(f"{part}*.laz"))]
    if not tiles:
        sys.exit(f"no {part}*.laz in {data / scene}: name the folder of the clouds with --data")
    xyz = np.concatenate([np.column_stack([t.x, t.y, t.z]) for t in tiles])
    names = {
        "Intensity": "intensity",
        "ReturnNumber": "return_number",
        "NumberOfReturns": "number_of_returns",
    }
    dimensions = {
        ours: np.concatenate([np.asarray(t[theirs]) for t in tiles]) for ours, theirs in names.items()
    }
    labels = np.concatenate([np.asarray(t.classification) for t in tiles])
    return xyz, labels, dimensions


def with_height(xyz: np.ndarray, dimensions: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    height = hag_minima(*xyz.T)
    return {**dimensions, "HeightAboveGround": height[0] if isinstance(height, tuple) else height}


# ---- scores ------------------------------------------------------------------------------------------------


def figures(accuracy: Accuracy) -> dict[str, float]:
    """The measures of [B16] and [W18] in per cent."""
    names = ("overall_accuracy", "kappa", "mean_class_recall", "mean_class_precision", "mean_f1")
    return {name: round(100 * getattr(accuracy, name), 2) for name in names}


def score(data: Path, scene: str, options: TrainingOptions, progress: bool) -> dict:
    """Train on the training part, classify the test part, compare."""
    timer = Timer()
    with timer("read"):
        xyz, labels, dimensions = read(data, scene, "train")
        test, truth, test_dimensions = read(data, scene, "test")
    with timer("height"):
        dimensions = with_height(xyz, dimensions)
        test_dimensions = with_height(test, test_dimensions)
    warm(options)
    with timer("train"):
        model = train([TrainingCloud(xyz, labels, dimensions, name=scene)], options, progress=progress)
    with timer("classify"):
        prediction = model.predict(test, test_dimensions, threads=options.threads)
    reference, merged = truth, MERGED[scene]
    classes: tuple[int, ...] = SCENES[scene]
    if options.strategy == "binary":
        reference = np.where(np.isin(truth, classes), options.background, 255)
        reference[truth == options.target] = options.target
        classes, merged = (options.background, options.target), None  # type: ignore[assignment]
    result = Accuracy.from_labels(reference, prediction.classification, classes=classes)
    one = [code for code in classes if code not in (3, 4)]
    joined = Accuracy.from_labels(reference, prediction.classification, classes=one, merge=merged)
    wall = timer.parts["classify"][0]
    out = {
        "scene": scene,
        "count": options.count,
        "features": len(model.plan.names),
        "dimensions": list(options.dimensions),
        "prior_weight": options.prior_weight,
        "strategy": options.strategy,
        "target": options.target,
        **figures(result),
        "f1": {str(one.code): round(100 * (one.f1 or 0), 2) for one in result.per_class},
        "merged": figures(joined) if merged else None,
        "cross_validated": (model.info["accuracy"]["cross_validation"] or {}).get("chosen"),
        "train_points": len(xyz),
        "samples": sum(entry["samples"] for entry in model.info["classes"]),
        "duplicates": sum(entry["duplicates"] for entry in model.info["classes"]),
        "test_points": len(test),
        "points_per_second": round(len(test) / wall),
        "seconds": timer.rounded(),
        "train_seconds": {k: round(v, 1) for k, v in model.seconds.items()},
        "forest": model.manifest()["passes"][-1]["parameters"],
        "largest_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "importance": {k: round(v, 4) for k, v in model.importances("neighborhood").items()},
    }
    show(out)
    return out


def show(out: dict) -> None:
    what = f"{out['scene']}, {out['count']:,} per class, {out['features']} features"
    if out["strategy"] == "binary":
        what += f", {out['target']} against the rest"
    print(f"\n{what}")
    for label, row in (("", out), ("merged 3,4,5", out["merged"])):
        if row:
            print(
                f"  {label or 'test part':<13} OA {row['overall_accuracy']:.2f}  kappa {row['kappa']:.2f}  "
                f"recall {row['mean_class_recall']:.2f}  precision {row['mean_class_precision']:.2f}  "
                f"F1 {row['mean_f1']:.2f}"
            )
    print("  F1 by class   " + "  ".join(f"{code}: {value:.2f}" for code, value in out["f1"].items()))
    seconds = ", ".join(f"{k} {v['wall']:.1f} s (CPU {v['cpu']:.1f})" for k, v in out["seconds"].items())
    print(f"  {seconds}; {out['points_per_second']:,} points/s; {out['largest_memory_mb']:,} MB", flush=True)


def warm(options: TrainingOptions) -> None:
    """Compile before anything is timed."""
    xyz = np.random.default_rng(0).random((400, 3)) * 10
    tiny = {"Intensity": xyz[:, 0], "HeightAboveGround": xyz[:, 2]}
    tiny |= {"ReturnNumber": np.ones(400, np.uint8), "NumberOfReturns": np.ones(400, np.uint8)}
    small = TrainingOptions(
        neighborhoods=options.neighborhoods,
        feature_set=options.feature_set,
        dimensions=options.dimensions,
        count=20,
        trees=2,
    )
    labels = np.where(xyz[:, 0] > 5, 2, 6)
    model = train([TrainingCloud(xyz, labels, tiny)], small, progress=False)
    model.predict(xyz, tiny)


# ---- command -----------------------------------------------------------------------------------------------


def number(text: str) -> str | int | float:
    """``sqrt``, ``56`` or ``0.1`` as what it means."""
    try:
        return float(text) if "." in text else int(text)
    except ValueError:
        return text


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--scene", nargs="+", choices=sorted(SCENES), default=sorted(SCENES, reverse=True))
    parser.add_argument("--count", nargs="+", type=int, default=[TrainingOptions.count])
    parser.add_argument("--neighborhoods", default="weinmann2018")
    parser.add_argument("--feature-set", default=",".join(TrainingOptions.feature_set))
    parser.add_argument("--dimensions", default="HeightAboveGround", help="comma-separated")
    parser.add_argument("--trees", type=int, default=TrainingOptions.trees)
    parser.add_argument("--leaf", type=int, default=TrainingOptions.min_samples_leaf)
    parser.add_argument("--prior-weight", type=float, default=TrainingOptions.prior_weight)
    parser.add_argument("--max-features", type=number, default=TrainingOptions.max_features)
    parser.add_argument("--target", type=int, help="binary: this class against the rest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--progress", action="store_true")
    args = parser.parse_args()
    if args.data is None:
        parser.error("name the folder of the clouds: --data DIR, or PDAL_STAGES_DATA")
    results = []
    for scene in args.scene:
        for count in args.count:
            options = TrainingOptions(
                neighborhoods=args.neighborhoods,
                feature_set=args.feature_set,
                dimensions=args.dimensions,
                classes=list(SCENES[scene]),
                strategy="multiclass" if args.target is None else "binary",
                target=args.target,
                count=count,
                trees=args.trees,
                min_samples_leaf=args.leaf,
                prior_weight=args.prior_weight,
                max_samples=1.0,
                max_features=args.max_features,
                seed=args.seed,
                threads=args.threads,
            )
            results.append(score(Path(args.data), scene, options, args.progress))
    if args.json:
        import numba
        import sklearn

        machine = {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scikit-learn": sklearn.__version__,
            "numba": numba.__version__,
            "cores": len(os.sched_getaffinity(0)),
        }
        args.json.write_text(json.dumps({"machine": machine, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
