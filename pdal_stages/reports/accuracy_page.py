"""The accuracy report: one self-contained HTML page about a classification and its reference, with maps from above."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.labels import as_codes, refuse_other_lengths
from ..accuracy.measures import Accuracy
from ..base.asprs import class_color
from ..base.errors import StageError
from ..base.files import write_whole
from .page import render
from .pictures import IGNORED, RIGHT, WRONG, embedded, nice_step, paint, shading, surface, verdict

#: Files within so many meters share a map; most places that are drawn.
TOGETHER, DRAWN = 1000.0, 12
#: Most pixels across a map, and in total.
MAP_WIDTH, MAP_PIXELS = 820, 800_000


@dataclass(frozen=True)
class Place:
    """Points of a file, or of several close together, with both classifications before any merge."""

    name: str
    xyz: npt.NDArray[np.float64]
    reference: npt.NDArray[Any]
    predicted: npt.NDArray[Any]


def places(files: Sequence[Place], systems: Sequence[str] = ()) -> list[Place]:
    """Join files within :data:`TOGETHER` of one another in the same reference system, for one map each."""
    from scipy.sparse.csgraph import connected_components

    there = [k for k, one in enumerate(files) if len(one.xyz)]
    if not there:
        return []
    low, high = (
        np.array([how(files[k].xyz[:, :2], axis=0) for k in there]) for how in (np.min, np.max)
    )
    apart = np.linalg.norm(
        (low[:, None] - high[None]).clip(0) + (low[None] - high[:, None]).clip(0), axis=2
    )
    system = np.array([systems[k] if systems else "" for k in there])
    _, group = connected_components((apart <= TOGETHER) & (system[:, None] == system))
    out = []
    for number in dict.fromkeys(group.tolist()):
        mine = [files[there[k]] for k in np.flatnonzero(group == number)]
        listed = ", ".join(one.name for one in mine[:3]) + f" and {len(mine) - 3:,} more" * (
            len(mine) > 3
        )
        sides = ("xyz", "reference", "predicted")
        out.append(
            Place(listed, *(np.concatenate([getattr(one, side) for one in mine]) for side in sides))
        )
    return out


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

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    StageError
        Arrays of different lengths, coordinates that are not numbers, or a file that cannot be written.
    """
    if xyz is not None:
        places = [Place("", np.asarray(xyz), np.asarray(reference), np.asarray(predicted))]
    scenes = [
        (
            one.name if len(places) > 1 else "",
            _maps(accuracy, one.xyz, one.reference, one.predicted),
        )
        for one in places[:DRAWN]
    ]
    ordered = sorted((importances or {}).items(), key=lambda item: (-item[1], item[0]))
    page = render(
        "accuracy.html",
        title=title,
        subtitle=subtitle,
        a=accuracy,
        scenes=scenes,
        hidden=max(0, len(places) - DRAWN),
        importances=[(name, float(share)) for name, share in ordered],
        settings=settings,
    )
    return write_whole(path, page.encode())


def _maps(a: Accuracy, xyz: Any, reference: Any, predicted: Any) -> dict[str, Any]:
    """Maps of reference, prediction and errors for the template; none where the points lie at one place or in a line."""
    points = np.asarray(xyz, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise StageError(
            "'xyz' must be n x 3", where="accuracy report", found=f"shape {points.shape}"
        )
    if not len(points):
        raise StageError("there is nothing to draw", where="accuracy report", found="0 points")
    if bad := int((~np.isfinite(points).all(axis=1)).sum()):
        what = f"{bad:,} of {len(points):,} points have coordinates that are not finite"
        raise StageError(what, where="accuracy report")
    to = np.arange(1 << 16)
    to[list(a.merged)] = list(a.merged.values())
    true, given = as_codes(reference, "reference"), as_codes(predicted, "prediction")
    refuse_other_lengths(true, {"prediction": given, "list of coordinates": points})
    compared = np.isin(to[true], a.classes) & ~np.isin(true, list(a.left_out))
    true, given = to[true], to[given]
    wrong = compared & (true != given)
    across, up = np.ptp(points[:, :2], axis=0)
    n = int(compared.sum())
    out: dict[str, Any] = {"points": len(points), "compared": n, "maps": []}
    if min(across, up) < 0.02 * max(across, up) or max(across, up) == 0:
        return out
    x, y, z = points.T
    width = min(MAP_WIDTH, math.sqrt(MAP_PIXELS * across / up))
    s = surface(x, y, z, max(16, math.ceil(width)))
    light, (tall, wide) = shading(s), s.which.shape
    length = nice_step(wide * s.pixel / 6)

    def picture(colors: npt.NDArray[np.uint8], heading: str, alt: str) -> dict[str, Any]:
        scale = (100 * length / (wide * s.pixel), f"{length:g} m")
        return {"heading": heading, "alt": alt, "scale": scale, **embedded(paint(s, colors, light))}

    alt = f"Map of the errors from above: {wrong.sum():,} of {n:,} compared points are wrong"
    there = np.union1d(true, given).tolist()
    palette = np.array([class_color(code) for code in there], np.uint8)
    shown = [palette[np.searchsorted(there, s.spread(codes, there[0]))] for codes in (true, given)]
    return {
        **out,
        "caption": f"{len(points):,} points, {wide * s.pixel:,.0f} x {tall * s.pixel:,.0f} m, north up; lower left "
        f"corner: x {s.x0:.0f}, y {s.y0:.0f}. Each pixel of {s.pixel:.2g} m shows its highest point; on the map of "
        "errors a wrong point lies above right ones.",
        "classes": [(class_color(code), f"{code} {a.name(code)}") for code in there],
        "verdicts": [(RIGHT, "right"), (WRONG, "wrong"), (IGNORED, "not compared")][
            : 2 + (n < len(points))
        ],
        "maps": [
            picture(shown[0], "Reference", "Map of the reference classes from above"),
            picture(shown[1], "Prediction", "Map of the predicted classes from above"),
            picture(verdict(s, x, y, z, wrong, ~compared), "Errors", alt),
        ],
        "in_a_row": wide < 1.7 * tall,
    }
