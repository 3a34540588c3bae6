"""What tiles share along their edges, so that points there are computed once, not by each tile near them.

The rules at the end look at classes beyond a tile, and a second pass at the votes of a first one beyond these: together a
tile of 500 m would compute a quarter more than its own points. Instead it leaves what it found of points on both sides of
its edges in a file, apart for each tile beside, and those that run later take what is there. It is only ever a short cut:
the values are those that the tile would find itself, so neither the order of tiles nor what is missing changes a bit.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..stages.base import AtEdges
from .extract import Piece
from .grid import TileGrid
from .kept import load_arrays, save_arrays
from .store import edges_file
from .tileplan import INPUT, ROW, SharedEdges

#: The tiles beside one.
_BESIDE = [(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1) if (i, j) != (0, 0)]
#: What is left of points: what was found on the way, and results.
_VOTES, _RESULTS = "votes", "results"
#: Arrays of both: by input how many points, and their numbers there.
_NUMBERED = [f"{what}/{name}" for what in (_VOTES, _RESULTS) for name in ("counts", "numbers")]


class TileEdges:
    """What a tile takes of those beside, and leaves them.

    Parameters
    ----------
    shared : SharedEdges
    grid : TileGrid
    unit : float
        Meters per unit of the coordinates.
    tile : (int, int)
    pieces : list of Piece
        What was read for it.
    folder, scratch : str
        Where files are, and the run's folder for temporary ones.
    """

    def __init__(
        self,
        shared: SharedEdges,
        grid: TileGrid,
        unit: float,
        tile: tuple[int, int],
        pieces: list[Piece],
        folder: str,
        scratch: str,
    ) -> None:
        self.shared = shared
        self._grid, self._unit, self._tile, self._pieces = grid, unit, tile, pieces
        self._folder, self._scratch = folder, scratch
        self._piece = self._row = np.empty(0, np.uint32)
        self._near: dict[tuple[int, int], dict[str, NDArray[np.bool_]]] = {}
        self._left: dict[str, NDArray] = {}
        self._names: list[str] = []

    # ---- what others found -------------------------------------------------------------------------------

    def found(self, arrays: Mapping[str, NDArray], names: Sequence[str]) -> AtEdges:
        """What the tiles beside found of points whose dimensions these are: results of these names."""
        self._names = list(names)
        self._piece, self._row = np.array(arrays[INPUT]), np.array(arrays[ROW])
        self._near = dict(self._beside(arrays["X"], arrays["Y"]))
        places = []
        for number, piece in enumerate(self._pieces):
            place = np.full(len(piece.index), -1, np.int32)
            at = np.flatnonzero(self._piece == number)
            place[self._row[at]] = at
            places.append(place)
        votes: list[tuple[NDArray, NDArray]] = []
        results: list[tuple[NDArray, dict[str, NDArray]]] = []
        for i, j in _BESIDE:
            path = self._path((self._tile[0] + i, self._tile[1] + j))
            if not os.path.exists(path):
                continue
            mine = f"{-i}_{-j}/"
            names = ["inputs", f"{_VOTES}/values", *_NUMBERED, *(f"result/{name}" for name in self._names)]
            try:
                kept = load_arrays(path, [mine + name for name in names])
            except StageError:  # cut by a crash, or gone: it is computed here
                continue
            if not kept:
                continue
            kept = {name.removeprefix(mine): values for name, values in kept.items()}
            chosen, rows = self._rows(kept, _VOTES, places)
            votes.append((rows, kept[f"{_VOTES}/values"][chosen]))
            chosen, rows = self._rows(kept, _RESULTS, places)
            results.append((rows, {name: kept[f"result/{name}"][chosen] for name in self._names}))
        return _joined(votes, results)

    def _rows(
        self, kept: Mapping[str, NDArray], what: str, places: list[NDArray]
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Which of the points in a file are here, and the rows of these."""
        numbers = kept[f"{what}/numbers"]
        rows = np.full(len(numbers), -1, np.int64)
        ends = np.cumsum(kept[f"{what}/counts"])
        inputs = dict(
            zip(kept["inputs"].tolist(), zip(ends - kept[f"{what}/counts"], ends, strict=True), strict=True)
        )
        for piece, place in zip(self._pieces, places, strict=True):
            for source, first, end in piece.spans:
                begin, stop = inputs.get(source.key, (0, 0))
                if begin == stop:
                    continue
                index, given = piece.index[first:end], numbers[begin:stop]
                at = np.searchsorted(index, given)
                at[at == len(index)] = 0
                rows[begin:stop] = np.where(index[at] == given, place[first + at], -1)
        chosen = rows >= 0
        return chosen, rows[chosen]

    # ---- what is left to others --------------------------------------------------------------------------

    def take(self, found: AtEdges) -> None:
        """What was found of the points of :meth:`found`."""
        keys = sorted({source.key for piece in self._pieces for source, *_ in piece.spans})
        number = {key: n for n, key in enumerate(keys)}
        left: dict[str, NDArray] = {}
        for (i, j), near in self._near.items():
            mine = f"{i}_{j}/"
            left[f"{mine}inputs"] = np.array(keys)
            rows, values = found.votes
            some = near[_VOTES][rows]
            order = self._numbered(rows[some], number, left, f"{mine}{_VOTES}")
            left[f"{mine}{_VOTES}/values"] = values[some][order]
            rows = found.rows[near[_RESULTS][found.rows]]
            order = self._numbered(rows, number, left, f"{mine}{_RESULTS}")
            for name, column in found.results.items():
                left[f"{mine}result/{name}"] = column[rows[order]]
        self._left = left
        self._near = {}

    def _numbered(
        self, rows: NDArray[np.int64], number: Mapping[str, int], left: dict[str, NDArray], what: str
    ) -> NDArray[np.int64]:
        """Note whose points rows are, and their numbers there; the order in which these are noted."""
        source, index = np.empty(len(rows), np.int32), np.empty(len(rows), np.int64)
        of_piece, row = self._piece[rows], self._row[rows]
        for n, piece in enumerate(self._pieces):
            at = np.flatnonzero(of_piece == n)
            mine = row[at]
            index[at] = piece.index[mine]
            ends = np.array([end for *_, end in piece.spans])
            whose = np.array([number[one.key] for one, *_ in piece.spans], np.int32)
            source[at] = whose[np.searchsorted(ends, mine, side="right")]
        order = np.lexsort((index, source))
        left[f"{what}/numbers"] = index[order]
        left[f"{what}/counts"] = np.bincount(source, minlength=len(number))
        return order

    def save(self) -> None:
        """Write what is left to the tiles beside, where there is room for it."""
        if self._left:
            with contextlib.suppress(StageError, OSError):
                save_arrays(self._path(self._tile), self._left, self._scratch)

    def _beside(
        self, x: NDArray, y: NDArray
    ) -> Iterator[tuple[tuple[int, int], dict[str, NDArray[np.bool_]]]]:
        """For each tile beside, the points near enough for votes and for results."""
        for i, j in _BESIDE:
            near = {}
            tile = self._tile[0] + i, self._tile[1] + j
            for what, wide in ((_VOTES, self.shared.votes_m), (_RESULTS, self.shared.results_m)):
                x0, y0, x1, y1 = self._grid.box(tile, wide / self._unit)
                near[what] = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
            if near[_VOTES].any():
                yield (i, j), near

    def _path(self, tile: tuple[int, int]) -> str:
        return os.path.join(self._folder, edges_file(self._grid.name(tile)))


def _joined(
    votes: list[tuple[NDArray, NDArray]], results: list[tuple[NDArray, dict[str, NDArray]]]
) -> AtEdges:
    """What several tiles found, each point once."""
    none = np.empty(0, np.int64)
    if not votes:
        return AtEdges((none, none), none, {})
    rows, once = np.unique(np.concatenate([rows for rows, _ in votes]), return_index=True)
    shares = np.concatenate([values for _, values in votes])[once]
    own, first = np.unique(np.concatenate([rows for rows, _ in results]), return_index=True)
    named = {name: np.concatenate([values[name] for _, values in results])[first] for name in results[0][1]}
    return AtEdges((rows, shares), own, named)
