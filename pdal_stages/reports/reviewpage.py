"""The page of ``review``: what is expected wrong, tile by tile, and a picture of each patch, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import class_color, class_name
from ..base.plain import one_line
from .maps import Key, Picture
from .page import duration, render
from .raster import Frame
from .views import nice_step, section_view, top_view

#: Pixels across a picture.
_TOP, _SECTION = 420, 760
#: Depth of a section, meters.
_DEPTH = 2.0
#: Tiles in the table.
_TILES = 200
#: Tiles and patches that are named in text.
_WORST = 10


@dataclass(frozen=True)
class PatchView:
    """A patch in pictures.

    Attributes
    ----------
    row : mapping
        What the table says of it: rank, tile, expected, area, seconds, reason.
    views : tuple of Picture
    codes : tuple of int
        Classes in it.
    """

    row: Mapping[str, Any]
    views: tuple[Picture, ...]
    codes: tuple[int, ...]


def draw_patch(
    row: Mapping[str, Any],
    points: NDArray[np.float64],
    cells: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> PatchView:
    """Pictures from above and in section.

    Parameters
    ----------
    row : mapping
    points : (n, 4) float64
        Coordinates in meters and class codes, of the patch and its surroundings.
    cells : (m, 4) float64
        West, south, east, north of the patch's cells, meters.
    errors : (m,) float64
        Points expected wrong in each; the section goes through the worst.
    """
    x, y, z = np.ascontiguousarray(points[:, :3].T)
    codes = points[:, 3].astype(np.uint8)
    frame = Frame.around(x, y, _TOP)
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height
    what = f"Patch {row['rank']}: {row['reason']}"
    length = nice_step(wide / 5)
    above = Picture.of(
        top_view(x, y, z, codes, width=_TOP),
        "From above",
        f"{what}, from above, colored by class; the line is the border of the patch",
        scale=(100 * length / wide, f"{length:g} m"),
        line=_border(cells, frame.x0, frame.y0, wide, tall),
    )
    views = [above]
    worst = cells[int(errors.argmax())]
    middle = 0.5 * (worst[:2] + worst[2:])
    along = 0 if np.ptp(x) >= np.ptp(y) else 1
    start, end = middle.copy(), middle.copy()
    start[along], end[along] = (x, y)[along].min(), (x, y)[along].max()
    inside = np.abs((y, x)[along] - middle[1 - along]) <= _DEPTH / 2
    if inside.sum() > 10 and np.ptp(z[inside]) < 3 * (end - start).max():
        drawn = section_view(
            x, y, z, codes, start=tuple(start), end=tuple(end), thickness=_DEPTH, width=_SECTION
        )
        toward = "west to east" if along == 0 else "south to north"
        views.append(Picture.of(drawn, f"Section, {toward}", f"{what}, vertical section {toward}"))
    return PatchView(row, tuple(views), tuple(np.unique(codes).tolist()))


def _border(cells: NDArray[np.float64], x0: float, y0: float, wide: float, tall: float) -> str:
    """The edges of cells that have no neighbor there, as an SVG path in percent."""
    inside = {(w, s) for w, s, _, _ in cells.tolist()}
    out = []
    for west, south, east, north in cells.tolist():
        side = east - west
        for (dx, dy), (a, b) in (
            ((-1, 0), ((west, south), (west, north))),
            ((1, 0), ((east, south), (east, north))),
            ((0, -1), ((west, south), (east, south))),
            ((0, 1), ((west, north), (east, north))),
        ):
            if (west + dx * side, south + dy * side) not in inside:
                ends = [(100 * (x - x0) / wide, 100 * (1 - (y - y0) / tall)) for x, y in (a, b)]
                out.append("M" + "L".join(f"{across:.1f} {down:.1f}" for across, down in ends))
    return "".join(out)


def review_page(
    found: Mapping[str, Any], views: Sequence[PatchView], minutes: Sequence[tuple[float, float]] = ()
) -> str:
    """The page.

    Parameters
    ----------
    found : mapping
        What ``Review.to_dict`` gives.
    views : sequence of PatchView
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
    codes = sorted({code for view in views for code in view.codes})
    legend: list[Key] = [(class_color(code), f"{code} {class_name(code)}") for code in codes]
    return render(
        "review.html",
        title="Where to look",
        subtitle=f"{len(found['tiles']):,} file{'s' * (len(found['tiles']) > 1)}",
        figures=figures,
        tiles=found["tiles"][:_TILES],
        hidden=max(0, len(found["tiles"]) - _TILES),
        views=views,
        legend=legend,
        settings=found["settings"],
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
