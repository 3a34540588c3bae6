"""Find all objects in records of cells, block by block of the absolute grid.

Memory is that of a block with its surroundings and of what was found. A block is looked at with `MARGIN` around it, within
which the ground and crowns are what they are in the whole; where a building, span or deck that reaches into the block comes
near the rim of what is seen, more is looked at. An object is of the block that its first cell (a tree: its top) lies in.
So blocks, and tiles that hold as much, find exactly what one look at everything finds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.jit import device, njit
from ..base.progress import Progress
from . import crowns, lines, measure, roofs
from .cells import GROUND_CELLS, MM, Cells, Kind, cell_keys, object_id, point_keys, unpack
from .measure import Body
from .rasters import GROUND_REACH, Window

#: Meters around a place that decide about it, but for the extent of buildings, spans and decks.
MARGIN = GROUND_REACH + 2 * crowns.REACH
#: Meters more that are looked at first: most buildings that reach into a block end there, so few blocks are looked at twice.
AHEAD = 64.0
#: How far a roof goes on into what a classifier took for leaves, meters.
GROWTH = 3.0
#: How far the cells of a roof from which nothing came back lie from its rim at most, meters.
DARK = 6.0
#: Side of a block, cells.
BLOCK = 2048
#: Cells of a window beyond which no more is looked at around a block: objects that reach farther are cut, and say so.
MOST_CELLS = 64_000_000
#: Kinds that are found.
FOUND = (Kind.BUILDING, Kind.TREE, Kind.SPAN, Kind.DECK)


def _setting(default: float, what: str, low: float, high: float, unit: str = "m"):
    return field(default=default, metadata={"low": low, "high": high, "what": what, "unit": unit})


@dataclass(frozen=True)
class ObjectSettings:
    """How objects are told apart; wrong values raise an OptionError."""

    cell: float = _setting(
        0.5,
        "Side of the grid's cells: about 1.4 times the distance of points, so that few cells of a roof are empty; 1 for 2 "
        "points/m2",
        0.05,
        100,
    )
    building_height: float = _setting(1.5, "A building's cells are at least so high above the ground", 0, 100)
    building_area: float = _setting(4.0, "Smaller buildings are left out", 0, 10_000, "m2")
    step: float = _setting(
        2.5,
        "Roofs that differ by more along two thirds of their border are two buildings; 0 parts none",
        0,
        100,
    )
    roof_part: float = _setting(
        10.0, "Smaller parts of a roof (dormers) go with their neighbor", 0, 10_000, "m2"
    )
    tree_height: float = _setting(3.0, "Lower plants are not trees", 0, 100)
    tree_area: float = _setting(1.5, "Trees with smaller crowns are left out", 0, 1000, "m2")
    window: float = _setting(
        1.5, "Radius in which a tree has no second top, for a tree of no height", 0.1, 10
    )
    window_slope: float = _setting(0.1, "Added to the radius per meter of height", 0, 1, "")
    saddle: float = _setting(
        0.1,
        "Two tops that near are one tree where the saddle is no deeper than this share of the lower",
        0,
        1,
        "",
    )
    smoothing: float = _setting(0.35, "Standard deviation of the Gaussian that smooths the canopy", 0, 5)
    span_gap: float = _setting(2.0, "Wires with larger gaps are two spans", 0.5, 20)

    def __post_init__(self) -> None:
        for one in fields(self):
            checks.number(f"'{one.name}'", getattr(self, one.name), one.metadata["low"], one.metadata["high"])


@dataclass
class Table:
    """Objects of a kind, in the order of their ids."""

    ids: NDArray[np.int64]
    columns: dict[str, NDArray]
    #: Cells of object n are those from start[n] on: row, column and height (of a path: see `paths`).
    start: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    z: NDArray[np.float64]
    #: Of spans: the line (k, 3) along each.
    paths: list[NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.ids)

    def cells_of(self, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Rows, columns and heights of an object's cells."""
        part = slice(self.start[number], self.start[number + 1])
        return self.row[part], self.column[part], self.z[part]

    def having(self, reasons: Collection[str]) -> NDArray[np.bool_]:
        """Which objects are to be checked for one of the reasons."""
        texts = self.columns["reason"].tolist() if len(self) else []
        return np.array([any(one in reasons for one in str(text).split(", ")) for text in texts], bool)

    def only(self, kept: NDArray[np.bool_]) -> Table:
        """Some of the objects."""
        cells = np.repeat(kept, np.diff(self.start))
        return Table(
            self.ids[kept],
            {name: values[kept] for name, values in self.columns.items()},
            np.r_[0, np.cumsum(np.diff(self.start)[kept])].astype(np.int64),
            self.row[cells],
            self.column[cells],
            self.z[cells],
            [path for path, stays in zip(self.paths, kept, strict=True) if stays] if self.paths else [],
        )


@dataclass
class Objects:
    """All objects, by kind, and which cells' points are theirs."""

    settings: ObjectSettings
    tables: dict[Kind, Table]
    key: NDArray[np.int64]  # sorted keys of cells
    owner: NDArray[np.int64]  # id of the object that has their points

    def without(self, reasons: Collection[str]) -> tuple[Objects, int]:
        """The objects that are not to be checked for one of the reasons; how many are left out."""
        left = {kind: table.having(reasons) for kind, table in self.tables.items()}
        gone = np.concatenate([table.ids[left[kind]] for kind, table in self.tables.items()])
        if not gone.size:
            return self, 0
        stays = ~np.isin(self.owner, gone)
        tables = {kind: table.only(~left[kind]) for kind, table in self.tables.items()}
        return Objects(self.settings, tables, self.key[stays], self.owner[stays]), gone.size

    def ids_at(self, x: NDArray, y: NDArray, kinds: NDArray) -> NDArray[np.int64]:
        """The id of each point's object, 0 where it is of none; `kinds` are numbers of :class:`Kind`, or -1."""
        out = np.zeros(len(x), np.int64)
        rows = np.flatnonzero(kinds >= 0)
        if rows.size == 0 or self.key.size == 0:
            return out
        key = point_keys(x[rows], y[rows], kinds[rows], self.settings.cell)
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        out[rows] = np.where(self.key[at] == key, self.owner[at], 0)
        return out

    def summary(self) -> dict[str, dict[str, Any]]:
        """Of each kind (``buildings``): how many objects, how many are to be checked, and why."""
        out = {}
        for kind, table in self.tables.items():
            texts = table.columns["reason"].tolist() if len(table) else []
            reasons = [reason for text in texts for reason in text.split(", ") if reason]
            out[kind.name.lower() + "s"] = {
                "objects": len(table),
                "to_be_checked": int(np.count_nonzero(table.columns["verdict"] == measure.CHECK))
                if len(table)
                else 0,
                "reasons": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
            }
        return out


class _Found:
    """What blocks found so far."""

    def __init__(self) -> None:
        self.ids: list[int] = []
        self.records: list[dict[str, object]] = []
        self.cells: list[tuple[NDArray, NDArray, NDArray]] = []
        self.paths: list[NDArray] = []
        self.keys: list[NDArray] = []
        self.owners: list[NDArray] = []

    def table(self) -> Table:
        order = np.argsort(np.array(self.ids, np.int64), kind="stable")
        cells = [self.cells[n] for n in order]
        names = list(self.records[0]) if self.records else []
        columns = {name: np.array([self.records[n][name] for n in order]) for name in names}
        empty = np.empty(0)
        return Table(
            np.array(self.ids, np.int64)[order],
            columns,
            np.r_[0, np.cumsum([len(row) for row, _, _ in cells])].astype(np.int64),
            np.concatenate([row for row, _, _ in cells] or [empty]).astype(np.int64),
            np.concatenate([column for _, column, _ in cells] or [empty]).astype(np.int64),
            np.concatenate([z for _, _, z in cells] or [empty]),
            [self.paths[n] for n in order] if self.paths else [],
        )


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
    found = {kind: _Found() for kind in FOUND}
    of_block = _blocks(cells, block)
    extent = _extent(cells) if len(cells) else Window(0, 0, 0, 0)
    with Progress(len(of_block), "objects", "blocks", enabled=progress) as line:
        for (row, column), kinds in of_block.items():
            core = Window(row, column, block, block)
            near = _View(cells, _around(core, round((MARGIN + AHEAD) / cells.size)), extent, chosen)
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


def _around(core: Window, margin: int) -> Window:
    margin += margin % GROUND_CELLS
    return Window(core.row - margin, core.column - margin, core.rows + 2 * margin, core.columns + 2 * margin)


def _extent(cells: Cells) -> Window:
    """The rectangle that holds all cells, and an empty rim."""
    kind, row, column = unpack(cells.key)
    wide = np.where(kind == Kind.GROUND, GROUND_CELLS, 1)
    lows = [int((v * wide).min()) - 8 for v in (row, column)]
    lows = [v - v % GROUND_CELLS for v in lows]
    sizes = [int(((v + 1) * wide).max()) + 8 - low for v, low in zip((row, column), lows, strict=True)]
    return Window(*lows, *(n + n % GROUND_CELLS for n in sizes))


def _common(a: Window, b: Window) -> Window:
    row, column = max(a.row, b.row), max(a.column, b.column)
    rows = min(a.row + a.rows, b.row + b.rows) - row
    return Window(row, column, rows, min(a.column + a.columns, b.column + b.columns) - column)


class _View:
    """What the cells of a window hold, as arrays of the part of it that has any; what several kinds need is made once."""

    def __init__(self, cells: Cells, window: Window, extent: Window, chosen: ObjectSettings) -> None:
        self.cells, self.seen, self.extent, self.chosen = cells, window, extent, chosen
        self.window = _common(window, extent)
        self._held: dict[Kind, tuple[Cells, NDArray, NDArray]] = {}
        self._places: dict[Kind, NDArray[np.int32]] = {}

    def wider(self, margin: int) -> _View:
        """The same with more around it."""
        return _View(self.cells, _around(self.seen, margin), self.extent, self.chosen)

    def held(self, kind: Kind) -> tuple[Cells, NDArray[np.int64], NDArray[np.int64]]:
        """The cells of a kind, and their rows and columns in the window."""
        if kind not in self._held:
            inside = self.window.of(self.cells, kind)
            _, row, column = unpack(inside.key)
            self._held[kind] = inside, row - self.window.row, column - self.window.column
        return self._held[kind]

    def column(self, kind: Kind, name: str, empty: float) -> NDArray[np.float64]:
        """What cells of a kind hold, `empty` where there is none."""
        inside, row, column = self.held(kind)
        out = np.full((self.window.rows, self.window.columns), empty)
        out[row, column] = inside.columns[name]
        return out

    def high(self, kind: Kind) -> NDArray[np.float64]:
        """Height of the highest point of a kind, meters; NaN where there is none."""
        return self.column(kind, "high", np.nan) / MM

    @cached_property
    def ground(self) -> NDArray[np.float64]:
        """Height of the ground, meters; NaN where it is not known."""
        return self.window.ground(self.cells)

    @cached_property
    def roofs(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Cells of roofs, gone on into vegetation in their planes and over gaps of sparse ones, and their heights."""
        chosen = self.chosen
        leaves = self.high(Kind.TREE)
        seen = self.window.has_ground(self.cells)
        seen |= ~np.isnan(leaves) | (self.column(Kind.OTHER, "count", 0.0) > 0)
        with np.errstate(invalid="ignore"):
            leaves[leaves - self.ground < chosen.building_height] = np.nan
        thick = leaves - self.column(Kind.TREE, "low", np.nan) / MM
        reach = round(GROWTH / chosen.cell)
        high = roofs.continued(self.high(Kind.BUILDING), leaves, thick, chosen.cell, reach)
        high = np.where(high - self.ground < chosen.building_height, np.nan, high)
        high = roofs.covered(high, seen, round(DARK / chosen.cell))
        return roofs.roof_cells(high, self.ground, chosen.building_height)

    def _place(self, kind: Kind) -> NDArray[np.int32]:
        """Where among the cells of a kind each of the window is, -1 for those that are not."""
        if kind not in self._places:
            inside, row, column = self.held(kind)
            self._places[kind] = np.full((self.window.rows, self.window.columns), -1, np.int32)
            self._places[kind][row, column] = np.arange(len(inside))
        return self._places[kind]

    def body(self, kind: Kind, r: NDArray, c: NDArray, z: NDArray) -> Body:
        """An object's cells, of which rows and columns in the window are given, with heights `z` of the window."""
        known, at = self.held(kind)[0], self._place(kind)[r, c]
        there = at >= 0

        def held(name: str, empty: float) -> NDArray:
            return np.where(there, known.columns[name][at], empty)

        return Body(
            r + self.window.row,
            c + self.window.column,
            z[r, c],
            held("low", np.nan) / MM,
            self.ground[r, c],
            held("count", 0).astype(np.int64),
            held("sure", 0.0),
            held("told", 0).astype(np.int64),
        )


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


def _part(window: Window, part: Window) -> tuple[slice, slice]:
    """Where in a window's arrays another lies."""
    common = _common(window, part)
    row, column = common.row - window.row, common.column - window.column
    return slice(row, row + max(common.rows, 0)), slice(column, column + max(common.columns, 0))


def _whole(
    near: _View, core: Window, masked: Callable[[_View], NDArray[np.bool_]], beside: bool = True
) -> tuple[_View, NDArray[np.bool_], Window]:
    """A block's view with as much around it as it takes for all that reaches into the block to be whole.

    The last is the window within which they are: only objects larger than a window may be go beyond it. `beside`: cells
    beside an object are looked at, too, so objects a cell apart reach as far as both.
    """
    margin = round(MARGIN / near.chosen.cell)
    view, around = near, near.seen.rows - core.rows >> 1
    while True:
        mask = masked(view)
        wide = roofs.dilated(mask) if beside else mask
        first = roofs.connected(wide, np.zeros(mask.shape), np.inf)
        sure = _around(view.seen, -margin)
        reached = np.zeros(mask.size + 1, bool)  # the last: no part
        reached[first[_part(view.window, core)]] = True
        first[_part(view.window, sure)] = -1
        if not reached[first[first >= 0]].any() or mask.size > MOST_CELLS:
            return view, mask, sure
        more = max(margin, around // 2)
        view, around = view.wider(more), around + more


def _buildings(near: _View, core: Window, found: _Found) -> None:
    view, mask, sure = _whole(near, core, lambda view: view.roofs[0])
    chosen, z = view.chosen, view.roofs[1]
    area = chosen.cell**2
    number = roofs.building_parts(mask, z, step=chosen.step, smallest=int(np.ceil(chosen.roof_part / area)))
    number = _without_small(number, chosen.building_area / area)
    # Points of a wall that stands out, and low ones beside it, belong to the building beside them.
    theirs = np.where(number < 0, _beside(number), number)
    _keep(view, number, theirs, z, core, sure, Kind.BUILDING, found, measure.building)


def _decks(near: _View, core: Window, found: _Found) -> None:
    heights: list[NDArray] = []

    def masked(view: _View) -> NDArray[np.bool_]:
        high = view.high(Kind.DECK)
        mask, z = roofs.roof_cells(high, np.full(high.shape, np.nan), 0.0)
        heights[:] = [z]
        return mask

    view, mask, sure = _whole(near, core, masked)
    cell = view.chosen.cell
    number = roofs.building_parts(mask, heights[0], step=1.0, smallest=int(np.ceil(10.0 / cell**2)))
    number = _without_small(number, view.chosen.building_area / cell**2)
    theirs = np.where(number < 0, _beside(number), number)
    _keep(view, number, theirs, heights[0], core, sure, Kind.DECK, found, measure.deck)


def _spans(near: _View, core: Window, found: _Found) -> None:
    chosen = near.chosen

    def masked(view: _View) -> NDArray[np.bool_]:
        tower = view.column(Kind.TOWER, "count", 0.0) > 0
        for _ in range(round(1.5 / chosen.cell)):
            tower = roofs.dilated(tower)
        mask = ~np.isnan(view.high(Kind.SPAN))
        for _ in range(round(chosen.span_gap / chosen.cell / 2)):
            mask = roofs.dilated(mask)
        return mask & ~tower

    view, mask, sure = _whole(near, core, masked, beside=False)
    high = view.high(Kind.SPAN)
    joined = roofs.connected(mask, np.zeros(mask.shape), np.inf)
    number = roofs.numbered(np.where(np.isnan(high), -1, joined))
    number = _without_small(number, 4)
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
    return roofs.numbered(out)


def _trees(near: _View, core: Window, found: _Found) -> None:
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
        _add(found, identity, record, body)
        found.keys.append(cell_keys(Kind.TREE, body.row, body.column))
        found.owners.append(np.full(len(r), identity))


_FINDERS = {Kind.BUILDING: _buildings, Kind.TREE: _trees, Kind.SPAN: _spans, Kind.DECK: _decks}


def _keep(
    view: _View,
    number: NDArray[np.int64],
    theirs: NDArray[np.int64],
    z: NDArray,
    core: Window,
    sure: Window,
    kind: Kind,
    found: _Found,
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
            _add(found, identity, record, body)
    for n, r, c in _bodies(np.where(np.isnan(view.high(kind)), -1, theirs)):
        if n in identities:
            found.keys.append(cell_keys(kind, r + window.row, c + window.column))
            found.owners.append(np.full(len(r), identities[n]))


def _add(found: _Found, identity: int, record: dict[str, object], body: Body) -> None:
    found.ids.append(identity)
    found.records.append(record)
    found.cells.append((body.row, body.column, body.z))


def _inside(core: Window, row: int, column: int) -> bool:
    return core.row <= row < core.row + core.rows and core.column <= column < core.column + core.columns


def _without_small(number: NDArray[np.int64], smallest: float) -> NDArray[np.int64]:
    inside = number >= 0
    if not inside.any():
        return number
    size = np.bincount(number[inside])
    return np.where(inside & (size[np.where(inside, number, 0)] >= smallest), number, -1)


@njit
def _beside(number: NDArray) -> NDArray:
    """The lowest number among the eight neighbors of each cell, -1 where none has one."""
    rows, columns = number.shape
    out = np.full(number.shape, -1, np.int64)
    for r in range(rows):
        for c in range(columns):
            out[r, c] = _lowest(number, r, c)
    return out


@device
def _lowest(number, r, c):
    best = -1
    for i in range(max(r - 1, 0), min(r + 2, number.shape[0])):
        for j in range(max(c - 1, 0), min(c + 2, number.shape[1])):
            n = number[i, j]
            if n >= 0 and (best < 0 or n < best):
                best = n
    return best
