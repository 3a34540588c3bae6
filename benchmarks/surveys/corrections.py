"""What corrections are worth: a simulated operator on surveys that the model has not seen.

    python benchmarks/surveys/leave_one_out.py --data DIR --save MODELS
    python benchmarks/surveys/corrections.py --data DIR --models MODELS \\
        [--surveys Seville Delft] [--json FILE]

Three times he reviews the classified file, corrects the five worst patches that he has not seen to
the true classes (which he knows), marks them as looked at, and trains on top of the model with all
that he has checked so far; then the file is classified again. The accuracy is of the ground that he
touched in no round, the same ground after each. All by the commands.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import shapely
from clouds import model_without, true_classes
from surveys import SURVEYS

from pdal_stages import cli
from pdal_stages.base.vector import points_inside
from pdal_stages.pipeline.spatial_reference import reference_of_file
from pdal_stages.reports.vector_files import Layer, write_layers
from pdal_stages.review.review_files import review_files, review_layers

ROUNDS, PATCHES = 3, 5


def run(*words: object) -> None:
    """A command, which must succeed."""
    assert cli.main([str(word) for word in words]) == 0, words


def corrected(before: Path, after: Path, truth: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Write a file in which points `inside` have their true classes: the new classes.

    What has none of these three, but was given one, he leaves unclassified.
    """
    las = laspy.read(before)
    codes = np.asarray(las.classification).copy()
    known = inside & (truth > 0)
    codes[inside & ~known & np.isin(codes, (2, 5, 6))] = 1
    codes[known] = truth[known]
    las.classification = codes
    las.write(after)
    return codes


def rounds(data: Path, name: str, model: Path, folder: Path) -> dict[str, Any]:
    """Accuracies of the untouched ground before and after each round."""
    survey = SURVEYS[name]
    (file,) = survey.files
    las = laspy.read(data / file)
    las.points = las.points[~np.isin(las.classification, survey.dropped)]
    raw, before = folder / "raw.laz", folder / "classified0.laz"
    las.write(raw)
    run("classify", raw, before, "--model", model, "--no-progress")
    start = laspy.read(before)
    x, y = np.asarray(start.x), np.asarray(start.y)
    truth = true_classes(
        survey, x, y, np.asarray(las.classification), np.asarray(start["HeightAboveGround"])
    )
    touched = np.zeros(len(x), bool)
    given = [np.asarray(start.classification).copy()]
    done: list[Any] = []
    told, checked_file = [], before
    for number in range(1, ROUNDS + 1):
        found = review_files([str(before)])
        shapes = review_layers(found)["patches"].shapes
        seen = shapely.union_all(done)
        fresh = [
            k for k, shape in enumerate(shapes) if shape.difference(seen).area > 0.5 * shape.area
        ]
        chosen = fresh[:PATCHES]
        done += [shapes[k] for k in chosen]
        told.append([found.patches.reason[k] for k in chosen])
        mine = points_inside(x, y, [shapes[k] for k in chosen])
        touched |= mine
        corrected(checked_file, folder / "after.laz", truth, mine)
        area = folder / f"area{number}.gpkg"
        write_area(area, [shapes[k] for k in chosen], reference_of_file(str(before)).wkt)
        checked = folder / f"checked{number}.laz"
        run(
            "corrections",
            checked_file,
            folder / "after.laz",
            "--area",
            area,
            "--around",
            0,
            "--out",
            checked,
        )
        made = folder / f"round{number}.model"
        run(
            "train",
            checked,
            "--base",
            model,
            "--classes",
            "2,5,6",
            "--model",
            made,
            "--no-progress",
        )
        before, checked_file = folder / f"classified{number}.laz", checked
        run("classify", raw, before, "--model", made, "--no-progress")
        given.append(np.asarray(laspy.read(before).classification).copy())
    scored = ~touched & (truth > 0)
    return {
        "survey": name,
        "touched": float(np.mean(touched)),
        "scored": int(scored.sum()),
        "accuracy": [100 * float(np.mean(codes[scored] == truth[scored])) for codes in given],
        "reasons": told,
    }


def write_area(path: Path, shapes: list[Any], wkt: str) -> None:
    """The patches that were looked at."""
    done = {"done": np.ones(len(shapes), np.int32)}
    write_layers(path, {"patches": Layer(shapes, "MultiPolygon", done)}, wkt, {})


def table(rows: list[dict[str, Any]]) -> str:
    """As Markdown."""
    heads = ["before", *(f"round {k}" for k in range(1, ROUNDS + 1))]
    lines = [
        f"| survey left out | points corrected or seen | points scored | {' | '.join(heads)} |",
        "|---|---:|---:|" + "---:|" * len(heads),
    ]
    for row in rows:
        scores = " | ".join(f"{value:.2f} %" for value in row["accuracy"])
        lines.append(
            f"| {row['survey']} | {100 * row['touched']:.1f} % | {row['scored']:,} | {scores} |"
        )
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models", type=Path, required=True, help="folder that leave_one_out.py --save filled"
    )
    one_file = [name for name, survey in SURVEYS.items() if len(survey.files) == 1]
    options.add_argument("--surveys", nargs="+", default=["Seville", "Delft"], choices=one_file)
    options.add_argument("--json", type=Path, help="where the figures go")
    args = options.parse_args()
    rows = []
    for name in args.surveys:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(rounds(args.data, name, model_without(args.models, name), Path(folder)))
        print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
