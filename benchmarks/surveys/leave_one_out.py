"""Leave one survey out: each survey classified by a model that was trained on all the others.

    python benchmarks/surveys/leave_one_out.py --data DIR --json FILE

Every survey at its own density and thinned to 4 and 1 points per square meter. OA and F1 over ground, vegetation and
building; low vegetation and what is none of the three is not scored. With --ground the ISPRS filter samples are scored
on ground alone, by a model of all surveys.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from clouds import Cloud, load, slug, thinned, with_heights
from folds import TREES, LeaveOneOut
from recipe import contradicted
from surveys import SHIPPED, SURVEYS

from pdal_stages import Model, TrainingCloud, load_model
from pdal_stages.accuracy import Accuracy
from pdal_stages.reports.views import png, triptych

#: Points per square meter that the surveys are thinned to.
THINNED = (4.0, 1.0)
SAMPLES = (11, 12, 21, 31, 41, 51, 54, 61)
NAMES = {2: "ground", 5: "vegetation", 6: "building"}


def score(model: Model, cloud: Cloud, pictures: Path | None = None) -> dict[str, Any]:
    """How well the model does on a cloud; with a picture of it where a folder for these is given."""
    found = model.predict(cloud.xyz, cloud.dimensions).classification
    if pictures is not None:
        shown = cloud.truth > 0
        drawn = triptych(*cloud.xyz[shown].T, found[shown], cloud.truth[shown])
        (pictures / f"standard-{cloud.name.replace(' ', '-')}.png").write_bytes(png(drawn))
    known = cloud.truth > 0
    codes = sorted(set(cloud.truth[known].tolist()) | {2, 5, 6})
    result = Accuracy.from_labels(cloud.truth[known], found[known], classes=codes)
    matrix = [
        [int(np.count_nonzero((cloud.truth == a) & (found == b))) for b in NAMES] for a in NAMES
    ]
    wrong = {
        f"{NAMES[a]} as {NAMES[b]}": matrix[i][j]
        for i, a in enumerate(NAMES)
        for j, b in enumerate(NAMES)
        if a != b
    }
    whole = TrainingCloud(cloud.xyz, cloud.truth, cloud.dimensions)
    gone = contradicted(whole)
    worst = max(wrong, key=lambda key: wrong[key])
    return {
        "cloud": cloud.name,
        "points": int(known.sum()),
        "density": round(cloud.density, 2),
        "oa": 100 * float(np.mean(found[known] == cloud.truth[known])),
        "f1": {
            NAMES[c]: 100 * f
            for c, f in result.f1.items()
            if f is not None and (cloud.truth == c).any()
        },
        "ground_as_building": 100 * wrong["ground as building"] / int(known.sum()),
        "contradicted": int(np.count_nonzero(gone)),
        "worst": worst,
        "share": 100 * wrong[worst] / int(known.sum()),
        "matrix": matrix,
    }


def ground_only(model: Model, data: Path, sample: int) -> dict[str, Any]:
    """Ground or not, on one of the ISPRS filter samples."""
    las = laspy.read(data / "isprs_filter" / f"samp{sample}.laz")
    xyz = np.column_stack([las.x, las.y, las.z]).astype(float)
    truth = np.asarray(las.classification).astype(np.uint8)
    cloud = with_heights(Cloud("ISPRS", f"samp{sample}", xyz, truth, truth, {}))
    found = model.predict(cloud.xyz, cloud.dimensions).classification == 2
    ground = truth == 2
    return {
        "cloud": cloud.name,
        "points": len(xyz),
        "density": round(cloud.density, 2),
        "total": 100 * float(np.mean(found != ground)),
        "type_1": 100 * float(np.mean(~found[ground])),
        "type_2": 100 * float(np.mean(found[~ground])),
    }


def tables(runs: list[dict[str, Any]], samples: list[dict[str, Any]]) -> str:
    """Both as Markdown."""
    lines = [
        "| survey left out | points/m2 | OA | F1 ground | vegetation | building | ground as building | what costs most |",
        "|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for run in runs:
        f1 = " | ".join(
            f"{run['f1'][name]:.1f}" if name in run["f1"] else "-" for name in NAMES.values()
        )
        lines.append(
            f"| {run['cloud']} | {run['density']} | {run['oa']:.1f} | {f1} | {run['ground_as_building']:.2f} % | "
            f"{run['worst']} ({run['share']:.1f} %) |"
        )
    lines.append(f"| **mean** | | **{np.mean([run['oa'] for run in runs]):.1f}** | | | | | |")
    if samples:
        lines += [
            "",
            "| ISPRS sample | points/m2 | total error | type I | type II |",
            "|---|---:|---:|---:|---:|",
        ]
        for one in samples:
            errors = f"{one['total']:.1f} | {one['type_1']:.1f} | {one['type_2']:.1f}"
            lines.append(f"| {one['cloud']} | {one['density']} | {errors} |")
        lines.append(f"| **mean** | | **{np.mean([one['total'] for one in samples]):.1f}** | | |")
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--json", type=Path, help="where the figures go")
    options.add_argument("--surveys", nargs="+", default=SHIPPED, choices=list(SURVEYS))
    options.add_argument("--trees", type=int, default=TREES, help="of a forest")
    options.add_argument("--ground", type=Path, help="model file to score on the ISPRS samples")
    options.add_argument(
        "--pictures", type=Path, help="folder for pictures of the surveys at their own density"
    )
    options.add_argument("--save", type=Path, help="folder for the models")
    args = options.parse_args()
    runs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        all_of_them = LeaveOneOut(args.data, args.surveys, Path(folder), args.trees)
        print(f"features: {time.process_time() - started:.0f} CPU s", flush=True)
        for left_out in args.surveys:
            started = time.process_time()
            model, cloud = all_of_them.without(left_out), load(args.data, left_out)
            if args.save:
                model.save(args.save / f"{slug(left_out)}.model")
            for one in (cloud, *(thinned(cloud, density) for density in THINNED)):
                if one is not None:
                    runs.append(score(model, one, args.pictures if one is cloud else None))
                    print(json.dumps(runs[-1]), flush=True)
            print(f"{left_out}: {time.process_time() - started:.0f} CPU s", flush=True)
    samples = []
    if args.ground:
        model = load_model(args.ground)
        samples = [ground_only(model, args.data, sample) for sample in SAMPLES]
    print(tables(runs, samples))
    if args.json:
        args.json.write_text(
            json.dumps({"trees": args.trees, "surveys": runs, "isprs": samples}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
