"""An :class:`~pdal_stages.accuracy.measures.Accuracy` as JSON types and as a console table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..base.errors import OptionError, suggest

if TYPE_CHECKING:
    from .confidence import Grading
    from .measures import Accuracy

CONFUSION = ("by_reference", "by_prediction", "counts", "none")


def as_dict(accuracy: Accuracy) -> dict[str, Any]:
    """See :meth:`pdal_stages.accuracy.measures.Accuracy.to_dict`."""
    from .measures import FORMAT, VERSION

    def named(codes: Sequence[int]) -> list[dict[str, Any]]:
        return [{"code": c, "name": accuracy.name(c)} for c in codes]

    figures = []
    for f in accuracy.per_class:
        entry = dict(vars(f))
        for key in ("recall_interval", "precision_interval"):
            entry[key] = None if entry[key] is None else list(entry[key])
        figures.append(entry)
    return {
        "format": FORMAT,
        "version": VERSION,
        "points": accuracy.points,
        "correct": accuracy.correct,
        "left_out": {
            "points": accuracy.left_out_points,
            "by_class": {str(c): n for c, n in accuracy.left_out.items()},
        },
        "merged": {str(c): t for c, t in sorted(accuracy.merged.items())},
        "predicted_outside_reference": {"points": accuracy.extra_points, "classes": named(accuracy.extra)},
        "overall_accuracy": accuracy.overall_accuracy,
        "overall_accuracy_interval": list(accuracy.overall_accuracy_interval),
        "kappa": accuracy.kappa,
        "mean_class_recall": accuracy.mean_class_recall,
        "mean_class_precision": accuracy.mean_class_precision,
        "mean_f1": accuracy.mean_f1,
        "mean_iou": accuracy.mean_iou,
        "classes": figures,
        "confusion": {
            "rows": named(accuracy.classes),
            "columns": named(accuracy.columns),
            "counts": accuracy.matrix.tolist(),
            "by_reference": accuracy.by_reference.tolist(),
            "by_prediction": accuracy.by_prediction.tolist(),
        },
        "reliability": _graded(accuracy.reliability, "curve"),
        "margin": _graded(accuracy.margin, "deciles"),
    }


def _graded(grading: Grading | None, kind: str) -> dict[str, Any] | None:
    if grading is None or grading.points == 0:
        return None
    out: dict[str, Any] = {"mean": grading.mean, "separation": grading.separation()}
    if kind == "curve":
        out["expected_calibration_error"] = grading.expected_calibration_error()
        out["curve"] = grading.curve()
    else:
        out["deciles"] = grading.quantiles()
    return out


def percent(value: float | None, digits: int = 2) -> str:
    """A share in percent, without its sign; ``-`` where it is not defined."""
    return "-" if value is None else f"{100 * value:.{digits}f}"


def as_table(accuracy: Accuracy, confusion: str = "by_reference") -> str:
    """See :meth:`pdal_stages.accuracy.measures.Accuracy.table`."""
    if confusion not in CONFUSION:
        raise OptionError(
            "'confusion' is not a way to give the matrix",
            found=confusion,
            cure=suggest(confusion, CONFUSION) + f"Use one of {', '.join(CONFUSION)}",
        )
    blocks = [_headline(accuracy), _classes(accuracy)]
    if confusion != "none":
        blocks.append(_confusion(accuracy, confusion))
    graded = _confidence(accuracy)
    if graded:
        blocks.append(graded)
    return "\n\n".join(blocks)


def _headline(a: Accuracy) -> str:
    lines = [
        f"Points compared       {a.points:>14,}",
        f"Overall accuracy      {percent(a.overall_accuracy):>14} %",
        f"Cohen's kappa         {percent(a.kappa):>14}{' %' if a.kappa is not None else ''}",
        f"Mean class recall     {percent(a.mean_class_recall):>14} %",
        f"Mean class precision  {percent(a.mean_class_precision):>14} %",
        f"Mean F1               {percent(a.mean_f1):>14} %",
        f"Mean IoU              {percent(a.mean_iou):>14} %",
    ]
    if a.left_out:
        which = ", ".join(f"{code} {a.name(code)}: {n:,}" for code, n in a.left_out.items())
        lines.append(f"Left out              {a.left_out_points:>14,}   (reference class {which})")
    if a.merged:
        pairs = ", ".join(f"{c} as {t}" for c, t in sorted(a.merged.items()))
        lines.append(f"Merged                {pairs:>14}")
    if a.extra:
        which = ", ".join(f"{code} {a.name(code)}" for code in a.extra)
        lines.append(f"Outside the classes   {a.extra_points:>14,}   (counted as errors: {which})")
    return "\n".join(lines)


def _columns(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 2) -> str:
    """Align text columns: the second to the left, all others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        pairs = enumerate(zip(row, widths, strict=True))
        cells = [c.ljust(w) if i == 1 else c.rjust(w) for i, (c, w) in pairs]
        lines.append((" ".join(cells[:left]) + "  " + "  ".join(cells[left:])).rstrip())
    lines.insert(1, "-" * max(map(len, lines)))
    return "\n".join(lines)


def _classes(a: Accuracy) -> str:
    header = ["", "Class", "Reference", "Predicted", "Recall %", "Precision %", "F1 %", "IoU %"]
    rows = [
        [
            str(f.code),
            f.name,
            f"{f.support:,}",
            f"{f.predicted:,}",
            percent(f.recall),
            percent(f.precision),
            percent(f.f1),
            percent(f.iou),
        ]
        for f in a.per_class
    ]
    return _columns(header, rows)


def _confusion(a: Accuracy, kind: str) -> str:
    titles = {
        "counts": "points",
        "by_reference": "% of the reference class; the diagonal is recall",
        "by_prediction": "% of the predicted class; the diagonal is precision",
    }
    values = a.matrix if kind == "counts" else getattr(a, kind)
    header = ["", "Reference", *(str(c) + ("*" if c in a.extra else "") for c in a.columns)]
    rows = [
        [str(code), a.name(code), *(f"{v:,}" if kind == "counts" else percent(v) for v in values[i])]
        for i, code in enumerate(a.classes)
    ]
    text = f"Confusion: rows reference, columns prediction, {titles[kind]}\n" + _columns(header, rows)
    return text + ("\n* no class of the reference" if a.extra else "")


def _confidence(a: Accuracy) -> str:
    lines = []
    if a.reliability is not None and a.reliability.points:
        lines.append(
            f"Reliability: mean {percent(a.reliability.mean)} %, expected calibration error "
            f"{percent(a.reliability.expected_calibration_error())} %"
        )
    if a.margin is not None and a.margin.points:
        deciles = a.margin.quantiles()
        lines.append(
            f"Margin: of the {percent(deciles[0]['points'] / a.margin.points, 0)} % least certain points "
            f"{percent(deciles[0]['share_wrong'])} % are wrong, of the "
            f"{percent(deciles[-1]['points'] / a.margin.points, 0)} % most certain "
            f"{percent(deciles[-1]['share_wrong'])} %"
        )
    return "\n".join(lines)
