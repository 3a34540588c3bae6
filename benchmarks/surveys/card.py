"""The card of a shipped model: what it was trained on, how it does survey by survey, where it fails.

    python benchmarks/surveys/card.py --model pdal_stages/models/standard.model --scores FILE --rules RULES \\
        --unseen UNSEEN > docs/models.md

FILE is what leave_one_out.py wrote, RULES what rules.py wrote, UNSEEN what unseen.py wrote.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from leave_one_out import NAMES, tables
from recipe import BELOW, DENSITIES, MOST, ONE_RETURN, OPTIONS, SLOPES
from rules import table
from sources import SOURCES
from surveys import SHIPPED, SURVEYS
from unseen import THINNED

from pdal_stages import load_model
from pdal_stages.stages.preparation import PREPARATION, as_json


def at(runs: list[dict[str, Any]], density: float | None) -> list[dict[str, Any]]:
    """The runs of surveys as flown (None), or thinned to a density."""
    end = "" if density is None else f", {density:g} points per m2"
    return [run for run in runs if run["cloud"] == run["cloud"].split(",")[0] + end]


def by_landscape(runs: list[dict[str, Any]]) -> str:
    """Precision and recall of each class, by landscape and density, as Markdown: all surveys weigh alike."""
    heads = [f"{name} {kind}" for name in NAMES.values() for kind in ("precision", "recall")]
    lines = [
        f"| landscape | points/m2 | surveys | {' | '.join(heads)} |",
        f"|---|---|---:|{'---:|' * len(heads)}",
    ]
    for landscape in sorted({survey.landscape for survey in SURVEYS.values()}):
        for density in (None, *THINNED):
            shares = [
                np.array(run["matrix"]) / run["points"]
                for run in at(runs, density)
                if SURVEYS[run["cloud"].split(",")[0]].landscape == landscape
            ]
            if shares:
                mean = np.mean(shares, axis=0)
                right = np.diag(mean)
                labeled = mean.sum(axis=1)
                both = (_percent(right, np.where(labeled > 0, mean.sum(axis=axis), 0)) for axis in (0, 1))
                cells = " | ".join(cell for pair in zip(*both, strict=True) for cell in pair)
                where = "as flown" if density is None else f"{density:g}"
                lines.append(f"| {landscape} | {where} | {len(shares)} | {cells} |")
    return "\n".join(lines)


def _percent(part: np.ndarray, whole: np.ndarray) -> list[str]:
    return [f"{100 * a / b:.1f}" if b > 0 else "-" for a, b in zip(part, whole, strict=True)]


def means(runs: list[dict[str, Any]]) -> str:
    """Mean, median and worst of all surveys, as flown and at each density, as Markdown."""
    lines = ["| points/m2 | surveys | mean OA | median | worst |", "|---|---:|---:|---:|---|"]
    for density in (None, *THINNED):
        some = at(runs, density)
        oa, worst = [run["oa"] for run in some], min(some, key=lambda run: run["oa"])
        where = "as flown" if density is None else f"{density:g}"
        told = f"{np.mean(oa):.1f} | {np.median(oa):.1f} | {worst['cloud'].split(',')[0]}, {worst['oa']:.1f}"
        lines.append(f"| {where} | {len(some)} | {told} |")
    return "\n".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--model", type=Path, required=True)
    options.add_argument("--scores", type=Path, required=True)
    options.add_argument("--rules", type=Path, required=True)
    options.add_argument("--unseen", type=Path, required=True)
    args = options.parse_args()
    model, scores = load_model(args.model), json.loads(args.scores.read_text())
    unseen = json.loads(args.unseen.read_text())
    surveys = [
        "| survey | what | points/m2 | labeled points | left out | samples per copy | license | from |",
        "|---|---|---:|---:|---:|---:|---|---|",
    ]
    own = [run["oa"] for run in at(scores["surveys"], None)]
    worst = min(scores["surveys"], key=lambda run: run["oa"])
    runs = {run["cloud"]: run for run in [*scores["surveys"], *unseen["surveys"]]}
    for name, survey in SURVEYS.items():
        run = runs[name]
        numbers = f"{run['density']} | {run['points']:,} | {run['contradicted']:,}"
        origin = ", ".join(sorted({SOURCES[file]["repository"] for file in survey.files}))
        surveys.append(
            f"| {name} | {survey.what} | {numbers} | {survey.samples:,} | (c) {survey.license} | {origin} |"
        )
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
            known=len(SHIPPED),
            scores=tables(scores["surveys"], scores["isprs"]),
            read=f"At their own densities the mean is {np.mean(own):.1f}; the worst of all is {worst['cloud']}, "
            f"{worst['oa']:.1f}.",
            places="; ".join(unseen["places"]),
            means=means(unseen["surveys"]),
            landscapes=by_landscape(unseen["surveys"]),
            unseen=tables(unseen["surveys"], []).replace("survey left out", "survey"),
            others=len(at(unseen["surveys"], None)),
            shipped=len(SHIPPED),
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
