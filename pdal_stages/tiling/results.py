"""New values of points: what a tile's head gave, as files between tiles and outputs, and as a file's points take them."""

from __future__ import annotations

import atexit
import contextlib
import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import StageError
from .cut import Piece
from .kept import members, save_arrays
from .sources import InputSource


@dataclass
class PieceResults:
    """Results of a tile's own points of one piece."""

    piece: Piece
    rows: NDArray[np.int64]  #: (n,) rows of the piece that came out, ascending
    values: dict[str, NDArray]  #: (n,) new values of dimensions
    holds_flags: bool = False  #: whether class codes hold the flag bits of LAS 1.0-1.3


@dataclass(frozen=True)
class NewValues:
    """What points get that are read again, in the order they are read in."""

    kept: NDArray[np.bool_]  #: (n,) which of the points stay
    #: New values of dimensions and the rows they belong to; None for all.
    values: Mapping[str, tuple[NDArray[np.int64] | None, NDArray]]


def of_own_points(result: PieceResults) -> NewValues:
    """The results for a file of the tile's own points alone."""
    own = result.piece.own
    rows = np.searchsorted(own, result.rows)
    kept = np.zeros(len(own), bool)
    kept[rows] = True
    at = None if kept.all() else rows
    return NewValues(kept, {name: (at, values) for name, values in result.values.items()})


def class_counts(results: Iterable[PieceResults]) -> dict[str, int]:
    """Number of points of each class; without the flag bits of LAS 1.0-1.3 where these are inside."""
    counts = np.zeros(256, np.int64)
    for result in results:
        codes = np.asarray(result.values.get("Classification", ()), np.uint8)
        counts += np.bincount(codes & LEGACY_LIMIT if result.holds_flags else codes, minlength=256)
    return {str(code): int(counts[code]) for code in np.flatnonzero(counts)}


def save(path: str | Path, results: Iterable[PieceResults], scratch: str) -> None:
    """Write a tile's results, for the files that outputs are put together from; `scratch`: see :func:`.store.check_run`."""
    content: dict[str, NDArray] = {}
    for result in results:
        piece = result.piece
        if not len(piece.own):
            continue
        key = piece.source.key
        content[f"{key}/index"] = piece.index[result.rows]
        content[f"{key}/core"] = np.array(len(piece.own))
        content |= {f"{key}/dim/{name}": values for name, values in result.values.items()}
    save_arrays(path, content, scratch)


class _Results:
    """The file of a tile's results, opened."""

    def __init__(self, name: str) -> None:
        with contextlib.ExitStack() as stack:
            self._arrays = stack.enter_context(
                np.load(stack.enter_context(open(name, "rb")), allow_pickle=False)
            )
            self._dimensions: dict[str, list[str]] = {}
            for member in members(self._arrays):
                source, _, rest = member.partition("/")
                if rest:
                    self._dimensions.setdefault(source, [])
                if rest.startswith("dim/"):
                    self._dimensions[source].append(rest.removeprefix("dim/"))
            self.close = stack.pop_all().close

    def __contains__(self, source: str) -> bool:
        """Whether it holds points of an input."""
        return source in self._dimensions

    def points(self, source: str) -> tuple[NDArray[np.int64], int]:
        """Numbers of an input's points that came out, ascending, and how many are the tile's own."""
        return self._arrays[f"{source}/index"], int(self._arrays[f"{source}/core"])

    def values(self, source: str) -> Iterator[tuple[str, NDArray]]:
        """Dimensions of an input's points."""
        for name in self._dimensions[source]:
            yield name, self._arrays[f"{source}/dim/{name}"]


#: Files that were opened last, by name and what tells whether they are still the same: the outputs of hundreds of small
#: inputs are read from one after the other.
_open: OrderedDict[tuple[str, int, int], _Results] = OrderedDict()
_MOST_OPEN = 8


@atexit.register
def _close(but: int = 0) -> None:
    while len(_open) > but:
        _open.popitem(last=False)[1].close()


@contextlib.contextmanager
def _opened(name: str) -> Iterator[_Results]:
    """The results in a file; one that cannot be read is removed, so that a later run makes it anew."""
    try:
        status = os.stat(name)
        key = (name, status.st_mtime_ns, status.st_ino)
        if key not in _open:
            _open[key] = _Results(name)
        _open.move_to_end(key)
        _close(_MOST_OPEN)
        yield _open[key]
    except StageError:
        raise
    except Exception as error:  # zipfile and numpy raise many types
        _close()
        Path(name).unlink(missing_ok=True)
        raise StageError(
            "the results of a tile cannot be read back, and were removed",
            found=f"{Path(name).name}: {error}",
            cure="Run it again with --resume",
        ) from error


def read_range(tiles: Iterable[str], source: InputSource, count: int, start: int, end: int) -> NewValues:
    """Results of points `start` to `end` of a file with `count` points, out of the files of its tiles.

    Raises
    ------
    StageError
        If the tiles do not hold each of the file's points once.
    """
    kept = np.zeros(end - start, bool)
    seen = 0
    columns: dict[str, list[tuple[NDArray, NDArray]]] = {}
    for name in tiles:
        with _opened(name) as tile:
            if source.key not in tile:
                continue
            index, own = tile.points(source.key)
            seen += own
            first, last = np.searchsorted(index, (start, end))
            mine = index[first:last] - start
            if (index.size and index[-1] >= count) or kept[mine].any():
                raise StageError("internal: two tiles hold the same point", where=source.path, found=name)
            kept[mine] = True
            for dimension, column in tile.values(source.key):
                part = column[first:last].copy() if last - first < index.size else column
                columns.setdefault(dimension, []).append((mine, part))
    if seen != count:
        raise StageError(
            "the tiles do not hold all points of the file: it changed while it was worked on",
            where=source.path,
            found=f"{seen:,} of {count:,} points",
            cure="Start the run again with --resume",
        )
    values: dict[str, tuple[NDArray[np.int64] | None, NDArray]] = {}
    for name, parts in columns.items():
        if sum(len(rows) for rows, _ in parts) == end - start:
            full = np.empty(end - start, parts[0][1].dtype)
            for rows, part in parts:
                full[rows] = part
            values[name] = (None, full)
        else:
            values[name] = (np.concatenate([r for r, _ in parts]), np.concatenate([v for _, v in parts]))
        parts.clear()
    return NewValues(kept, values)
