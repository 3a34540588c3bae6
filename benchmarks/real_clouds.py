"""The main job on real clouds, all through PDAL: train, classify, evaluate, and prove what is
unchanged.

Does what ``pdal-stages train`` and ``pdal-stages classify`` do, on the fixed train and test parts
of Montpellier (classes 2, 3, 4, 5, 6) and Delft (1, 2, 6). Test parts are scored, never fitted.

    python benchmarks/real_clouds.py --data FOLDER [--work FOLDER] [--only delft] [--json FILE]
        [--model-option neighborhoods=blomley2016 ...] [--pictures FOLDER]

``--pictures`` draws heights, classes and errors of the test parts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import laspy
import numpy as np

from pdal_stages import __version__
from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.pipeline.inputs_outputs import input_files
from pdal_stages.pipeline.json_source import parse_overrides
from pdal_stages.reports.pictures import triptych, write_png
from pdal_stages.tiling.train_survey import TrainTask

CLOUDS = {
    "montpellier": {
        "train": "train_*.laz",
        "test": "test_*.laz",
        "classes": "2,3,4,5,6",
        "merge": {"5": [3, 4]},
    },
    "delft": {"train": "train.laz", "test": "test.laz", "classes": "1,2,6", "merge": None},
}
#: Existing library at radii 1, 2, 3, 5 m, same height, 100 trees, 10,000 samples per class.
PEER = {"montpellier": (85.1, 79.2, 75.6, 90.7), "delft": (94.4, None, 93.5, None)}


def train(sources: str, model: Path, classes: str, more: list[str]) -> None:
    """A model of these files."""
    overrides, _ = parse_overrides(f"--writers.classifiermodel.{option}" for option in more)
    TrainTask(input_files([sources]), str(model), overrides, {"classes": classes}).run()


def job(name: str, options: argparse.Namespace, work: Path) -> dict:
    """Train and evaluate one cloud; figures and seconds."""
    spec, data = CLOUDS[name], Path(options.data) / name
    model = work / f"{name}.model"
    started = time.process_time()
    train(str(data / spec["train"]), model, spec["classes"], options.model_option)
    trained = time.process_time()
    total: Accuracy | None = None
    merged: Accuracy | None = None
    points = 0
    drawn = []
    for source in sorted(data.glob(str(spec["test"]))):
        target = work / f"classified_{source.name}"
        ClassifyRequest(str(model)).pipeline(str(source), str(target)).execute(arrays=False)
        points += unchanged(source, target)
        before, after = laspy.read(source), laspy.read(target)
        codes = [int(c) for c in str(spec["classes"]).split(",")]
        parts = (np.asarray(before.classification), np.asarray(after.classification))
        accuracy = Accuracy.from_labels(*parts, classes=codes)
        total = accuracy if total is None else total + accuracy
        if spec["merge"]:
            joined = Accuracy.from_labels(*parts, classes=[2, 5, 6], merge=spec["merge"])
            merged = joined if merged is None else merged + joined
        scored = np.isin(parts[0], codes)
        drawn.append(np.column_stack([before.xyz, *reversed(parts)])[scored])
    assert total is not None
    done = time.process_time()
    if options.pictures:
        x, y, z, labels, truth = np.concatenate(drawn).T
        picture = triptych(x, y, z, labels.astype(np.uint8), truth.astype(np.uint8))
        write_png(options.pictures / f"{name}-errors.png", picture)
    return {
        "overall_accuracy": total.overall_accuracy,
        "kappa": total.kappa,
        "mean_f1": total.mean_f1,
        "merged_overall_accuracy": merged.overall_accuracy if merged else None,
        "figures": total.to_dict(),
        "train_seconds": trained - started,
        "evaluate_seconds": done - trained,
        "points": points,
    }


def unchanged(source: Path, target: Path) -> int:
    """Point by point, everything but the class is as it was; the number of points."""
    before, after = laspy.read(source), laspy.read(target)
    assert str(before.header.version) == str(after.header.version)
    assert before.header.point_format.id == after.header.point_format.id
    assert np.array_equal(before.header.scales, after.header.scales)
    assert np.array_equal(before.header.offsets, after.header.offsets)
    for name in before.point_format.dimension_names:
        if name != "classification":
            assert np.array_equal(np.asarray(before[name]), np.asarray(after[name])), name
    return len(before)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument(
        "--work", default=".real-clouds", help="folder for models, clouds and reports"
    )
    parser.add_argument("--only", choices=list(CLOUDS))
    parser.add_argument("--json", help="write the figures here")
    parser.add_argument("--pictures", type=Path, help="folder for pictures")
    parser.add_argument("--model-option", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    if not options.data:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    work = Path(options.work)
    work.mkdir(parents=True, exist_ok=True)
    results = {}
    print(
        f"pdal_stages {__version__}, PDAL {'.'.join(map(str, pdal_env.version()))}, "
        f"{platform.platform()}"
    )
    for name in [options.only] if options.only else CLOUDS:
        results[name] = r = job(name, options, work)
        oa, kappa, f1, joined = PEER[name]
        print(
            f"{name}: OA {100 * r['overall_accuracy']:.2f} (peer {oa}), kappa "
            f"{100 * r['kappa']:.2f} (peer {kappa}), "
            f"mean F1 {100 * r['mean_f1']:.2f} (peer {f1})"
            + (
                f", 3-4-5 merged OA {100 * r['merged_overall_accuracy']:.2f} (peer {joined})"
                if joined
                else ""
            )
            + f"; {r['points']:,} points unchanged but for the class; train "
            f"{r['train_seconds']:.0f} CPU s, "
            f"classify and evaluate {r['evaluate_seconds']:.0f}",
            flush=True,
        )
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
