"""The page of ``review``: what is expected wrong, tile by tile, and the worst patches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.plain import one_line
from .page import duration, render

#: Tiles and patches in the page's tables, and in text.
_TILES, _PATCHES, _WORST = 200, 200, 10


def review_page(found: Mapping[str, Any], minutes: Sequence[tuple[float, float]] = ()) -> str:
    """The page.

    Parameters
    ----------
    found : mapping
        What ``Review.to_dict`` gives.
    minutes : sequence of (float, float)
        Shares of the expected errors, and minutes of looking at the patches that hold them.
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
        tiles=found["tiles"][:_TILES],
        hidden=max(0, len(found["tiles"]) - _TILES),
        patches=found["worst"][:_PATCHES],
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
            f"{one_line(row['tile'])[-40:]:<40}{row['points']:>14,}{row['expected']:>16,.0f}{100 * row['share']:>8.2f}"
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
