"""A model file as one self-contained HTML page: classes, scores, importances."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..accuracy.text import percent
from ..base import checks
from ..base.files import write_whole
from ..classifier.summary import held_out, held_out_by
from .page import render

if TYPE_CHECKING:
    from ..classifier import Model


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
    last = described["passes"][-1]
    priors = (described.get("priors") or {}).get("factors")
    return render(
        "model.html",
        title=f"Model {name}".strip(),
        subtitle=f"{last['algorithm'].replace('_', ' ')}, {len(last['feature_names']):,} features of a point",
        model=described,
        scores=_scores(described),
        f1=held_out(described).get("f1") or {},
        prior_factors=priors,
        settings=_settings(described),
    )


def _scores(d: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """The headline figures, of ground held out."""
    row = held_out(d)
    if not row:
        return []
    crossed = d["accuracy"]["cross_validation"]
    by = held_out_by(crossed) if crossed else "ground, which chose the epoch,"
    detail = f"{by} held out; classes weigh the same" if crossed else f"{by} held out"
    titles = {"overall_accuracy": "Overall accuracy", "kappa": "Kappa", "mean_f1": "Mean F1"}
    return [
        (title, percent(checks.finite(row.get(key)), 1), "%", detail if key == "overall_accuracy" else "")
        for key, title in titles.items()
    ]


def _settings(d: Mapping[str, Any]) -> dict[str, Any]:
    keep = ("base", "teacher", "required_dimensions", "halo_m", "strategy", "target", "created_by")
    out = {key: d[key] for key in keep if d.get(key) is not None}
    for number, one in enumerate(d["passes"], 1):
        what = {key: one[key] for key in ("algorithm", "parameters", "features", "context") if one[key]}
        out |= {f"pass {number}": what} if len(d["passes"]) > 1 else what
    if d.get("priors"):
        out["prior_weight"] = d["priors"].get("weight")
    training = {k: v for k, v in d["training"].items() if k not in ("curve", "clouds", "held_out")}
    clouds = [f"{c['name']} ({c['points']:,} points)" for c in d["training"].get("clouds", [])]
    if len(clouds) > 20:
        clouds = [*clouds[:20], f"and {len(clouds) - 20} more"]
    return {**out, "training": {"clouds": clouds, **training}}
