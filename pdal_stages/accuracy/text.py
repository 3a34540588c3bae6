"""Measures of a comparison as text tables; see ``measures`` for what a new one needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from ..base.json_types import JsonObject

#: Measures of the tables of several files.
_MAIN = ("overall_accuracy", "kappa", "mean_f1")


class Measured(Protocol):
    """Measures of accuracy, as :class:`.measures.Accuracy` has them."""

    @property
    def points(self) -> int:
        """Number of points that were compared."""


def percent(share: float | None, digits: int = 2) -> str:
    """Return a share in percent, without its sign; ``-`` where it is not defined."""
    return "-" if share is None else f"{100 * share:.{digits}f}"


def summary(accuracy: Measured) -> JsonObject:
    """Return the main measures of an ``Accuracy``, None without points."""
    shares = {name: getattr(accuracy, name) if accuracy.points else None for name in _MAIN}
    return {"points": accuracy.points, **shares}


def by_file(names: Sequence[str], each: Sequence[Measured]) -> str:
    """Return a table with a line for each file, the worst first."""
    rows = [(name, summary(accuracy)) for name, accuracy in zip(names, each, strict=True)]
    # Files without points to compare come last.
    rows.sort(key=lambda row: (not row[1]["points"], row[1]["overall_accuracy"], row[0]))
    header = ["", "File", "Points", "Accuracy %", "Kappa %", "Mean F1 %"]
    lines = [
        ["", name, f"{d['points']:,}", *(percent(d[key]) for key in _MAIN)] for name, d in rows
    ]
    return _aligned(header, lines) + "\n"


def table(figures: JsonObject, name: Callable[[int], str]) -> str:
    """Return the measures of ``Accuracy.to_dict`` as aligned text, in percent."""
    blocks = [_headline(figures, name), _classes(figures), _confusion(figures["confusion"])]
    if rated := figures["reliability"]:
        mean, error = (percent(rated[key]) for key in ("mean", "expected_calibration_error"))
        blocks.append(f"Reliability: mean {mean} %, expected calibration error {error} %")
    return "\n\n".join(blocks)


def _headline(d: JsonObject, name: Callable[[int], str]) -> str:
    lines = [f"{'Points compared':<22}{d['points']:>14,}"]
    for key, label in (
        ("overall_accuracy", "Overall accuracy"),
        ("kappa", "Cohen's kappa"),
        ("mean_class_recall", "Mean class recall"),
        ("mean_class_precision", "Mean class precision"),
        ("mean_f1", "Mean F1"),
        ("mean_iou", "Mean IoU"),
    ):
        lines.append(f"{label:<22}{percent(d[key]):>14}{' %' if d[key] is not None else ''}")
    left, outside = d["left_out"], d["predicted_outside_reference"]
    if left["points"]:
        which = ", ".join(
            f"{code} {name(int(code))}: {n:,}" for code, n in left["by_class"].items()
        )
        lines.append(f"{'Left out':<22}{left['points']:>14,}   (reference class {which})")
    if d["merged"]:
        pairs = ", ".join(f"{code} as {target}" for code, target in d["merged"].items())
        lines.append(f"{'Merged':<22}{pairs:>14}")
    if outside["classes"]:
        which = ", ".join(f"{c['code']} {c['name']}" for c in outside["classes"])
        lines.append(
            f"{'Outside the classes':<22}{outside['points']:>14,}   (counted as errors: {which})"
        )
    return "\n".join(lines)


def _classes(d: JsonObject) -> str:
    header = ["", "Class", "Reference", "Predicted", "Recall %", "Precision %", "F1 %", "IoU %"]
    rows = [
        [str(f["code"]), f["name"], f"{f['support']:,}", f"{f['predicted']:,}"]
        + [percent(f[key]) for key in ("recall", "precision", "f1", "iou")]
        for f in d["classes"]
    ]
    return _aligned(header, rows)


def _confusion(d: JsonObject) -> str:
    known = len(d["rows"])
    header = [
        "",
        "Reference",
        *(f"{c['code']}{'*' * (i >= known)}" for i, c in enumerate(d["columns"])),
    ]
    rows = [
        [str(c["code"]), c["name"], *map(percent, values)]
        for c, values in zip(d["rows"], d["by_reference"], strict=True)
    ]
    text = "Confusion: rows reference, columns prediction, % of the reference class; "
    note = "\n* not a class of the reference" * (len(d["columns"]) > known)
    return f"{text}the diagonal is recall\n{_aligned(header, rows)}{note}"


def _aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return text in columns, the second aligned to the left, all others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [
            c.ljust(w) if i == 1 else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append((" ".join(cells[:2]) + "  " + "  ".join(cells[2:])).rstrip())
    lines.insert(1, "-" * max(map(len, lines)))
    return "\n".join(lines)
