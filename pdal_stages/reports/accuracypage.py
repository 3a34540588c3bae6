"""The accuracy report: one self-contained HTML page about a classification and its reference."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.measures import Accuracy
from ..accuracy.text import percent
from ..base.files import write_whole
from .maps import DrawnScene, MapScene, draw_scene
from .page import render

#: Files within so many meters share a map, and places that are drawn at most.
TOGETHER, DRAWN = 1000.0, 12


@dataclass(frozen=True)
class Place:
    """Points of a file, or of several that lie together, with both classifications as they were before any merge."""

    name: str
    xyz: npt.NDArray[np.float64]
    reference: npt.NDArray[Any]
    predicted: npt.NDArray[Any]


def places(files: Sequence[Place], systems: Sequence[str] = ()) -> list[Place]:
    """Files that lie within :data:`TOGETHER` of one another, in one reference system, joined: a map of each."""
    left = [k for k, one in enumerate(files) if len(one.xyz)]
    boxes = {k: (files[k].xyz[:, :2].min(axis=0), files[k].xyz[:, :2].max(axis=0)) for k in left}
    out = []
    while left:
        group, waiting = [left.pop(0)], left
        for one in group:  # grows
            near = [k for k in waiting if _together(boxes[one], boxes[k]) and _same(systems, one, k)]
            group += near
            waiting = [k for k in waiting if k not in near]
        left = waiting
        group.sort()
        names = [files[k].name for k in group]
        listed = ", ".join(names[:3]) + f" and {len(names) - 3:,} more" * (len(names) > 3)
        joined = (
            np.concatenate([getattr(files[k], side) for k in group])
            for side in ("xyz", "reference", "predicted")
        )
        out.append(Place(listed, *joined))
    return out


def _together(one: Any, other: Any) -> bool:
    apart = np.maximum(np.maximum(one[0] - other[1], other[0] - one[1]), 0.0)
    return bool(np.hypot(*apart) <= TOGETHER)


def _same(systems: Sequence[str], one: int, other: int) -> bool:
    return not systems or systems[one] == systems[other]


def write_accuracy_report(
    path: str | os.PathLike[str],
    accuracy: Accuracy,
    *,
    xyz: npt.ArrayLike | None = None,
    reference: npt.ArrayLike | None = None,
    predicted: npt.ArrayLike | None = None,
    places: Sequence[Place] = (),
    title: str = "Classification accuracy",
    subtitle: str = "",
    importances: Mapping[str, float] | None = None,
    settings: Mapping[str, Any] | None = None,
    unit: str = "m",
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
        Coordinates, for maps from above. They become images of bounded size, so
        millions of points do not make the page large.
    reference, predicted : (n,) arrays, optional
        Class codes of those points, as they were before any merge; needed with `xyz`.
    places : sequence of Place, optional
        Instead of the three: each gets maps of its own, the first :data:`DRAWN` at most.
    title, subtitle : str
        The page's heading and the line below it.
    importances : mapping of name to share, optional
        Importances of features or groups of features, given by the model.
    settings : mapping, optional
        What was compared and how (files, reference system, model, options); mappings may be nested.
    unit : str
        Unit of the coordinates, for scales and axes.
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
    scenes: list[tuple[str, DrawnScene]] = []
    if xyz is not None or reference is not None or predicted is not None:
        scene = MapScene.of(accuracy, xyz, reference, predicted)
        scenes = [("", draw_scene(accuracy, scene, unit))]
    for one in places[:DRAWN]:
        scene = MapScene.of(accuracy, one.xyz, one.reference, one.predicted)
        scenes.append((one.name if len(places) > 1 else "", draw_scene(accuracy, scene, unit)))
    ordered = sorted((importances or {}).items(), key=lambda item: (-item[1], item[0]))
    page = render(
        "accuracy.html",
        date=date,
        title=title,
        subtitle=subtitle,
        a=accuracy,
        scenes=scenes,
        hidden=max(0, len(places) - DRAWN),
        matrix_width=_matrix_width(accuracy),
        confidence=_confidence(accuracy),
        importances=[(name, float(share)) for name, share in ordered],
        settings=settings,
    )
    return write_whole(path, page.encode())


def _matrix_width(a: Accuracy) -> int:
    """Pixels a confusion matrix needs, estimated from its longest words at about 7 pixels a letter."""
    titles = [f"{c} {a.name(c)}{' compared)' * (c in a.extra)}" for c in a.columns]
    columns = sum(max(64, 18 + 7 * max(map(len, title.split()))) for title in titles)
    return 120 + 7 * max(len(f"{c} {a.name(c)}") for c in a.classes) + columns


def _confidence(a: Accuracy) -> list[dict[str, Any]]:
    """Tables of how well reliability and margin tell where the classifier is wrong: a share of each group as a bar."""
    out = []
    if (g := a.reliability) is not None and g.points:
        rows = [
            (f"{100 * b['lower']:.0f} to {100 * b['upper']:.0f}", b["points"], b["share_right"])
            for b in g.curve()
            if b["points"]
        ]
        caption = (
            f"Share of right points by the winning probability. Mean reliability {percent(g.mean, 1)} %, expected "
            f"calibration error {percent(g.expected_calibration_error(), 1)} %."
        )
        titles = ["Reliability %", "Points", "Right %"]
        out.append({"heading": "Reliability", "caption": caption, "titles": titles, "rows": rows})
    if (g := a.margin) is not None and g.points:
        groups = g.quantiles()
        caption = "Share of wrong points by the winning probability minus the second."
        wrong = sum(d["points"] - d["right"] for d in groups)
        if wrong:
            caught = groups[0]["points"] - groups[0]["right"]
            caption += (
                f" The {percent(groups[0]['points'] / g.points, 0)} % of points with the least margin hold "
                f"{percent(caught / wrong, 0)} % of the errors."
            )
        rows = [
            (f"{100 * d['lower']:.1f} to {100 * d['upper']:.1f}", d["points"], d["share_wrong"])
            for d in groups
        ]
        titles = ["Margin %", "Points", "Wrong %"]
        out.append({"heading": "Errors against margin", "caption": caption, "titles": titles, "rows": rows})
    return out
