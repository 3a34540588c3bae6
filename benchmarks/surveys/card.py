"""The card of a shipped model: what it was trained on, how it does survey by survey, where it fails.

    python benchmarks/surveys/card.py --model pdal_stages/models/standard.model --scores FILE --rules RULES > docs/models.md

FILE is what leave_one_out.py wrote, RULES what rules.py wrote.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
from leave_one_out import tables
from recipe import BELOW, DENSITIES, MOST, ONE_RETURN, OPTIONS, SLOPES
from rules import table
from surveys import SURVEYS

from pdal_stages import load_model
from pdal_stages.stages.preparation import PREPARATION, as_json


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--model", type=Path, required=True)
    options.add_argument("--scores", type=Path, required=True)
    options.add_argument("--rules", type=Path, required=True)
    args = options.parse_args()
    model, scores = load_model(args.model), json.loads(args.scores.read_text())
    surveys = [
        "| survey | what | labeled points | left out | samples per copy | license |",
        "|---|---|---:|---:|---:|---|",
    ]
    runs = {run["cloud"]: run for run in scores["surveys"]}
    for name, survey in SURVEYS.items():
        run = runs.get(name)  # none of a survey that was not left out
        numbers = f"{run['points']:,} | {run['contradicted']:,}" if run else "- | -"
        surveys.append(f"| {name} | {survey.what} | {numbers} | {survey.samples:,} | (c) {survey.license} |")
    worst = min(scores["surveys"], key=lambda run: run["oa"])
    own = [run["oa"] for run in scores["surveys"] if run["cloud"] in SURVEYS]
    print(
        Path(__file__)
        .with_suffix(".md")
        .read_text()
        .format(
            stage=as_json(PREPARATION),
            passes=len(model.passes),
            trees=OPTIONS.trees,
            fewer=scores["trees"],
            voxel=OPTIONS.voxel,
            size=args.model.stat().st_size / 1e6,
            digest=hashlib.sha256(args.model.read_bytes()).hexdigest()[:16],
            scored=len(own),
            known=len(SURVEYS),
            scores=tables(scores["surveys"], scores["isprs"]),
            read=f"At their own densities the mean is {np.mean(own):.1f}; the worst of all is {worst['cloud']}, "
            f"{worst['oa']:.1f}.",
            surveys="\n".join(surveys),
            rules=table(json.loads(args.rules.read_text())),
            count=OPTIONS.count,
            most=MOST,
            below=BELOW,
            densities=", ".join(f"{density:g}" for density in DENSITIES),
            one_return=" and ".join(f"{density:g}" for density in ONE_RETURN),
            slopes=f"{100 * max(slope for slope, *_ in SLOPES):.0f}",
        ),
        end="",
    )


if __name__ == "__main__":
    main()
