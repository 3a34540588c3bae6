"""The model's accuracy on places it had not seen, in a few lines, from
``benchmarks/surveys/leave_one_out.py``.

python docs/survey_table.py        # prints what the README says
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MEASURED = ROOT / "benchmarks" / "results" / "surveys.json"


def table() -> str:
    """Return the means by group of surveys left out, as Markdown."""
    sys.path.insert(0, str(ROOT / "benchmarks" / "surveys"))
    from leave_one_out import group_table

    return group_table(json.loads(MEASURED.read_text(encoding="utf-8"))["surveys"]) + "\n"


if __name__ == "__main__":
    print(table(), end="")
