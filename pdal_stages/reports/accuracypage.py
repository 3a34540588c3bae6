"""The accuracy report: one self-contained HTML page about a classification and its reference."""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ..accuracy.confidence import Grading
from ..accuracy.measures import Accuracy
from ..accuracy.text import percent
from ..base.asprs import class_color
from ..base.files import write_whole
from . import html

#: Errors listed by name.
CONFUSIONS = 8
#: Importances drawn; the rest is summed.
IMPORTANCES = 30


def write_accuracy_report(
    path: str | os.PathLike[str],
    accuracy: Accuracy,
    *,
    xyz: npt.ArrayLike | None = None,
    reference: npt.ArrayLike | None = None,
    predicted: npt.ArrayLike | None = None,
    title: str = "Classification accuracy",
    subtitle: str = "",
    importances: Mapping[str, float] | None = None,
    settings: Mapping[str, Any] | None = None,
    unit: str = "m",
    section: tuple[tuple[float, float], tuple[float, float]] | None = None,
    date: str | None = None,
) -> Path:
    """Write an accuracy report, whole or not at all.

    Parameters
    ----------
    path : str or path
        The HTML file. Nothing else is written; images are inside it.
    accuracy : Accuracy
        The figures.
    xyz : (n, 3) array, optional
        Coordinates, for maps from above and a vertical section. They become images of bounded size, so
        millions of points do not make the page large.
    reference, predicted : (n,) arrays, optional
        Class codes of those points, as they were before any merge; needed with `xyz`.
    title, subtitle : str
        The page's heading and the line below it.
    importances : mapping of name to share, optional
        Importances of features or groups of features, given by the model.
    settings : mapping, optional
        What was used to get there (options, files, model); mappings may be nested.
    unit : str
        Unit of the coordinates, for scales and axes.
    section : ((x, y), (x, y)), optional
        Ends of the vertical section; by default it lies where the errors are densest.
    date : str, optional
        The date to print; by default today, or ``SOURCE_DATE_EPOCH`` where the environment sets it.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    StageError
        Arrays of different lengths, coordinates that are not numbers, or a file that cannot be written.
    """
    text = accuracy_page(
        accuracy,
        xyz=xyz,
        reference=reference,
        predicted=predicted,
        title=title,
        subtitle=subtitle,
        importances=importances,
        settings=settings,
        unit=unit,
        section=section,
        date=date,
    )
    return write_whole(path, text.encode())


def accuracy_page(
    accuracy: Accuracy,
    *,
    xyz: npt.ArrayLike | None = None,
    reference: npt.ArrayLike | None = None,
    predicted: npt.ArrayLike | None = None,
    title: str = "Classification accuracy",
    subtitle: str = "",
    importances: Mapping[str, float] | None = None,
    settings: Mapping[str, Any] | None = None,
    unit: str = "m",
    section: tuple[tuple[float, float], tuple[float, float]] | None = None,
    date: str | None = None,
) -> str:
    """The page of :func:`write_accuracy_report` as text."""
    maps = ""
    if xyz is not None or reference is not None or predicted is not None:
        from .maps import map_sections

        maps = map_sections(accuracy, xyz, reference, predicted, unit, section)
    return html.page(
        title,
        _headline(accuracy),
        maps,
        _classes(accuracy),
        _confusion(accuracy),
        _confidence(accuracy),
        _importances(importances),
        html.section("Settings", html.settings(settings, "What was compared")) if settings else "",
        _definitions(accuracy),
        subtitle=subtitle,
        footer=footer(date),
    )


# ---- sections --------------------------------------------------------------------------------------------


def _headline(a: Accuracy) -> str:
    figures = [
        ("Overall accuracy", percent(a.overall_accuracy, 1), "%", "points with the right class"),
        (
            "Cohen's kappa",
            percent(a.kappa, 1),
            "%" if a.kappa is not None else "",
            "agreement beyond chance" if a.kappa is not None else "undefined with one class only",
        ),
        ("Mean class recall", percent(a.mean_class_recall, 1), "%", "completeness"),
        ("Mean class precision", percent(a.mean_class_precision, 1), "%", "correctness"),
        ("Mean F1", percent(a.mean_f1, 1), "%", "recall and precision in one"),
        ("Mean IoU", percent(a.mean_iou, 1), "%", "intersection over union"),
    ]
    lead = f"{a.correct:,} of {a.points:,} compared points have the class of the reference."
    worst = a.confusions(1)
    if worst:
        code, given, n = worst[0]
        lead += (
            f" The most frequent error is {a.name(code)} taken for {a.name(given)}: {n:,} points, "
            f"{percent(n / (a.points - a.correct), 0)} % of all errors."
        )
    notes = []
    if a.left_out:
        which = "; ".join(f"{c} {a.name(c)}: {n:,}" for c, n in a.left_out.items())
        notes.append(f"Not compared, by reference class: {a.left_out_points:,} points ({which}).")
    if a.extra:
        which = ", ".join(f"{c} {a.name(c)}" for c in a.extra)
        notes.append(
            f"{a.extra_points:,} points were given a class that is not compared ({which}); "
            "they count as errors."
        )
    if a.merged:
        pairs = ", ".join(f"{c} as {t}" for c, t in sorted(a.merged.items()))
        notes.append(f"Classes merged before comparing: {pairs}.")
    return html.section(
        "Summary",
        html.tiles(figures),
        html.paragraph(lead, "lead"),
        *(html.paragraph(n, "note") for n in notes),
    )


def _label(a: Accuracy, code: int) -> str:
    return f"{code} {a.name(code)}"


def _classes(a: Accuracy) -> str:
    header = ["Class", "Recall %", "Precision %", "F1 %", "IoU %", "Reference points", "Predicted points"]
    rows = []
    for f in a.per_class:
        rows.append(
            html.head(_label(a, f.code), "row", "text", html.swatch(class_color(f.code)))
            + "".join(html.bar_cell(v, percent(v, 1)) for v in (f.recall, f.precision, f.f1, f.iou))
            + html.cell(f"{f.support:,}")
            + html.cell(f"{f.predicted:,}")
        )
    absent = [f for f in a.per_class if not f.support]
    mean = (
        html.head("Mean" + (" of the classes present" if absent else ""), "row", "text")
        + "".join(
            html.bar_cell(v, percent(v, 1))
            for v in (a.mean_class_recall, a.mean_class_precision, a.mean_f1, a.mean_iou)
        )
        + html.cell(f"{a.points:,} in all")
        + html.cell("")
    )
    return html.section(
        "Classes",
        html.table(header, rows, "Figures of each class", wide=True, foot=mean),
        _largest(a),
    )


def _largest(a: Accuracy) -> str:
    worst = a.confusions(CONFUSIONS)
    if not worst:
        return html.paragraph("No point was given a wrong class.", "note")
    support, wrong = a.support, a.points - a.correct
    rows = [
        html.head(_label(a, code), "row", "text", html.swatch(class_color(code)))
        + f'<td class="text">{html.swatch(class_color(given))}{html.escape(_label(a, given))}</td>'
        + html.cell(f"{n:,}")
        + html.cell(percent(n / support[code], 1))
        + html.cell(percent(n / wrong, 1))
        for code, given, n in worst
    ]
    shown = sum(n for *_, n in worst)
    return html.table(
        "<tr>"
        + html.head("Reference", kind="text")
        + html.head("Predicted as", kind="text")
        + "".join(html.head(t) for t in ("Points", "% of the class", "% of all errors"))
        + "</tr>",
        rows,
        "Most frequent errors",
        f"{shown:,} of {wrong:,} errors",
    )


def _confusion(a: Accuracy) -> str:
    # Side by side where both fit: estimated from the longest words, at about 7 pixels a letter.
    longest = [max(map(len, f"{_label(a, c)}{' compared)' * (c in a.extra)}".split())) for c in a.columns]
    rows = 60 + 7 * max(len(_label(a, c)) for c in a.classes)
    least = rows + 60 + sum(max(64, 18 + 7 * n) for n in longest)
    return html.section(
        "Confusion matrix",
        html.grid(_heat(a, "by_reference"), _heat(a, "by_prediction"), least=least),
        note="Blue is right, orange is wrong; stronger is a larger share (errors on a square-root scale, "
        "so that small ones show). Below each share, the number of points.",
    )


def _heat(a: Accuracy, direction: str) -> str:
    shares = getattr(a, direction)
    by_reference = direction == "by_reference"
    columns = "".join(
        html.head(_label(a, c) + (" (not compared)" if c in a.extra else ""), kind="heat") for c in a.columns
    )
    total = html.head("Points") if by_reference else ""
    header = (
        '<tr><td class="text"></td>'
        + html.head("Prediction", "colgroup", "text", span=len(a.columns) + by_reference)
        + f"</tr><tr>{html.head('Reference', kind='text')}{columns}{total}</tr>"
    )
    rows = []
    for i, code in enumerate(a.classes):
        row = html.head(_label(a, code), "row", "text", html.swatch(class_color(code)))
        for j, other in enumerate(a.columns):
            share = float(shares[i, j])
            value = share if other == code else math.sqrt(share)
            row += html.heat_cell(value, other == code, f"{100 * share:.1f} %", f"{a.matrix[i, j]:,}")
        if by_reference:
            row += html.cell(f"{a.support[code]:,}")
        rows.append(row)
    if not by_reference:
        sums = "".join(html.cell(f"{n:,}") for n in a.matrix.sum(axis=0))
        remark = "Share of the predicted class; the diagonal is precision"
        return html.table(
            header, rows, "By prediction", remark, foot=html.head("Points", "row", "text") + sums
        )
    return html.table(header, rows, "By reference", "Share of the reference class; the diagonal is recall")


# ---- confidence ------------------------------------------------------------------------------------------


def _confidence(a: Accuracy) -> str:
    figures = []
    if a.reliability is not None and a.reliability.points:
        figures.append(_reliability(a.reliability))
    if a.margin is not None and a.margin.points:
        figures.append(_margin(a.margin))
    if not figures:
        return ""
    return html.section(
        "Confidence",
        html.grid(*(f"<div>{figure}</div>" for figure in figures), least=340, kind="row"),
        note="How far the classifier's own figures tell where it is wrong.",
    )


def _reliability(g: Grading) -> str:
    curve = [b for b in g.curve() if b["points"]]
    tenths = [(i / 10, f"{10 * i}") for i in range(0, 11, 2)]
    words = [
        f"Reliability {100 * b['lower']:.0f}-{100 * b['upper']:.0f} %: {b['points']:,} points, "
        f"{percent(b['share_right'], 1)} % right"
        for b in curve
    ]
    drawing = html.chart(
        alt="Reliability curve. " + "; ".join(words),
        x_label="Reliability (winning probability), %",
        y_label="Points, %",
        x_ticks=tenths,
        y_ticks=tenths,
        bars=[
            (b["lower"], b["upper"], b["points"] / g.points, "faint", w)
            for b, w in zip(curve, words, strict=True)
        ],
        lines=[([(0, 0), (1, 1)], "ideal"), ([(b["mean"], b["share_right"]) for b in curve], "line")],
        dots=[(b["mean"], b["share_right"], w) for b, w in zip(curve, words, strict=True)],
    )
    rows = [
        html.head(f"{100 * b['lower']:.0f} to {100 * b['upper']:.0f}", "row", "text")
        + html.cell(f"{b['points']:,}")
        + html.cell(percent(b["mean"], 1))
        + html.cell(percent(b["share_right"], 1))
        for b in curve
    ]
    return html.figure(
        drawing,
        "Line: share of right points; dashed: where it would equal the reliability; "
        "bars: share of all points. "
        f"Mean reliability {percent(g.mean, 1)} %, expected calibration error "
        f"{percent(g.expected_calibration_error(), 1)} %.",
        "Reliability",
    ) + html.details(
        "Figures", html.table(["Reliability %", "Points", "Mean %", "Right %"], rows, "Reliability")
    )


def _margin(g: Grading) -> str:
    groups = g.quantiles()
    most = max(d["share_wrong"] for d in groups)
    top, ticks = _nice(1.07 * most)  # room for the figure above the longest bar
    words = [
        f"Margin {100 * d['lower']:.1f}-{100 * d['upper']:.1f} %: {d['points']:,} points, "
        f"{percent(d['share_wrong'], 1)} % wrong"
        for d in groups
    ]
    n = len(groups)
    drawing = html.chart(
        alt="Errors against margin. " + "; ".join(words),
        x_label="Tenths of the points, least certain first"
        if n == 10
        else "Groups of points, least certain first",
        y_label="Wrong, %",
        x=(0, n),
        y=(0, top),
        x_ticks=[(i + 0.5, str(i + 1)) for i in range(n)],
        y_ticks=ticks,
        bars=[
            (i, i + 1, d["share_wrong"], "bad", w) for i, (d, w) in enumerate(zip(groups, words, strict=True))
        ],
        values=[(i + 0.5, d["share_wrong"], percent(d["share_wrong"], 1)) for i, d in enumerate(groups)],
    )
    rows = [
        html.head(f"{100 * d['lower']:.1f} to {100 * d['upper']:.1f}", "row", "text")
        + html.cell(f"{d['points']:,}")
        + html.cell(percent(d["share_wrong"], 1))
        for d in groups
    ]
    wrong = sum(d["points"] - d["right"] for d in groups)
    caught = groups[0]["points"] - groups[0]["right"]
    text = "Margin: the winning probability minus the second."
    if wrong:
        text += (
            f" The {percent(groups[0]['points'] / g.points, 0)} % of points with the least margin hold "
            f"{percent(caught / wrong, 0)} % of the errors."
        )
    return html.figure(drawing, text, "Errors against margin") + html.details(
        "Figures", html.table(["Margin %", "Points", "Wrong %"], rows, "Errors against margin")
    )


def _nice(most: float) -> tuple[float, list[tuple[float, str]]]:
    """An axis from 0 that holds a share, with 4 to 6 round ticks in percent."""
    for step in (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2):
        if most <= 5 * step:
            break
    count = max(1, math.ceil(most / step - 1e-9))
    return count * step, [(i * step, f"{100 * i * step:g}") for i in range(count + 1)]


# ---- the rest --------------------------------------------------------------------------------------------


def _importances(values: Mapping[str, float] | None) -> str:
    if not values:
        return ""
    ordered = sorted(((str(k), float(v)) for k, v in values.items()), key=lambda kv: (-kv[1], kv[0]))
    note = "Share of the decrease in impurity over all trees, as the model gives it."
    rest = ordered[IMPORTANCES:]
    if rest:
        note += f" The {len(rest)} others together: {percent(sum(v for _, v in rest), 1)} %."
    return html.section("Importances", html.bars(dict(ordered[:IMPORTANCES])), note=note)


def _definitions(a: Accuracy) -> str:
    low, high = a.overall_accuracy_interval
    lines = [
        "Recall is the share of a reference class's points that were given that class; precision is the "
        "share of the points given a class that have it in the reference; F1 = 2 x recall x precision / "
        "(recall + precision); IoU = right points / points that have the class in either.",
        "Means are over the classes present in the reference, each with the same weight. A class that was "
        "never predicted has precision 0.",
        "Kappa is (observed - chance) / (1 - chance), with chance agreement from the totals of both sides.",
        f"Were the points independent, the overall accuracy would lie between {percent(low, 2)} and "
        f"{percent(high, 2)} % (95 %, Wilson). Neighboring points are not, so the true uncertainty is "
        "larger.",
    ]
    return html.section("How the figures are defined", *(html.paragraph(t, "note") for t in lines))


def footer(date: str | None = None) -> str:
    """When a page was made, and by which version."""
    return f"{date or _today()}, pdal_stages {_version()}"


def _today() -> str:
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    if epoch.isdigit():
        return datetime.datetime.fromtimestamp(int(epoch), datetime.timezone.utc).date().isoformat()
    return datetime.date.today().isoformat()


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("pdal-stages")
    except PackageNotFoundError:  # run from a source tree
        return "(not installed)"
