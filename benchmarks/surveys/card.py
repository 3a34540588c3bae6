"""The card of a shipped model: what it was trained on, how it does survey by survey, where it fails.

    python benchmarks/surveys/card.py --model pdal_stages/models/standard.model --scores FILE \\
        --unseen UNSEEN --places PLACES > docs/models.md

FILE is what leave_one_out.py wrote, UNSEEN what unseen.py wrote, PLACES what places.py wrote.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from leave_one_out import NAMES, THINNED, tables
from recipe import BELOW, DENSITIES, MOST, ONE_RETURN, OPTIONS, SLOPES
from sources import SOURCES
from surveys import SHIPPED, SURVEYS, UNLIKE

from pdal_stages import load_model
from pdal_stages.stages.preparation import PREPARATION, as_json


def at(runs: list[dict[str, Any]], density: float | None) -> list[dict[str, Any]]:
    """The runs of surveys as flown (None), or thinned to a density."""
    end = "" if density is None else f", {density:g} points per m2"
    return [run for run in runs if run["cloud"] == run["cloud"].split(",")[0] + end]


def by_class(runs: list[dict[str, Any]]) -> str:
    """A table for each class as Markdown: precision and recall by landscape and density, all surveys weighing alike."""
    lines, where = [], ("as flown", *(f"{density:g}/m²" for density in THINNED))
    for number, (code, name) in enumerate(NAMES.items()):
        heads = [f"{density}: precision | recall" for density in where]
        lines += [f"| **{name}** in | {' | '.join(heads)} |", f"|---|{'---:|' * 2 * len(heads)}"]
        for landscape in dict.fromkeys(survey.landscape for survey in SURVEYS.values()):
            cells, surveys = [], []
            for density in (None, *THINNED):
                shares = [
                    np.array(run["matrix"]) / run["points"]
                    for run in at(runs, density)
                    if (survey := SURVEYS[run["cloud"].split(",")[0]]).landscape == landscape
                    and survey.tells(code)
                ]
                surveys.append(str(len(shares)))
                total = np.sum(shares, axis=0) if shares else np.zeros((len(NAMES), len(NAMES)))
                right = total[number, number]
                cells += [
                    _percent(right, total[:, number].sum()),
                    _percent(right, total[number].sum()),
                ]
            lines.append(f"| {landscape} ({', '.join(surveys)}) | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines[:-1])


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f}" if whole > 0 else "-"


def seen(places: list[dict[str, Any]]) -> str:
    """The places of the picture, a line each, as Markdown."""
    return "\n".join(
        f"{number}. {one['survey']} ({one['x']}, {one['y']}; {one['points']:,} points): {one['truth']} called "
        f"{one['given']}. {one['seen']}"
        for number, one in enumerate(places, 1)
    )


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
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--model", type=Path, required=True)
    options.add_argument("--scores", type=Path, required=True)
    options.add_argument("--unseen", type=Path, required=True)
    options.add_argument("--places", type=Path, required=True)
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
            places=seen(json.loads(args.places.read_text())),
            means=means(unseen["surveys"]),
            classes=by_class([*scores["surveys"], *unseen["surveys"]]),
            unseen=tables(unseen["surveys"], []).replace("survey left out", "survey"),
            others=len(at(unseen["surveys"], None)),
            left=", ".join(UNLIKE),
            surveys="\n".join(surveys),
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
