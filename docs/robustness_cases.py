"""The table of what goes wrong on purpose, listed from the tests themselves.

python docs/robustness_cases.py        # writes docs/robustness-cases.md
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "robustness-cases.md"


def collected() -> dict[str, dict[str, list[str]]]:
    """Return the cases of each test of each file of the matrix, as pytest finds them."""
    found = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "--collect-only",
            "-q",
            "-n",
            "0",
            "-p",
            "no:cacheprovider",
            "tests/robustness",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if found.returncode:
        raise RuntimeError(
            f"pytest could not list the tests: {(found.stderr or found.stdout).strip()}. Install them: pip install '.[docs]'"
        )
    files: dict[str, dict[str, list[str]]] = {}
    for file, test, case in re.findall(
        r"^tests/robustness/test_robust_(\w+)\.py::test_(\w+)(?:\[(.*)\])?$", found.stdout, re.MULTILINE
    ):
        files.setdefault(file, {}).setdefault(test, []).extend([case] if case else [])
    return files


def page() -> str:
    """The page, one section a file of tests, one row a test."""
    files = collected()
    count = sum(max(len(cases), 1) for tests in files.values() for cases in tests.values())
    lines = [
        "# Cases of the robustness tests",
        "",
        f"{count} cases, from `pytest --collect-only tests/robustness`.",
        "",
    ]
    for file, tests in files.items():
        lines += [f"## {file.replace('_', ' ').capitalize()}", "", "| test | cases |", "|---|---|"]
        lines += [
            f"| {test.replace('_', ' ')} | {_plain('; '.join(cases))} |" for test, cases in tests.items()
        ] + [""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text that Markdown leaves as it is."""
    return re.sub(r"([|*_<\[\]`])", r"\\\1", text)


def write() -> None:
    """Write the page beside the others."""
    TARGET.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    write()
