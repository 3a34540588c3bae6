"""Markdown tables of results over seeds, beside published figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    lines = [
        "| " + " | ".join(head) + " |",
        "|" + "|".join([" --- "] + [" ---: "] * (len(head) - 1)) + "|",
    ]
    for row in rows:
        cells = [str(cell) for cell in row]
        if len(cells) != len(head):
            raise ValueError(f"{len(cells)} cells under {len(head)} heads: {cells}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def spread(values: Iterable[float], digits: int = 2) -> str:
    """Mean and, of several, the standard deviation (divisor n - 1): ``87.31 ± 0.12``."""
    array = np.array(list(values), float)
    if not len(array):
        return "–"
    if len(array) == 1:
        return f"{array[0]:.{digits}f}"
    return f"{array.mean():.{digits}f} ± {array.std(ddof=1):.{digits}f}"


def choose(runs: Iterable[Mapping[str, Any]], **wanted: Any) -> list[Mapping[str, Any]]:
    """The runs whose options are as wanted."""
    return [run for run in runs if all(run.get(key) == value for key, value in wanted.items())]


def values(runs: Iterable[Mapping[str, Any]], name: str, part: str | None = None) -> list[float]:
    """One figure of each run; `part` picks a class."""
    return [run[name] if part is None else run[name][part] for run in runs]
