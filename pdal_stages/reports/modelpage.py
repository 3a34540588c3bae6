"""A model file as one self-contained HTML page: classes, scores, the curve of a network's training, importances."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..accuracy.text import percent
from ..base.asprs import class_color
from ..base.files import write_whole
from . import html
from .accuracypage import footer

if TYPE_CHECKING:
    from ..classifier import Model

#: Importances drawn of each grouping.
MOST = 25


def write_model_report(path: str | os.PathLike[str], model: Model, name: str = "") -> Path:
    """Write the page, whole or not at all.

    Parameters
    ----------
    path : str or path
        The HTML file; nothing else is written.
    model : Model
    name : str
        What the page calls it, e.g. the model's file name.

    Raises
    ------
    StageError
        If it cannot be written.
    """
    return write_whole(path, model_page(model, name).encode())


def model_page(model: Model, name: str = "") -> str:
    """The page of :func:`write_model_report` as text."""
    described = model.describe()
    training = described["training"]
    kind = described["algorithm"].replace("_", " ")
    return html.page(
        f"Model {name}".strip(),
        _headline(described),
        _classes(described),
        _curve(training.get("curve")),
        _tried(described["accuracy"].get("cross_validation")),
        _importances(described.get("importances")),
        html.section("What it is", html.settings(_settings(described), "Model and training")),
        subtitle=f"{kind}, {len(model.plan.names):,} features of a point",
        footer=footer(),
    )


def _headline(d: Mapping[str, Any]) -> str:
    held = d["training"].get("held_out")
    crossed = d["accuracy"].get("cross_validation")
    if isinstance(held, dict) and held:
        row, remark = held, "on ground held out, which chose the epoch"
    elif crossed:
        row, remark = crossed["chosen"], "on blocks held out; classes weigh the same"
    elif d["accuracy"].get("out_of_bag"):
        row, remark = d["accuracy"]["out_of_bag"], "out of bag, flattered by neighboring samples"
    else:
        return ""
    figures = [
        (title, percent(_number(row.get(key)), 1), "%", remark)
        for title, key in (
            ("Overall accuracy", "overall_accuracy"),
            ("Kappa", "kappa"),
            ("Mean F1", "mean_f1"),
        )
    ]
    return html.section("At training", html.tiles(figures))


def _classes(d: Mapping[str, Any]) -> str:
    f1 = (d["accuracy"].get("out_of_bag") or {}).get("f1") or {}
    header = ["Class", "Labels", "Points there were", "Samples", "Counted again", "F1 out of bag, %"]
    rows = [
        html.head(f"{c['code']} {c['name']}", "row", "text", html.swatch(class_color(c["code"])))
        + html.cell(_listed(c["labels"]), "break")
        + html.cell(f"{c['available']:,}")
        + html.cell(f"{c['samples']:,}")
        + html.cell(f"{c['duplicates']:,}")
        + html.cell(percent(f1.get(str(c["code"])), 1))
        for c in d["classes"]
    ]
    return html.section("Classes", html.table(header, rows, "What each class was trained on"))


def _listed(labels: list[int], most: int = 12) -> str:
    shown = ", ".join(map(str, labels[:most]))
    return shown if len(labels) <= most else f"{shown} and {len(labels) - most} more"


def _curve(rows: Any) -> str:
    """Loss, and the scores on the ground held out, epoch by epoch."""
    rows = [r for r in rows if isinstance(r, dict)] if isinstance(rows, list) else []
    charts = []
    for key, title, share in (("loss", "Loss", False), ("mean_f1", "Mean F1 on the ground held out", True)):
        pairs = [(_number(r.get("epoch")), _number(r.get(key))) for r in rows]
        points = [(a, b) for a, b in pairs if a is not None and b is not None]
        if len(points) > 1:
            charts.append(_chart(points, title, share))
    if not charts:
        return ""
    return html.section(
        "Training", html.grid(*charts), note="The weights kept are those of the epoch with the best mean F1."
    )


def _chart(points: list[tuple[float, float]], title: str, share: bool) -> str:
    last = points[-1][0]
    most = 1.0 if share else max(b for _, b in points) or 1.0
    best = (max if share else min)(points, key=lambda p: p[1])
    step = max(1, math.ceil(last / 6))
    said = f"{100 * best[1]:.1f} %" if share else f"{best[1]:.4g}"
    return html.figure(
        html.chart(
            alt=f"{title} over {len(points)} epochs; best {said} in epoch {best[0]:g}",
            x_label="Epoch",
            y_label=f"{title}, %" if share else title,
            x=(0.0, last),
            y=(0.0, most),
            x_ticks=[(float(e), str(e)) for e in range(0, int(last) + 1, step)],
            y_ticks=[(most * i / 5, f"{20 * i}" if share else f"{most * i / 5:.2g}") for i in range(6)],
            lines=[(points, "line")],
            dots=[(*best, f"epoch {best[0]:g}: {said}")],
        ),
        f"Best: {said} in epoch {best[0]:g}.",
        title,
    )


def _tried(crossed: Mapping[str, Any] | None) -> str:
    if not crossed:
        return ""
    rows = [
        html.head(f"{r['trees']:,}", "row", "text")
        + html.cell("unlimited" if r["max_depth"] is None else r["max_depth"])
        + html.cell(f"{r['min_samples_leaf']:,}")
        + "".join(html.cell(percent(r[k], 2)) for k in ("overall_accuracy", "kappa", "mean_f1"))
        for r in crossed["tried"]
    ]
    header = ["Trees", "Depth", "Least samples of a leaf", "Overall accuracy, %", "Kappa, %", "Mean F1, %"]
    note = (
        f"{crossed['folds']} folds of blocks of {crossed['block_size']:g} m with a gap of {crossed['gap']:g} m "
        "between training and validation, so that no point has neighbors on the other side."
    )
    return html.section("Tried in cross-validation", html.table(header, rows, "Scores"), note=note)


def _importances(groups: Mapping[str, Mapping[str, float]] | None) -> str:
    if not groups:
        return ""
    figures = [
        html.figure(html.bars(dict(list(groups[by].items())[:MOST])), "", f"By {by}")
        for by in ("neighborhood", "group", "feature")
        if by in groups
    ]
    note = "Share of the decrease in impurity over all trees."
    return html.section("Importances", html.grid(*figures), note=note)


def _settings(d: Mapping[str, Any]) -> dict[str, Any]:
    keep = (
        "algorithm",
        "parameters",
        "features",
        "required_dimensions",
        "strategy",
        "target",
        "priors",
        "created_by",
    )
    out = {key: d[key] for key in keep if d.get(key) is not None}
    training = {k: v for k, v in d["training"].items() if k not in ("curve", "clouds", "held_out")}
    clouds = [f"{c['name']} ({c['points']:,} points)" for c in d["training"].get("clouds", [])]
    return {**out, "training": {"clouds": _listed_names(clouds), **training}}


def _listed_names(names: list[str], most: int = 20) -> list[str]:
    return names if len(names) <= most else [*names[:most], f"and {len(names) - most} more"]


def _number(value: Any) -> float | None:
    """A finite number, or None: the manifest's free parts may hold anything."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else None
