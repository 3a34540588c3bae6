"""What ``pdal-stages adapt`` gains on surveys that the shipped model has not seen.

    python benchmarks/surveys/adapting.py --data DIR --models MODELS [--json FILE] \\
        [--surveys Seville ...]

Each survey is classified by the model that has not seen it (MODELS is what ``leave_one_out.py
--save`` filled), that model is adapted to the survey, which shows no labels, and the survey is
classified again. Scored as in ``leave_one_out.py``, with all that ``classify`` does: noise and
decks.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import laspy
import numpy as np
from clouds import model_without, true_classes
from surveys import SURVEYS

from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.tiling.classify import ClassifyTask
from pdal_stages.tiling.train_survey import LEAST_RELIABILITY, adapt

CODES = (2, 5, 6)


def run(data: Path, survey: str, model: Path, sure: float, folder: Path) -> dict[str, Any]:
    """Overall accuracy and F1 by both models."""
    files, began = [str(data / name) for name in SURVEYS[survey].files], time.process_time()
    adapted = str(folder / "adapted.model")
    adapt(files, adapted, str(model), sure)
    seconds = time.process_time() - began
    found: dict[str, Any] = {"survey": survey, "adapting": round(seconds, 1)}
    for name, used in (("before", str(model)), ("after", adapted)):
        matrix, began = np.zeros((256, 256), np.int64), time.process_time()
        for number, file in enumerate(files):
            target = str(folder / f"{number}.laz")
            ClassifyTask((file,), target, ClassifyRequest(used)).run_whole()
            matrix += _confusion(survey, file, target)
        right, scored = int(matrix.diagonal().sum()), int(matrix.sum())
        f1 = {
            code: 200
            * int(matrix[code, code])
            / max(int(matrix[code].sum() + matrix[:, code].sum()), 1)
            for code in CODES
        }
        found[name] = {
            "oa": 100 * right / scored,
            "f1": f1,
            "seconds": round(time.process_time() - began, 1),
        }
        found["points"] = scored
    return found


def _confusion(survey: str, file: str, target: str) -> np.ndarray:
    known, given, made = SURVEYS[survey], laspy.read(file), laspy.read(target)
    codes = np.asarray(given.classification)
    truth = true_classes(
        known,
        np.asarray(given.x),
        np.asarray(given.y),
        codes,
        np.asarray(made["HeightAboveGround"]),
    )
    truth[np.isin(codes, known.dropped)] = 0
    matrix = np.zeros((256, 256), np.int64)
    np.add.at(matrix, (truth, np.asarray(made.classification)), 1)
    matrix[0] = 0
    return matrix


def table(rows: list[dict[str, Any]]) -> str:
    """As Markdown."""
    lines = [
        "| survey left out | points scored | OA | adapted | gain | F1 of vegetation | of buildings "
        "| adapting, CPU s |",
        "|---|---:|---:|---:|---:|---|---|---:|",
    ]
    for row in rows:
        one, two = row["before"], row["after"]
        pairs = [f"{one['f1'][code]:.1f} -> {two['f1'][code]:.1f}" for code in (5, 6)]
        lines.append(
            f"| {row['survey']} | {row['points']:,} | {one['oa']:.2f} | {two['oa']:.2f} | "
            f"{two['oa'] - one['oa']:+.2f} | "
            f"{' | '.join(pairs)} | {row['adapting']:.0f} |"
        )
    before, after = (
        float(np.mean([row[key]["oa"] for row in rows])) for key in ("before", "after")
    )
    lines.append(f"| **mean** | | {before:.2f} | {after:.2f} | {after - before:+.2f} | | | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    parser.add_argument("--models", type=Path, required=True, help="folder of the models left out")
    parser.add_argument("--surveys", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    parser.add_argument("--sure", type=float, default=LEAST_RELIABILITY)
    parser.add_argument("--json", type=Path, help="where the figures go")
    given = parser.parse_args()
    rows = []
    for survey in given.surveys:
        with TemporaryDirectory() as folder:
            rows.append(
                run(
                    given.data,
                    survey,
                    model_without(given.models, survey),
                    given.sure,
                    Path(folder),
                )
            )
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
