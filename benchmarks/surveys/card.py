"""Write the shipped model's card and its tables: docs/models.md, docs/results/surveys.md.

    python benchmarks/surveys/card.py

It reads the model and the figures in benchmarks/results, which leave_one_out.py and build.py wrote.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from leave_one_out import NAMES, at, group_table, survey_table
from recipe import (
    ABOVE,
    BELOW,
    DENSITIES,
    LINE_DENSITY,
    MOST,
    ONE_RETURN,
    OPTIONS,
    SHAPED_SAMPLES,
    TOWER_SAMPLES,
    WIRE_SAMPLES,
)
from sources import SOURCES
from surveys import GROUPS, SURVEYS

from pdal_stages.stages.preprocessing import PREPARATION, as_json

ROOT = Path(__file__).resolve().parents[2]
MODEL = ROOT / "pdal_stages" / "models" / "standard.model"
RESULTS = ROOT / "benchmarks" / "results"


def class_table(runs: list[dict[str, Any]]) -> str:
    """Return precision and recall by class and landscape as Markdown; surveys weigh alike."""
    heads = " | ".join(f"{name}: precision | recall" for name in NAMES.values())
    lines = [f"| landscape | {heads} |", f"|---|{'---:|' * 2 * len(NAMES)}"]
    for landscape in dict.fromkeys(survey.landscape for survey in SURVEYS.values()):
        cells, counts = [], []
        for number, code in enumerate(NAMES):
            shares = [
                np.array(run["matrix"]) / run["points"]
                for run in runs
                if SURVEYS[run["survey"]].landscape == landscape
                and SURVEYS[run["survey"]].tells(code)
            ]
            counts.append(len(shares))
            total = np.sum(shares, axis=0) if shares else np.zeros((len(NAMES), len(NAMES)))
            right = total[number, number]
            cells += [_percent(right, total[:, number].sum()), _percent(right, total[number].sum())]
        lines.append(f"| {landscape} ({max(counts)}) | {' | '.join(cells)} |")
    return "\n".join(lines)


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f}" if whole > 0 else "-"


def _per_mille(part: float, whole: float) -> str:
    return f"{1e3 * part / whole:.2f} ‰"


def list_tests(tests: list[dict[str, Any]]) -> str:
    """Return the scores of the shipped model on test parts, as a sentence."""
    scored = " and ".join(f"{run['cloud']} {run['oa']:.1f} %" for run in tests)
    return (
        "On test parts of two towns whose other parts it was trained on, it is right in "
        f"{scored} (scored once).\nElsewhere expect the figures of the groups."
    )


def describe_wires(scores: dict[str, list[dict[str, Any]]]) -> str:
    """Return what models find of wires and towers that they have not seen, as Markdown."""
    lines = [
        "| by models that have not seen them | points | found | false |",
        "|---|---:|---:|---:|",
    ]
    rows = []
    for name in ("wire", "tower"):
        for density in dict.fromkeys(row["density"] for row in scores["strips"]):
            strips = [row for row in scores["strips"] if row["density"] == density]
            title = f"{name}s of the labeled line, strip by strip, at {density:g}/m²"
            rows.append((title, name, strips))
    for row in scores["strands"]:
        rows.append((f"single strands hung over {row['survey']}", "wire", [row]))
    for title, each in {
        "single conductors": [row for row in scores["lines"] if row["conductors"] == 1],
        "two to four, 0.2 to 0.5 m apart": [
            row for row in scores["lines"] if row["close"] and row["conductors"] <= 4
        ],
        "three, 0.8 to 2.5 m apart": [
            row for row in scores["lines"] if row["conductors"] == 3 and not row["close"]
        ],
        "fourteen": [row for row in scores["lines"] if row["conductors"] > 4],
    }.items():
        rows.append((f"wires of lines set into others: {title}", "wire", each))
    for landscape in dict.fromkeys(row["landscape"] for row in scores["lines"] if row["tower"]):
        each = [row for row in scores["lines"] if row["landscape"] == landscape]
        wires = sum(row.get("tower beside", 0) for row in each)
        title = (
            f"towers of lines set into others: {landscape} ({wires} of the false points are wires)"
        )
        rows.append((title, "tower", each))
    for name in ("wire", "tower") if "crops" in scores else ():
        title = f"{name}s in helicopter scans of Portuguese lines, 80 to 100/m² (not trained on)"
        rows.append((title, name, scores["crops"]))
    for title, name, each in rows:
        there, found, false = (
            sum(row[key] for row in each) for key in (name, f"{name} found", f"{name} false")
        )
        lines.append(f"| {title} | {there:,} | {_percent(found, there)} % | {false:,} |")
    for wooded, title in ((False, "surveys without a line"), (True, "woods and slopes")):
        each = [row for row in scores["false"] if row["wooded"] == wooded]
        points = sum(row["points"] for row in each)
        words = [
            f"{name}s {_per_mille(sum(row[f'{name} false'] for row in each), points)}"
            for name in ("wire", "tower")
        ]
        worst = max(each, key=lambda row: row["wire false"] / row["points"])
        words.append(f"worst: {worst['cloud']}, {_per_mille(worst['wire false'], worst['points'])}")
        lines.append(f"| {title}, as flown and thinned | {points:,} | | {', '.join(words)} |")
    return "\n".join(lines)


def survey_list(runs: list[dict[str, Any]]) -> str:
    """Return what was trained on and judged by, as Markdown."""
    density = {run["survey"]: run["density"] for run in at(runs, None)}
    lines = [
        "| survey | what | group | points/m² | samples per copy | license | from |",
        "|---|---|---|---:|---:|---|---|",
    ]
    for name, survey in SURVEYS.items():
        origin = ", ".join(sorted({SOURCES[file]["repository"] for file in survey.files}))
        numbers = f"{density[name]} | {survey.samples:,}"
        lines.append(
            f"| {name} | {survey.what} | {survey.group} | {numbers} | (c) {survey.license} | "
            f"{origin} |"
        )
    return "\n".join(lines)


def pages() -> dict[Path, str]:
    """Return the pages by their files."""
    scores, tests, wires = (
        json.loads((RESULTS / f"{name}.json").read_text())
        for name in ("surveys", "surveys-tests", "wires")
    )
    runs = scores["surveys"]
    values = {
        "stage": as_json(PREPARATION),
        "passes": OPTIONS.passes,
        "trees": OPTIONS.trees,
        "voxel": OPTIONS.voxel,
        "size": MODEL.stat().st_size / 1e6,
        "digest": hashlib.sha256(MODEL.read_bytes()).hexdigest()[:16],
        "known": len(SURVEYS),
        "groups": len(GROUPS),
        "means": group_table(runs),
        "scores": survey_table(runs),
        "classes": class_table(at(runs, None)),
        "tests": list_tests(tests),
        "surveys": survey_list(runs),
        "count": OPTIONS.count,
        "wires": describe_wires(wires),
        "wire_samples": WIRE_SAMPLES,
        "tower_samples": TOWER_SAMPLES,
        "shaped_samples": SHAPED_SAMPLES,
        "line_density": LINE_DENSITY,
        "most": MOST,
        "above": ABOVE,
        "below": BELOW,
        "densities": ", ".join(f"{density:g}" for density in DENSITIES),
        "one_return": " and ".join(f"{density:g}" for density in ONE_RETURN),
    }
    templates = {"card.md": "models.md", "survey_tables.md": "results/surveys.md"}
    return {
        ROOT / "docs" / page: (Path(__file__).parent / template).read_text().format(**values)
        for template, page in templates.items()
    }


def main() -> None:
    for path, text in pages().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
