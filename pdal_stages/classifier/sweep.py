"""From one pass to the next without holding a cloud's features: strip by strip, as soon as the strips beside are done.

A pass hands over blocks of points in any order, best along y. What the next pass needs of a point's surroundings lies
in the point's own strip and the two beside it. So a strip is worked on when these three are complete, with the
features that were computed for it in the pass before, as far as memory held them; the others are computed again. That
changes nothing but the time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.runs import begins_run
from ..base.threads import map_blocks
from ..features.index import cell_numbers
from .context import Context, Tables

#: Points of strips that are worked on together, where there are so many.
TOGETHER = 150_000

#: Features of rows of the cloud, these rows, and the table of their context's columns -> whatever is wanted.
Apply = Callable[[Any, npt.NDArray[np.int64], npt.NDArray[np.float32]], Any]


class Passed(NamedTuple):
    """A block of points a pass has done: rows of the cloud, their shares, and their features if they are at hand."""

    rows: npt.NDArray[np.int64]
    shares: npt.NDArray[np.uint16]
    values: npt.NDArray[np.float32] | None


class Sweep:
    """The way from one pass to the next over one cloud.

    Parameters
    ----------
    xyz : (n, 3) float64
        Meters.
    coming : (k,) int64 or None
        Points the pass before hands over, each once; None for all. Those that :func:`context.around` names.
    wanted : (m,) int64 or None
        Points the next pass is to look at; None for all.
    context : Context
        What it reads of their surroundings.
    classes : int
    threads : int, optional
    keep_bytes : float
        Features held while their strips wait.
    again : function, optional
        ``again(rows, apply)`` computes the features of rows that were not kept and yields (rows, ``apply(values,
        rows)``) block by block. None where the next pass reads no features.
    """

    def __init__(
        self,
        xyz: npt.NDArray[np.float64],
        coming: npt.NDArray[np.int64] | None,
        wanted: npt.NDArray[np.int64] | None,
        context: Context,
        classes: int,
        *,
        threads: int | None = None,
        keep_bytes: float = 0.0,
        again: Callable[..., Iterable[tuple[npt.NDArray[np.int64], Any]]] | None = None,
    ) -> None:
        self._xyz, self._context, self._threads, self._again = xyz, context, threads, again
        self._room = keep_bytes
        y = xyz[:, 1] if coming is None else xyz[coming, 1]
        number = cell_numbers(y, context.strip)
        least = int(number.min(initial=0))
        number -= least
        if number.max(initial=0) < 2**16:
            number = number.astype(np.uint16)  # sorted digit by digit
        small = np.int32 if len(xyz) < 2**31 else np.int64
        # In an index's order the strips follow each other already, and nothing has to say where a point is.
        self._order: npt.NDArray[Any] | None = None
        self._place: npt.NDArray[Any] | None = None
        if coming is not None or (number[1:] < number[:-1]).any():
            order = np.argsort(number, kind="stable").astype(small)
            number = number[order]
            self._order = order if coming is None else coming[order].astype(small)
            self._place = np.zeros(len(xyz), small)  # of each row in the order of strips
            self._place[self._order] = np.arange(len(self._order), dtype=small)
            del order
        first = np.flatnonzero(begins_run(number))
        self._numbers = number[first].astype(np.int64) + least
        self._start = np.append(first, len(number))
        self._shares = np.zeros((len(number), classes), np.uint16)
        del number
        self._wanted = None
        if wanted is not None:
            self._wanted = np.zeros(len(xyz), np.bool_)
            self._wanted[wanted] = True
        self._left = np.diff(self._start)  # points a strip still waits for
        self._waiting: list[list[tuple[npt.NDArray[np.int64], Any]]] = [[] for _ in self._numbers]
        self._done = np.zeros(len(self._numbers), np.bool_)

    def run(self, blocks: Iterable[Passed], apply: Apply) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``apply(values, rows, context)``) for every wanted point once.

        `apply` is called in workers' threads.
        """
        for block in blocks:
            self._take(block)
            ready = self._ready()
            if len(ready) and (self._room <= 0.0 or np.diff(self._start)[ready].sum() >= TOGETHER):
                yield from self._work(ready, apply)
        while len(ready := self._ready()):
            most = np.searchsorted(np.cumsum(np.diff(self._start)[ready]), TOGETHER) + 1
            yield from self._work(ready[:most], apply)

    def _take(self, block: Passed) -> None:
        """Store a block's shares, and what is wanted of it with the strips it lies in."""
        at = block.rows if self._place is None else self._place[block.rows]
        self._shares[at] = block.shares
        strip = np.searchsorted(self._start, at, side="right") - 1
        self._left -= np.bincount(strip, minlength=len(self._left))
        keep = np.arange(len(strip)) if self._wanted is None else np.flatnonzero(self._wanted[block.rows])
        keep = keep[np.argsort(strip[keep], kind="stable")]  # in order already where a block runs along y
        numbers, first = np.unique(strip[keep], return_index=True)
        for number, mine in zip(numbers, np.split(keep, first)[1:], strict=True):
            part = None
            if block.values is not None and self._room > 0.0:
                follow = mine[-1] - mine[0] + 1 == len(mine)  # then no copy is needed
                part = block.values[mine[0] : mine[-1] + 1] if follow else block.values[mine]
                self._room -= part.nbytes
            self._waiting[number].append((block.rows[mine], part))

    def _ready(self) -> npt.NDArray[np.int64]:
        """Strips that are complete, and so are those beside them, and that are not worked on yet."""
        whole = self._left == 0
        beside = np.diff(self._numbers) == 1
        good = whole & ~self._done
        good[1:] &= whole[:-1] | ~beside
        good[:-1] &= whole[1:] | ~beside
        return np.flatnonzero(good)

    def _work(
        self, strips: npt.NDArray[np.int64], apply: Apply
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        self._done[strips] = True
        parts = [part for strip in strips for part in self._waiting[strip]]
        for strip in strips:
            self._waiting[strip] = []
        if not parts:
            return
        first = self._start[max(strips[0] - 1, 0)]
        last = self._start[min(strips[-1] + 2, len(self._numbers))]
        window = slice(first, last)
        xyz = self._xyz[window if self._order is None else self._order[window]]
        tables = self._context.tables(xyz, self._shares[window], self._threads)
        kept = [part for part in parts if part[1] is not None or self._again is None]
        missing = [part[0] for part in parts if part[1] is None and self._again is not None]

        def one(part):
            rows, values = part
            return rows, apply(values, rows, self._columns(tables, rows, first))

        yield from map_blocks(one, kept, self._threads)
        self._room += sum(values.nbytes for _, values in kept if values is not None)
        if missing and self._again is not None:
            yield from self._again(
                np.sort(np.concatenate(missing)),
                lambda values, rows: apply(values, rows, self._columns(tables, rows, first)),
            )

    def _columns(self, tables: Tables, rows: npt.NDArray[np.int64], first: int) -> npt.NDArray[np.float32]:
        out = np.empty((len(rows), len(self._context.tokens) * self._shares.shape[1]), np.float32)
        place = rows if self._place is None else self._place[rows].astype(np.int64)
        tables.fill(place - first, out)
        return out
