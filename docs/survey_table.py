"""The model's accuracy on surveys it had not seen, in a few lines, from ``benchmarks/surveys/leave_one_out.py``.

python docs/survey_table.py        # prints what the README says
"""

from __future__ import annotations

import json
from pathlib import Path
from statistics import mean

MEASURED = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "surveys.json"


def table() -> str:
    """Mean, best and worst survey at their own density, and the means of thinned copies."""
    rows = json.loads(MEASURED.read_text(encoding="utf-8"))["surveys"]
    own = [row for row in rows if "," not in row["cloud"]]
    best, worst = max(own, key=lambda row: row["oa"]), min(own, key=lambda row: row["oa"])
    of = f"best: {best['cloud']}, {best['oa']:.1f} %; worst: {worst['cloud']}, {worst['oa']:.1f} %"
    lines = [
        f"| {len(own)} surveys, each left out of training | points classified right |",
        "|---|---:|",
        f"| **mean** ({of}) | **{mean(row['oa'] for row in own):.1f} %** |",
    ]
    for density in ("4", "1"):
        thinned = [row["oa"] for row in rows if row["cloud"].endswith(f", {density} points per m2")]
        lines.append(
            f"| mean of {len(thinned)} thinned to {density} points/m² | {mean(thinned):.1f} % |"
        )
    later = json.loads(MEASURED.with_name("surveys-unseen.json").read_text(encoding="utf-8"))[
        "surveys"
    ]
    flown = sorted((row["oa"], row["cloud"]) for row in later if "," not in row["cloud"])
    told = ", ".join(f"{name} {oa:.1f} %" for oa, name in flown)
    lines.append(f"| {len(flown)} surveys unlike all others | {told} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    print(table(), end="")
