"""How far the heights of ground points are from zero: filters.hag_minima beside PDAL's own.

The ISPRS filter test samples have hand-made ground (class 2); a perfect terrain gives each
ground point the height 0. PDAL's filters.hag_nn and filters.hag_delaunay need a ground
classification, here from filters.smrf with its defaults, which is what a user without
labels has; the truth is used for scoring alone.

    python benchmarks/terrain.py --data FOLDER [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from pathlib import Path

import numpy as np

import pdal_stages as ps
from pdal_stages.pipeline import pdal as pdal_env

SMRF = [{"type": "filters.assign", "assignment": "Classification[:]=0"}, {"type": "filters.smrf"}]
METHODS: dict[str, list[dict]] = {
    "hag_minima": [{"type": "filters.hag_minima"}],
    "hag_minima, 10 m cells": [{"type": "filters.hag_minima", "cell": 10}],
    "smrf + hag_nn": [*SMRF, {"type": "filters.hag_nn"}],
    "smrf + hag_delaunay": [*SMRF, {"type": "filters.hag_delaunay"}],
}


def measure(path: Path) -> dict[str, dict[str, float]]:
    """Mean and 95th percentile of the absolute height of ground points, and their mean height."""
    out = {}
    for name, stages in METHODS.items():
        pipeline = ps.Pipeline(
            [str(path), {"type": "filters.ferry", "dimensions": "Classification=>Reference"}, *stages]
        )
        try:
            pipeline.execute()
        except ps.StageError as error:  # PDAL 2.2's hag_delaunay stops at collinear neighbors
            out[name] = {"error": str(error.found)}
            continue
        array = pipeline.arrays[0]
        height = array["HeightAboveGround"][array["Reference"] == 2]
        out[name] = {
            "mean_absolute": float(np.abs(height).mean()),
            "p95_absolute": float(np.percentile(np.abs(height), 95)),
            "bias": float(height.mean()),
        }
    return out


def _cell(figures: dict) -> str:
    if "error" in figures:
        return figures["error"]
    return f"{figures['mean_absolute']:.2f} / {figures['p95_absolute']:.2f}"


def _mean(results: dict, method: str) -> str:
    rows = [r[method] for r in results.values() if "error" not in r[method]]
    if not rows:
        return "none"
    means = [np.mean([r[key] for r in rows]) for key in ("mean_absolute", "p95_absolute")]
    return f"{means[0]:.2f} / {means[1]:.2f}" + (
        f" ({len(rows)} of {len(results)})" if len(rows) < len(results) else ""
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", default=os.environ.get("PDAL_STAGES_DATA"), help="folder with isprs_filter/"
    )
    parser.add_argument("--json", help="write the figures here")
    options = parser.parse_args()
    if not options.data:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    results = {}
    for path in sorted(Path(options.data, "isprs_filter").glob("*.laz")):
        results[path.stem] = measure(path)
    print(
        f"PDAL {'.'.join(map(str, pdal_env.version()))}, {platform.machine()}; metres, |height| of true ground points\n"
    )
    print("| sample |" + "".join(f" {m}: mean / 95 % |" for m in METHODS))
    print("|---|" + "---:|" * len(METHODS))
    for name, row in results.items():
        print(f"| {name} |" + "".join(f" {_cell(row[m])} |" for m in METHODS))
    print("| mean |" + "".join(f" {_mean(results, m)} |" for m in METHODS))
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
