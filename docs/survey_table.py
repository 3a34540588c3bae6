"""The short table of surveys that a model had not seen, from what ``benchmarks/surveys/leave_one_out.py`` measured.

python docs/survey_table.py        # writes docs/surveys-not-seen.inc
"""

from __future__ import annotations

import json
from pathlib import Path

DOCS = Path(__file__).resolve().parent
MEASURED = DOCS.parent / "benchmarks" / "results" / "surveys.json"
TARGET = DOCS / "surveys-not-seen.inc"
#: Where the surveys are, and what is there.
PLACES = {
    "Montpellier": "France, city",
    "Delft": "Netherlands, old town",
    "Seville": "Spain, old town",
    "hamlet": "France, hamlet on a slope",
    "farm": "France, farm",
    "power line": "Netherlands, corridor",
    "bank": "France, wooded bank",
    "town's edge": "France, edge of a town",
    "bridges": "France, countryside",
    "meadows": "Netherlands, meadows and farms",
    "pines": "Florida, pine forest",
}


def table() -> str:
    """One row a survey at its own density, the mean last."""
    rows = [
        row for row in json.loads(MEASURED.read_text(encoding="utf-8"))["surveys"] if "," not in row["cloud"]
    ]
    lines = ["| survey left out | points per m² | points classified right |", "|---|---:|---:|"]
    lines += [
        f"| {row['cloud']} ({PLACES[row['cloud']]}) | {row['density']:.1f} | {row['oa']:.1f} % |"
        for row in rows
    ]
    mean = sum(row["oa"] for row in rows) / len(rows)
    return "\n".join([*lines, f"| **mean of {len(rows)}** | | **{mean:.1f} %** |", ""])


def write() -> None:
    """Write what the first page includes."""
    TARGET.write_text(table(), encoding="utf-8")


if __name__ == "__main__":
    write()
