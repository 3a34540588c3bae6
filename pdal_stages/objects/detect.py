"""Find all objects in records of cells, block by block of the absolute grid.

Memory is that of a block with its surroundings and of what was found. A block is looked at with `MARGIN` around it, within
which the ground and crowns are what they are in the whole; where a building, span or deck that reaches into the block comes
near the rim of what is seen, more is looked at. An object is of the block that its first cell (a tree: its top) lies in.
So blocks, and tiles that hold as much, find exactly what one look at everything finds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.progress import Progress
from . import attributes, crowns, roofs
from .attributes import Body
from .cells import Cells, Kind, cell_keys, object_id, unpack
from .raster_view import AROUND, MARGIN, CellView, Window
from .results import Objects, ObjectSettings, Table

#: Meters more that are looked at first: most buildings that reach into a block end there, so few blocks are looked at twice.
AHEAD = 64.0
#: Side of a block, cells.
BLOCK = 2048
#: Kinds that are found.
FOUND = (Kind.BUILDING, Kind.TREE, Kind.SPAN, Kind.DECK)


def find_objects(
    cells: Cells,
    settings: ObjectSettings | None = None,
    *,
    block: int = BLOCK,
    progress: bool | None = None,
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
    found: dict[Kind, list[_One]] = {kind: [] for kind in FOUND}
    of_block: dict[tuple[int, int], list[Kind]] = {}
    for kind in FOUND:
        _, row, column = unpack(cells.of_kind(kind).key)
        for north, east in np.unique(np.stack([row // block, column // block]), axis=1).T.tolist():
            of_block.setdefault((north, east), []).append(kind)
    with Progress(len(of_block), "objects", "blocks", enabled=progress) as line:
        for (north, east), kinds in of_block.items():
            core = Window(north * block, east * block, block, block)
            near = CellView(cells, core.widened(round((MARGIN + AHEAD) / cells.size)), chosen)
            for kind in kinds:
                found[kind] += _FINDERS[kind](near, core, kind)
            line.update()
    none = [np.empty(0, np.int64)]
    key = np.concatenate(none + [one.keys for ones in found.values() for one in ones])
    owner = np.repeat(
        np.array([one.identity for ones in found.values() for one in ones], np.int64),
        [len(one.keys) for ones in found.values() for one in ones],
    )
    order = np.argsort(key, kind="stable")
    return Objects(
        chosen, {kind: _table(ones) for kind, ones in found.items()}, key[order], owner[order]
    )


class _One(NamedTuple):
    """An object: its id, what was measured, its cells, and the keys of those that hold its points."""

    identity: int
    record: dict[str, Any]
    body: Body
    keys: NDArray[np.int64]


def _table(ones: list[_One]) -> Table:
    ones = sorted(ones, key=lambda one: one.identity)
    columns = {
        name: np.array([one.record[name] for one in ones])
        for name in (ones[0].record if ones else ())
        if name != "path"
    }
    return Table(
        np.array([one.identity for one in ones], np.int64),
        columns,
        [np.column_stack([one.body.row, one.body.column, one.body.z]) for one in ones],
        [one.record["path"] for one in ones if "path" in one.record],
    )


def _bodies(
    number: NDArray[np.int64],
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Every object's number, and the rows and columns of its cells, row by row."""
    flat = np.flatnonzero(number.ravel() >= 0)
    order = flat[np.argsort(number.ravel()[flat], kind="stable")]
    values, first = np.unique(number.ravel()[order], return_index=True)
    for n, cells in zip(values.tolist(), np.split(order, first[1:]), strict=False):
        yield n, cells // number.shape[1], cells % number.shape[1]


def _surfaces(near: CellView, core: Window, kind: Kind) -> Iterator[_One]:
    """Buildings and decks."""
    view, mask = near.whole(core, lambda view: view.surface(kind)[0])
    chosen, z = view.chosen, view.surface(kind)[1]
    area = chosen.cell**2
    step, part = (chosen.step, chosen.roof_part) if kind == Kind.BUILDING else (1.0, 10.0)
    number = roofs.building_parts(mask, z, step=step, smallest=int(np.ceil(part / area)))
    number = _without_small(number, chosen.building_area / area)
    # Points of a wall that stands out, and low ones beside it, belong to the lowest number beside them.
    none = np.iinfo(np.int64).max
    beside = np.where(number < 0, none, number)
    beside = scipy.ndimage.minimum_filter(beside, 3, mode="constant", cval=none)
    theirs = np.where((number < 0) & (beside < none), beside, number)
    measured = attributes.building if kind == Kind.BUILDING else attributes.deck
    return _objects(view, number, theirs, z, core, kind, measured)


def _spans(near: CellView, core: Window, kind: Kind) -> Iterator[_One]:
    chosen = near.chosen

    def dilated(mask: NDArray[np.bool_], meters: float) -> NDArray[np.bool_]:
        cells = round(meters / chosen.cell)
        return scipy.ndimage.binary_dilation(mask, AROUND, iterations=cells) if cells else mask

    def masked(view: CellView) -> NDArray[np.bool_]:
        tower, wire = (view.held(one)[1] >= 0 for one in (Kind.TOWER, kind))
        return dilated(wire, chosen.span_gap / 2) & ~dilated(tower, 1.5)

    view, mask = near.whole(core, masked, beside=False)
    high = view.high(kind)
    joined, _ = scipy.ndimage.label(mask)
    number = _without_small(np.where(np.isnan(high), -1, joined - 1), 4)
    return _objects(view, number, number, high, core, kind, attributes.span)


def _trees(near: CellView, core: Window, kind: Kind) -> Iterator[_One]:
    chosen, window = near.chosen, near.window
    size, high = chosen.cell, near.high(kind)
    mask, roof = near.surface(Kind.BUILDING)
    with np.errstate(invalid="ignore"):
        # Chimneys, gutters and walls that were taken for leaves are no trees.
        high[mask & (high <= roof + 0.5)] = np.nan
    height = crowns.canopy(high, near.ground)
    top = crowns.crown_cells(
        crowns.smoothed(height, chosen.smoothing / size),
        chosen.tree_height,
        chosen.saddle,
        crowns.REACH / size,
    )
    number = np.where(np.isnan(high), -1, top)
    z = np.where(np.isnan(high), near.ground + height, high)
    for n, r, c in _bodies(number):
        tr, tc = n // window.columns + window.row, n % window.columns + window.column
        if not core.holds(tr, tc) or len(r) * size**2 < chosen.tree_area:
            continue
        body = near.body(kind, r, c, z)
        record = attributes.tree(body, tr, tc, chosen)
        if record["height"] >= chosen.tree_height:
            yield _One(
                int(object_id(kind, tr, tc)), record, body, cell_keys(kind, body.row, body.column)
            )


_FINDERS = {Kind.BUILDING: _surfaces, Kind.TREE: _trees, Kind.SPAN: _spans, Kind.DECK: _surfaces}


def _objects(
    view: CellView,
    number: NDArray[np.int64],
    theirs: NDArray[np.int64],
    z: NDArray,
    core: Window,
    kind: Kind,
    measured: Callable[[Body, float], dict[str, Any]],
) -> Iterator[_One]:
    """The objects whose first cell lies in the block; `theirs` says whose points cells hold."""
    window, none = view.window, np.empty(0, np.int64)
    keys = {
        n: cell_keys(kind, r + window.row, c + window.column)
        for n, r, c in _bodies(np.where(np.isnan(view.high(kind)), -1, theirs))
    }
    for n, r, c in _bodies(number):
        row, column = int(r[0]) + window.row, int(c[0]) + window.column
        if core.holds(row, column):
            body = view.body(kind, r, c, z)
            record = measured(body, view.chosen.cell)
            yield _One(int(object_id(kind, row, column)), record, body, keys.get(n, none))


def _without_small(number: NDArray[np.int64], smallest: float) -> NDArray[np.int64]:
    size = np.bincount(number.ravel() + 1)
    size[0] = 0
    return np.where(size[number + 1] >= smallest, number, -1)
