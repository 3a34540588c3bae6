"""Mobile scans (Oakland 3-D): today's defaults, settings chosen for such scans, and passes on [H17]'s own features.

    python benchmarks/mobile.py --data FOLDER [--part val|test] [--only NAME ...] [--results FILE] [--page FILE]

FOLDER holds oakland/train, val and test. Trained on train, classified and scored through PDAL; points of class 0 are left
out, as neighbors too, as [H17] does, but for the trainings "all points": there they are neighbors, as they are for the
commands `train` and `classify`. They are never scored. The settings were chosen by their scores on val. What is run joins
the results, and the page is made of all of these.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import pdal_stages as ps

ROOT = Path(__file__).resolve().parent
CLASSES = {2: "ground", 5: "vegetation", 6: "facade", 14: "wire", 15: "pole"}
SIX = "Verticality,HeightRange,Linearity,Planarity,Scattering,SurfaceVariation"
#: [H17]: six features of one curvature-adaptive neighborhood, 1,000 points of each class, 200 trees, no heights, no voxels.
HE2017: dict[str, Any] = {
    "neighborhoods": "copt", "feature_set": SIX, "dimensions": [], "voxel": 0, "prior_weight": 0,
    "count": 1000, "trees": 200, "contradicted_below": 0,
}  # fmt: skip
#: What was default when the figures of two passes were made.
FORMER: dict[str, Any] = {"count": 10_000, "context": "own,box1,columnvotes2,columnvotes8"}
CHOSEN: dict[str, Any] = {
    "neighborhoods": "s1,s2,k10,k20,k50,kopt",
    "voxel": 0.05,
    "prior_weight": 0,
    **FORMER,
}
#: By name: options of training, and what they are in words.
SETTINGS: dict[str, tuple[dict[str, Any], str]] = {
    "defaults": ({}, "all defaults"),
    "defaults, all points": ({}, "all defaults, points without a label are neighbors"),
    "chosen": (CHOSEN, "`neighborhoods` s1,s2,k10,k20,k50,kopt; `voxel` 0.05; `prior_weight` 0"),
    "chosen, all points": (CHOSEN, "the same, points without a label are neighbors"),
    "chosen, both": (CHOSEN, "the same without them, trained on the validation cloud too"),
    "he2017": ({**HE2017, "passes": 1}, "[H17]'s six features of v_c, one pass"),
    "he2017, heights": (
        {"neighborhoods": "copt", "feature_set": SIX, **FORMER},
        "[H17]'s six features of v_c, all else default (two passes, heights)",
    ),
    "he2017, two passes": ({**FORMER, **HE2017, "passes": 2}, "[H17]'s six features of v_c, two passes"),
}
HEIGHTS = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
LABELED = {"type": "filters.range", "limits": "Classification![0:0]"}


def score(
    data: Path, part: str, settings: dict[str, Any], trained_on: tuple[str, ...], all_points: bool
) -> dict[str, Any]:
    """Overall accuracy, mean F1 and F1 of each class, per cent, and CPU seconds."""
    chosen = [] if all_points else [LABELED]
    with tempfile.TemporaryDirectory() as folder:
        model = str(Path(folder) / "mobile.model")
        classes = {str(code): code for code in CLASSES}
        began = time.process_time()
        sources = [str(path) for one in trained_on for path in sorted(data.glob(f"oakland/{one}/*.laz"))]
        writer = {"type": "writers.classifiermodel", "filename": model, "classes": classes, **settings}
        ps.run_pipeline([*sources, *chosen, HEIGHTS, writer])
        trained = time.process_time()
        truth, found = [], []
        keep = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
        classify = {"type": "filters.modelclassifier", "model": model}
        for source in sorted(data.glob(f"oakland/{part}/*.laz")):
            pipeline = ps.Pipeline([str(source), *chosen, keep, HEIGHTS, classify])
            pipeline.execute()
            truth.append(pipeline.arrays[0]["Reference"].astype(int))
            found.append(pipeline.arrays[0]["Classification"].astype(int))
        ended = time.process_time()
    a, b = np.concatenate(truth), np.concatenate(found)
    a, b = a[a != 0], b[a != 0]
    f1 = {
        name: 200 * float(((a == code) & (b == code)).sum() / ((a == code).sum() + (b == code).sum()))
        for code, name in CLASSES.items()
    }
    return {
        "points": len(a),
        "oa": 100 * float((a == b).mean()),
        "mean_f1": float(np.mean(list(f1.values()))),
        "f1": f1,
        "training_cpu": trained - began,
        "classifying_cpu": ended - trained,
    }


def page(results: dict[str, Any]) -> str:
    """All results as Markdown."""
    text = ["# Mobile scans", "", "Written by `benchmarks/mobile.py`; per cent.", ""]
    for part, words in (
        ("val", "Validation cloud, which chose the settings"),
        ("test", "The 15 test clouds"),
    ):
        found = results.get(part, {})
        if not found:
            continue
        head = ["Training", "OA", "Mean F1", *CLASSES.values(), "CPU s, training", "classifying"]
        text += [f"## {words}", "", f"| {' | '.join(head)} |", f"| --- |{' ---: |' * (len(head) - 1)}"]
        for name, (_, described) in SETTINGS.items():
            if name in found:
                one = found[name]
                figures = [one["oa"], one["mean_f1"], *one["f1"].values()]
                seconds = [f"{one[key]:.0f}" for key in ("training_cpu", "classifying_cpu")]
                text.append(f"| {' | '.join([described, *(f'{v:.1f}' for v in figures), *seconds])} |")
        text.append("")
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--part", default="test", choices=("val", "test"))
    parser.add_argument("--only", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "mobile.json")
    parser.add_argument("--page", type=Path, default=ROOT.parent / "docs" / "papers" / "mobile.md")
    options = parser.parse_args()
    if options.data is None:
        parser.error("name the folder of the clouds: --data DIR, or PDAL_STAGES_DATA")
    for name in options.only:
        trained_on = ("train", "val") if name.endswith("both") else ("train",)
        if options.part in trained_on:
            continue
        one = score(
            Path(options.data), options.part, SETTINGS[name][0], trained_on, name.endswith("all points")
        )
        print(
            f"{options.part}, {name}: OA {one['oa']:.1f}, mean F1 {one['mean_f1']:.1f} {one['f1']}",
            flush=True,
        )
        results = json.loads(options.results.read_text()) if options.results.exists() else {}
        results.setdefault(options.part, {})[name] = one
        options.results.write_text(json.dumps(results, indent=1) + "\n")
        options.page.write_text(page(results))


if __name__ == "__main__":
    main()
