"""What ``review`` shows people: its page, the same in a few lines of text, and QGIS styles of its layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.messages import duration, one_line
from .objectlayers import qml
from .page import render

#: Rows in the page's tables, and in text.
_ROWS, _WORST = 200, 10
#: Fill of patches, from those with least to expect to those with most; of those looked at.
_INKS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
_LOOKED_AT = "120,170,120,90"


def review_page(found: Mapping[str, Any], minutes: Sequence[tuple[float, float]] = ()) -> str:
    """The page of what ``Review.to_dict`` gives.

    `minutes` are shares of the expected errors, and minutes of looking at the patches that hold them.
    """
    points, expected = found["points"], found["expected"]
    figures = [
        ("Points judged", f"{points:,}", "", "ground, vegetation and buildings"),
        ("Expected wrong", f"{expected:,.0f}", "", f"{100 * expected / max(points, 1):.2f} % of them"),
        ("Patches", f"{found['listed']:,}", "", "in the vector file, worst first"),
    ]
    figures += [
        (f"{100 * share:.0f} % of these", duration(60 * needed), "", "of looking")
        for share, needed in minutes
    ]
    return render(
        "review.html",
        title="Where to look",
        subtitle=f"{len(found['tiles']):,} file{'s' * (len(found['tiles']) > 1)}",
        figures=figures,
        tiles=found["tiles"][:_ROWS],
        hidden=max(0, len(found["tiles"]) - _ROWS),
        patches=found["worst"][:_ROWS],
    )


def lines(found: Mapping[str, Any]) -> list[str]:
    """The same in a few lines of text: the worst tiles and the worst patches."""
    points, expected = found["points"], found["expected"]
    out = [
        f"{points:,} points judged, {expected:,.0f} expected wrong ({100 * expected / max(points, 1):.2f} %), "
        f"{found['listed']:,} patches to look at",
        "",
        f"{'tile':<40}{'points':>14}{'expected wrong':>16}{'%':>8}{'patches':>9}{'minutes':>9}",
    ]
    for row in found["tiles"][:_WORST]:
        out.append(
            f"{one_line(row['tile'])[-40:]:<40}{row['points']:>14,}{row['expected']:>16,.0f}{row['percent']:>8.2f}"
            f"{row['patches']:>9,}{row['minutes']:>9.1f}"
        )
    if len(found["tiles"]) > _WORST:
        out.append(f"... and {len(found['tiles']) - _WORST:,} more")
    out += ["", f"{'patch':>5}{'expected':>10}{'m2':>8}  why, where"]
    for row in found["worst"][:_WORST]:
        x, y = (0.5 * (row["box"][k] + row["box"][k + 2]) for k in (0, 1))
        out.append(
            f"{row['rank']:>5}{row['expected']:>10,.0f}{row['area']:>8,.0f}  {row['reason']}; "
            f"{one_line(row['tile'])} at {x:.0f}, {y:.0f}"
        )
    return out


def styles(errors: NDArray[np.float64]) -> dict[str, str]:
    """Of layer ``patches`` in four steps of the points expected wrong, green where ``done`` is 1; of ``tiles`` outlines."""
    positive = errors[errors > 0]
    steps = np.quantile(positive, [0.5, 0.8, 0.95]) if len(positive) else np.array([1.0, 2.0, 3.0])
    low, middle, high = (f"{value:.0f}" for value in steps)
    rules = {
        f"below {low} points expected wrong": f"done = 0 and expected < {low}",
        f"{low} to {middle}": f"done = 0 and expected >= {low} and expected < {middle}",
        f"{middle} to {high}": f"done = 0 and expected >= {middle} and expected < {high}",
        f"{high} and more": f"done = 0 and expected >= {high}",
        "looked at": "done = 1",
    }
    patches = [(*rule, ink) for rule, ink in zip(rules.items(), (*_INKS, _LOOKED_AT), strict=True)]
    return {
        "patches": qml("MultiPolygon", patches, outline_color="80,40,20,255", outline_width=0.3),
        "tiles": qml(
            "MultiPolygon", [("tile", "", "0,0,0,0")], outline_color="60,60,60,255", outline_width=0.5
        ),
    }
