"""Detect all objects in records of cells, block by block of the absolute grid.

Memory is that of one block with its surroundings, and of the objects. A block is seen with
`MARGIN` around it, within which ground and crowns are those of the whole area; where a building or
deck that reaches into the block comes near the rim of the view, the view is widened. An object
belongs to the block that its first cell (a tree: its top) lies in. So blocks, and tiles with as
much around them, give exactly the objects of the whole area. Spans of wires, which are few, are
found in the whole area at once (:mod:`.spans`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, group_by_key, split_keys
from ..base.hashing import hash_rows
from ..base.json_types import JsonObject
from ..base.progress import Progress
from . import attributes, crowns
from .attributes import ObjectCells
from .cells import MM, Cells, Kind, WireCubes, object_id
from .raster_view import MARGIN, CellView, pad_evenly
from .results import Objects, ObjectSettings, ObjectTable
from .spans import number_spans

# `LOOKAHEAD` and `BLOCK` change time and memory, not results. The other values are not tuned.
#: Meters beyond `MARGIN` in the first view: most buildings that reach into a block end there.
LOOKAHEAD = 64.0
#: Side of a block, cells: several times as wide as the surroundings that are read again.
BLOCK = 2048
#: Vegetation on a roof counts as roof up to this height above it (chimneys, gutters), meters.
ROOF_TOLERANCE = 0.5


class _Object(NamedTuple):
    identity: int
    record: JsonObject  # measures and verdict
    cells: ObjectCells
    keys: NDArray[np.int64]  # of the cells whose points belong to it


def find_objects(
    cells: Cells,
    settings: ObjectSettings | None = None,
    *,
    block: int = BLOCK,
    progress: bool | None = None,
) -> Objects:
    """Return all objects of an area.

    Parameters
    ----------
    cells : Cells
        Records of all points of the area, by :meth:`Cells.from_points`; objects near its edge may
        be incomplete.
    settings : ObjectSettings, optional
        Its `cell` is that of the records.
    block : int
        Side of the blocks of work, in cells; even. It changes nothing but memory.
    progress : bool, optional
        Whether to show progress on stderr.
    """
    settings = replace(settings or ObjectSettings(), cell=cells.size)
    kinds_of_block: dict[tuple[int, int], list[Kind]] = {}
    for kind in (*_DETECTORS, Kind.SPAN):
        column, row, _ = split_keys(cells.of_kind(kind).key)
        for j, i in np.unique(np.stack([row // block, column // block]), axis=1).T.tolist():
            kinds_of_block.setdefault((j, i), []).append(kind)
    detected: dict[Kind, list[_Object]] = {kind: [] for kind in (*_DETECTORS, Kind.SPAN)}
    wire_cells = cells.of_kind(Kind.SPAN).key
    ground = np.full(len(wire_cells), np.nan)
    with Progress(len(kinds_of_block), "objects", "blocks", enabled=progress) as progress_line:
        for (j, i), kinds in kinds_of_block.items():
            core = GridWindow(i * block, j * block, block, block)
            window = pad_evenly(core, round((MARGIN + LOOKAHEAD) / cells.size))
            view = CellView(cells, window, settings)
            for kind in kinds:
                if kind == Kind.SPAN:
                    key, height = view.ground_below(kind, core)
                    ground[np.searchsorted(wire_cells, key)] = height
                else:
                    detected[kind] += _DETECTORS[kind](view, core, kind)
            progress_line.update()
    every = [each for objects in detected.values() for each in objects]
    detected[Kind.SPAN], span = _find_spans(cells.wires, wire_cells, ground)
    key = np.concatenate([np.empty(0, np.int64), *(each.keys for each in every)])
    identities = np.array([each.identity for each in every], np.int64)
    owner = np.repeat(identities, [len(each.keys) for each in every])
    order = np.argsort(key, kind="stable")
    tables = {kind: _table(objects) for kind, objects in detected.items()}
    return Objects(settings, tables, key[order], owner[order], cells.wires, span)


def _table(objects: list[_Object]) -> ObjectTable:
    objects = sorted(objects, key=lambda each: each.identity)
    names = [name for name in (objects[0].record if objects else ()) if name != "path"]
    return ObjectTable(
        np.array([each.identity for each in objects], np.int64),
        {name: np.array([each.record[name] for each in objects]) for name in names},
        [(each.cells.row, each.cells.column, each.cells.z) for each in objects],
        [each.record["path"] for each in objects if "path" in each.record],
    )


def _parts(label: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Yield each label from 0, and the rows and columns of its cells, row by row."""
    flat = np.flatnonzero(label.ravel() >= 0)
    order = flat[np.argsort(label.ravel()[flat], kind="stable")]
    values, first = np.unique(label.ravel()[order], return_index=True)
    for n, cells in zip(values.tolist(), np.split(order, first[1:]), strict=False):
        yield n, cells // label.shape[1], cells % label.shape[1]


def _detect_surfaces(view: CellView, core: GridWindow, kind: Kind) -> Iterator[_Object]:
    """Yield buildings or decks."""
    view, mask = view.widened_to_whole(core, lambda view: view.roof_or_deck(kind)[0])
    settings, z = view.settings, view.roof_or_deck(kind)[1]
    label = scipy.ndimage.label(mask)[0].astype(np.int64) - 1
    label = _without_small(label, settings.building_area / settings.cell**2)
    building = kind == Kind.BUILDING
    measure = attributes.measure_building if building else attributes.measure_deck
    # Points of a protruding wall, and low ones beside it, belong to the lowest label beside them.
    none = np.iinfo(np.int64).max
    beside = np.where(label < 0, none, label)
    beside = scipy.ndimage.minimum_filter(beside, 3, mode="constant", cval=none)
    owner = np.where((label < 0) & (beside < none), beside, label)
    return _measured(view, label, owner, z, core, kind, measure)


def _find_spans(
    wires: WireCubes, wire_cells: NDArray[np.int64], ground: NDArray[np.float64]
) -> tuple[list[_Object], NDArray[np.int64]]:
    """Return all spans, and the id (w,) of the one that each cube of wires is part of; 0 for none.

    `ground` (m,) is the height of the ground below cells with wires, by their sorted keys.
    """
    number = number_spans(wires)
    spans, identity = [], np.zeros(len(number), np.int64)
    column, row, _ = wires.place.T
    below = ground[np.searchsorted(wire_cells, cell_keys(column, row, Kind.SPAN))]
    values = wires.columns
    for rows in group_by_key(number):
        if number[rows[0]] < 0:
            continue
        cells = ObjectCells(
            row[rows],
            column[rows],
            values["high"][rows] / MM,
            values["low"][rows] / MM,
            below[rows],
            values["count"][rows].astype(np.int64),
            values["reliability"][rows].astype(np.float64),
            values["rated"][rows].astype(np.int64),
        )
        # Conductors above each other begin in the same cell: the id is of the first cube.
        first = hash_rows(wires.place[rows[:1]].T, 0).astype(np.int64)
        identity[rows] = object_id(Kind.SPAN, first >> 25, first)[0]
        record = attributes.measure_span(cells, wires.size)
        spans.append(_Object(int(identity[rows[0]]), record, cells, np.empty(0, np.int64)))
    return spans, identity


def _detect_trees(view: CellView, core: GridWindow, kind: Kind) -> Iterator[_Object]:
    """Yield trees; see :mod:`.crowns`."""
    settings, window = view.settings, view.window
    size, high = settings.cell, view.highest(kind)
    mask, roof = view.roof_or_deck(Kind.BUILDING)
    with np.errstate(invalid="ignore"):
        high[mask & (high <= roof + ROOF_TOLERANCE)] = np.nan
    height = crowns.canopy(high, view.ground)
    top = crowns.crown_cells(
        crowns.smooth(height, crowns.SMOOTHING / size),
        settings.tree_height,
        settings.saddle,
        crowns.REACH / size,
    )
    label = np.where(np.isnan(high), -1, top)
    z = np.where(np.isnan(high), view.ground + height, high)
    for n, r, c in _parts(label):
        row, column = n // window.width + window.bottom, n % window.width + window.left
        if not core.contains(column, row) or len(r) * size**2 < settings.tree_area:
            continue
        cells = view.object_cells(kind, r, c, z)
        record = attributes.measure_tree(cells, row, column, size)
        if record["height"] >= settings.tree_height:
            keys = cell_keys(cells.column, cells.row, kind)
            yield _Object(int(object_id(kind, row, column)), record, cells, keys)


_DETECTORS = {
    Kind.BUILDING: _detect_surfaces,
    Kind.TREE: _detect_trees,
    Kind.DECK: _detect_surfaces,
}


def _measured(
    view: CellView,
    label: NDArray[np.int64],
    owner: NDArray[np.int64],
    z: NDArray,
    core: GridWindow,
    kind: Kind,
    measure: Callable[[ObjectCells, float], JsonObject],
) -> Iterator[_Object]:
    """Yield the objects whose first cell lies in the block; `owner` labels cells' points."""
    window, none = view.window, np.empty(0, np.int64)
    keys = {
        n: cell_keys(c + window.left, r + window.bottom, kind)
        for n, r, c in _parts(np.where(np.isnan(view.highest(kind)), -1, owner))
    }
    for n, r, c in _parts(label):
        row, column = int(r[0]) + window.bottom, int(c[0]) + window.left
        if core.contains(column, row):
            cells = view.object_cells(kind, r, c, z)
            record = measure(cells, view.settings.cell)
            yield _Object(int(object_id(kind, row, column)), record, cells, keys.get(n, none))


def _without_small(label: NDArray[np.int64], smallest: float) -> NDArray[np.int64]:
    """Return labels with -1 in place of those of fewer than `smallest` cells."""
    size = np.bincount(label.ravel() + 1)
    size[0] = 0
    return np.where(size[label + 1] >= smallest, label, -1)
