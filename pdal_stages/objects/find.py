"""Find all objects in records of cells, block by block of the absolute grid.

Memory is that of a block with its surroundings and of what was found. A block is looked at with `MARGIN` around it, within
which the ground and crowns are what they are in the whole; where a building, span or deck that reaches into the block comes
near the rim of what is seen, more is looked at. An object is of the block that its first cell (a tree: its top) lies in.
So blocks, and tiles that hold as much, find exactly what one look at everything finds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.progress import Progress
from . import crowns, lines, measure, roofs
from .cells import Cells, Kind, cell_keys, object_id, unpack
from .found import Found, Objects, ObjectSettings
from .measure import Body
from .rasters import Window
from .view import AROUND, MARGIN, CellView, extent_of, whole, widened

#: Meters more that are looked at first: most buildings that reach into a block end there, so few blocks are looked at twice.
AHEAD = 64.0
#: Side of a block, cells.
BLOCK = 2048
#: Kinds that are found.
FOUND = (Kind.BUILDING, Kind.TREE, Kind.SPAN, Kind.DECK)


def find_objects(
    cells: Cells, settings: ObjectSettings | None = None, *, block: int = BLOCK, progress: bool | None = None
) -> Objects:
    """All objects of an area.

    Parameters
    ----------
    cells : Cells
        Records of all points of the area, by :meth:`Cells.of`; a meter or two of its edge may be cut off objects.
    settings : ObjectSettings, optional
    block : int
        Side of the blocks of work, in cells; even. It changes nothing but memory.
    progress : bool, optional
        Whether to show progress on stderr.
    """
    chosen = settings or ObjectSettings(cell=cells.size)
    if chosen.cell != cells.size:
        raise ValueError(f"cells of {cells.size} m, settings for {chosen.cell} m")
    found = {kind: Found() for kind in FOUND}
    of_block = _blocks(cells, block)
    extent = extent_of(cells) if len(cells) else Window(0, 0, 0, 0)
    with Progress(len(of_block), "objects", "blocks", enabled=progress) as line:
        for (row, column), kinds in of_block.items():
            core = Window(row, column, block, block)
            near = CellView(cells, widened(core, round((MARGIN + AHEAD) / cells.size)), extent, chosen)
            for kind in kinds:
                _FINDERS[kind](near, core, found[kind])
            line.update()
    keys = [k for one in found.values() for k in one.keys]
    owners = [k for one in found.values() for k in one.owners]
    key = np.concatenate(keys) if keys else np.empty(0, np.int64)
    order = np.argsort(key, kind="stable")
    owner = np.concatenate(owners) if owners else np.empty(0, np.int64)
    return Objects(chosen, {kind: one.table() for kind, one in found.items()}, key[order], owner[order])


def _blocks(cells: Cells, block: int) -> dict[tuple[int, int], list[Kind]]:
    """First row and column of each block, and the kinds that are to be found there."""
    out: dict[tuple[int, int], list[Kind]] = {}
    for kind in FOUND:
        _, row, column = unpack(cells.of_kind(kind).key)
        if not row.size:
            continue
        row, column = row // block, column // block
        first, low = int(row[0]), int(column.min())  # keys are sorted by row
        across = int(column.max()) - low + 1
        there = _unique_of_sorted_runs((row - first) * across + (column - low))
        for at in there.tolist():
            place = (at // across + first) * block, (at % across + low) * block
            out.setdefault(place, []).append(kind)
    return out


def _unique_of_sorted_runs(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted different values, of many that repeat the one before."""
    return np.unique(values[np.r_[True, values[1:] != values[:-1]]])


def _bodies(number: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Every object's number, and the rows and columns of its cells, row by row."""
    flat = np.flatnonzero(number.ravel() >= 0)
    order = flat[np.argsort(number.ravel()[flat], kind="stable")]
    values = number.ravel()[order]
    if not values.size:
        return
    first = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    for start, end in zip(first, np.r_[first[1:], values.size], strict=True):
        yield int(values[start]), order[start:end] // number.shape[1], order[start:end] % number.shape[1]


def _buildings(near: CellView, core: Window, found: Found) -> None:
    view, mask, sure = whole(near, core, lambda view: view.roofs[0])
    chosen, z = view.chosen, view.roofs[1]
    area = chosen.cell**2
    number = roofs.building_parts(mask, z, step=chosen.step, smallest=int(np.ceil(chosen.roof_part / area)))
    number = _without_small(number, chosen.building_area / area)
    # Points of a wall that stands out, and low ones beside it, belong to the building beside them.
    theirs = np.where(number < 0, _beside(number), number)
    _keep(view, number, theirs, z, core, sure, Kind.BUILDING, found, measure.building)


def _decks(near: CellView, core: Window, found: Found) -> None:
    heights: list[NDArray] = []

    def masked(view: CellView) -> NDArray[np.bool_]:
        high = view.high(Kind.DECK)
        mask, z = roofs.roof_cells(high, np.full(high.shape, np.nan), 0.0)
        heights[:] = [z]
        return mask

    view, mask, sure = whole(near, core, masked)
    cell = view.chosen.cell
    number = roofs.building_parts(mask, heights[0], step=1.0, smallest=int(np.ceil(10.0 / cell**2)))
    number = _without_small(number, view.chosen.building_area / cell**2)
    theirs = np.where(number < 0, _beside(number), number)
    _keep(view, number, theirs, heights[0], core, sure, Kind.DECK, found, measure.deck)


def _spans(near: CellView, core: Window, found: Found) -> None:
    chosen = near.chosen

    def masked(view: CellView) -> NDArray[np.bool_]:
        tower = view.column(Kind.TOWER, "count", 0.0) > 0
        tower = _dilated(tower, round(1.5 / chosen.cell))
        mask = _dilated(~np.isnan(view.high(Kind.SPAN)), round(chosen.span_gap / chosen.cell / 2))
        return mask & ~tower

    view, mask, sure = whole(near, core, masked, beside=False)
    high = view.high(Kind.SPAN)
    joined, _ = scipy.ndimage.label(mask)
    number = _without_small(np.where(np.isnan(high), -1, joined - 1), 4)
    number = _parted(number, chosen)

    def measured(body: Body, size: float) -> dict[str, object]:
        found.paths.append(measure.path_of(body, size))
        return measure.span(body, size)

    _keep(view, number, number, high, core, sure, Kind.SPAN, found, measured)


def _parted(number: NDArray[np.int64], chosen: ObjectSettings) -> NDArray[np.int64]:
    """Wires that touch, parted where lines of them cross or bend."""
    out = np.full(number.shape, -1, np.int64)
    for _, r, c in _bodies(number):
        line = lines.parted(r, c, chosen.cell, chosen.span_gap)
        where, first = np.unique(line, return_index=True)
        out[r, c] = (r * number.shape[1] + c)[first[np.searchsorted(where, line)]]
    return out


def _trees(near: CellView, core: Window, found: Found) -> None:
    chosen = near.chosen
    size, high = chosen.cell, near.high(Kind.TREE)
    mask, roof = near.roofs
    with np.errstate(invalid="ignore"):
        # Chimneys, gutters and walls that were taken for leaves are no trees.
        high[mask & (high <= roof + 0.5)] = np.nan
    height = crowns.canopy(high, near.ground)
    s = crowns.smoothed(height, crowns.bell(chosen.smoothing / size))
    up = crowns.summits(s, min(1.5, chosen.tree_height / 2))
    heir = crowns.heirs(
        s, up, chosen.window / size, chosen.window_slope / size, crowns.REACH / 2 / size, chosen.saddle
    )
    top = crowns.crown_cells(s, up, heir, 0.3, 0.8 * chosen.tree_height, crowns.REACH / size)
    number = np.where(np.isnan(high), -1, top)
    z = np.where(np.isnan(high), near.ground + height, high)
    window = near.window
    for n, r, c in _bodies(number):
        tr, tc = n // window.columns + window.row, n % window.columns + window.column
        if not _inside(core, tr, tc) or len(r) * size**2 < chosen.tree_area:
            continue
        body = near.body(Kind.TREE, r, c, z)
        record = measure.tree(body, tr, tc, size)
        if not record["height"] >= chosen.tree_height:  # type: ignore[operator]
            continue
        identity = int(object_id(Kind.TREE, np.array(tr), np.array(tc)))
        found.add(identity, record, body)
        found.own(cell_keys(Kind.TREE, body.row, body.column), identity)


_FINDERS = {Kind.BUILDING: _buildings, Kind.TREE: _trees, Kind.SPAN: _spans, Kind.DECK: _decks}


def _keep(
    view: CellView,
    number: NDArray[np.int64],
    theirs: NDArray[np.int64],
    z: NDArray,
    core: Window,
    sure: Window,
    kind: Kind,
    found: Found,
    measured: Callable[[Body, float], Mapping[str, object]],
) -> None:
    """Keep the objects whose first cell lies in the block; `theirs` says whose points cells hold."""
    window, identities = view.window, {}
    for n, r, c in _bodies(number):
        row, column = int(r[0]) + window.row, int(c[0]) + window.column
        if _inside(core, row, column):
            identity = int(object_id(kind, np.array(row), np.array(column)))
            identities[n] = identity
            body = view.body(kind, r, c, z)
            record = dict(measured(body, view.chosen.cell))
            ends = ((body.row.min(), body.column.min()), (body.row.max(), body.column.max()))
            if not all(_inside(sure, *map(int, end)) for end in ends):
                record |= measure.judged([*filter(None, [record["reason"]]), measure.CUT])
            found.add(identity, record, body)
    for n, r, c in _bodies(np.where(np.isnan(view.high(kind)), -1, theirs)):
        if n in identities:
            found.own(cell_keys(kind, r + window.row, c + window.column), identities[n])


def _inside(core: Window, row: int, column: int) -> bool:
    return core.row <= row < core.row + core.rows and core.column <= column < core.column + core.columns


def _without_small(number: NDArray[np.int64], smallest: float) -> NDArray[np.int64]:
    inside = number >= 0
    if not inside.any():
        return number
    size = np.bincount(number[inside])
    return np.where(inside & (size[np.where(inside, number, 0)] >= smallest), number, -1)


def _beside(number: NDArray[np.int64]) -> NDArray[np.int64]:
    """The lowest number among each cell and its eight neighbors, -1 where none has one."""
    none = np.iinfo(np.int64).max
    lowest = scipy.ndimage.minimum_filter(np.where(number < 0, none, number), 3, mode="constant", cval=none)
    return np.where(lowest == none, -1, lowest)


def _dilated(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    return scipy.ndimage.binary_dilation(mask, AROUND, iterations=cells) if cells else mask
