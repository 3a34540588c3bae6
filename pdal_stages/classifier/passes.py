"""Several passes as one classifier: each reads, beside its features, what the one before said around a point.

The cloud is worked on in bands from south to north. A pass works on a band as soon as the pass before has done that band
and the next one, so the features of a few bands are held, and those of a band serve all passes that read the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..base.report import Report
from ..base.runs import begins_run
from ..base.threads import map_blocks
from ..features.index import cell_numbers
from .algorithms import Block, InputPlan, PredictRequest, PredictResult
from .context import Context, around, count_shares
from .featureforest import CloudFeatures, Features

#: Points of a band at most, but for a band of one strip.
BAND = 150_000
#: Features of a band are held for the next pass where they take no more than this share of the memory; else they are
#: computed once more.
_HELD = 0.5

#: Rows of the cloud and their features; None for a pass that reads none.
Values = tuple[npt.NDArray[np.int64], Any]


class Pass(Protocol):
    """One of several passes, as it reads the points of a block."""

    @property
    def features(self) -> Features | None:
        """What it computes of the points; None where it reads context alone, or is a whole algorithm that comes first."""

    @property
    def context(self) -> Context | None:
        """What it reads of the pass before; None for the first."""

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """(b, classes) of the points `rows`, by their features and then their context, side by side."""


@dataclass(frozen=True, eq=False)
class Passes:
    """Two or more passes."""

    #: of a model file: the first any :class:`Algorithm`, then forests
    members: tuple[Any, ...]
    classes: tuple[int, ...]  #: of each pass
    #: of each pass: what its classes' probabilities are multiplied by before they are handed on; None for nothing
    factors: tuple[npt.NDArray[np.float64] | None, ...] = ()

    gives_variance = False

    @property
    def name(self) -> str:
        """Of the last pass."""
        return self.members[-1].name

    @cached_property
    def plan(self) -> InputPlan:
        """What all passes look at; the halo is the passes' own, one after the other."""
        plans = [one.plan for one in self.members]
        halo_m = plans[0].halo_m
        for one in self.members[1:]:
            halo_m = max(one.plan.halo_m, halo_m + one.context.reach)
        return InputPlan(
            tuple(dict.fromkeys(name for plan in plans for name in plan.names)),
            tuple(dict.fromkeys(name for plan in plans for name in plan.dimensions)),
            halo_m,
            max(plan.most_neighbors for plan in plans),
            max(plan.second_neighbors for plan in plans),
        )

    def predict(
        self, request: PredictRequest, finish: Callable[[npt.NDArray[np.float64]], Any]
    ) -> PredictResult:
        """Classify; see ``Algorithm.predict``."""
        run = PassRun(self.members, self.classes, request, self.factors)

        def last(values, rows, context):
            return finish(self.members[-1].probabilities(joined(values, context), rows))

        return PredictResult((Block(rows, result) for rows, result in run.blocks(last)), run.report)


class PassRun:
    """Passes at work on one cloud. Of the last only `features` and `context` are looked at here; a first one without
    features is asked for its probabilities as the algorithm it is.

    `report` has what was counted, complete when all blocks are read.
    """

    def __init__(
        self,
        members: Sequence[Pass],
        classes: Sequence[int],
        request: PredictRequest,
        factors: Sequence[npt.NDArray[np.float64] | None] = (),
    ) -> None:
        self._members, self._classes, self._request = members, classes, request
        self._factors = tuple(factors) or (None,) * len(members)
        self.report = Report()
        wanted = [request.rows]  # of each pass
        for one in members[:0:-1]:
            wanted.insert(0, around(request.xyz, wanted[0], _context_of(one)))
        self._wanted = [_mask(rows, len(request.xyz)) for rows in wanted]
        width = max(_context_of(one).strip for one in members[1:])
        self._strips = Strips(request.xyz, wanted[0], width)
        self._features: list[CloudFeatures | None] = []
        for one in members:
            self._features.append(None if one.features is None else self._features_of(one.features))

    def _features_of(self, features: Features) -> CloudFeatures:
        """One for passes that read the same features, so that these are computed once."""
        for one in self._features:
            if one is not None and one.features.to_dict() == features.to_dict():
                return one
        made = CloudFeatures(features, self._request)
        self.report.merge(made.report)
        return made

    def blocks(
        self, last: Callable[[Any, npt.NDArray[np.int64], npt.NDArray[np.float32]], Any]
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``last(values, rows, context)``) for all points asked for; called in workers' threads."""
        if not self._request.count:
            return
        strips, number = self._strips, len(self._members)
        self._shares = [np.zeros((len(strips), n), np.uint16) for n in self._classes[:-1]]
        bands = strips.bands()
        longest = max(map(strips.count, bands))
        width = sum(len(one.features.plan.names) for one in set(self._features) if one is not None)
        limit = _HELD * self._request.memory_mb * 2**20
        self._hold = 4.0 * width * longest * min(number, len(bands)) <= limit
        first = 0
        if self._features[0] is None:
            self._ask_algorithm()
            first = 1
        held: dict[int, dict[int, list[Values]]] = {}  # band -> pass that computed features first -> these
        progress = self._request.progress
        for step in range(len(bands) + number):
            for place in range(first, number):
                if not 0 <= step - place < len(bands):
                    continue
                band = bands[step - place]
                there = held.setdefault(step - place, {})
                if place < number - 1:
                    for rows, shares in self._work(place, band, there, self._handing_on(place)):
                        self._shares[place][strips.places(rows)] = shares
                    continue
                for rows, result in self._work(place, band, there, last):
                    if progress is not None:
                        progress.update(len(rows))
                    yield rows, result
                del held[step - place]
        for features in dict.fromkeys(reversed(self._features)):
            if features is not None:
                self.report.merge(features.report)

    def _ask_algorithm(self) -> None:
        """Let a first pass of another kind, which has its own way through a cloud, say its probabilities."""
        asked, factors = self._request, self._factors[0]
        rows = None if self._wanted[0] is None else np.flatnonzero(self._wanted[0])
        inner = PredictRequest(asked.xyz, asked.dimensions, rows, asked.threads, asked.memory_mb)
        algorithm: Any = self._members[0]
        predicted = algorithm.predict(inner, lambda p: count_shares(weighed(p, factors)))
        every = np.arange(len(asked.xyz))
        for block in predicted.blocks:
            self._shares[0][self._strips.places(every[block.rows])] = block.result
        self.report.merge(predicted.report)

    def _handing_on(self, place: int) -> Callable[..., npt.NDArray[np.uint16]]:
        """What a pass makes of a block for the next one."""
        one, factors = self._members[place], self._factors[place]

        def shares(values, rows, context=None):
            read = values if context is None else joined(values, context)
            return count_shares(weighed(one.probabilities(read, rows), factors))

        return shares

    def _work(
        self, place: int, band: Band, held: dict[int, list[Values]], finish: Callable[..., Any]
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, what `finish` makes of them) of a band's points that the pass `place` is to look at."""
        asked, features = self._request, self._features[place]
        context = self._context_at(place, band) if place else None

        def apply(values, rows):
            return values, finish(values, rows, *(() if context is None else (context(rows),)))

        if features is None:
            rows = self._chosen(place, self._strips.rows(band))
            if len(rows):
                yield rows, apply(None, rows)[1]
            return
        first = self._features.index(features)
        before = held.get(first)
        if before is None:
            rows = self._chosen(place, self._strips.rows(band))
            kept: list[Values] = []
            counted = self._hold or place == first
            for some, (values, result) in features.blocks(rows, apply, 1.0 - _HELD, counted):
                if self._hold and features in self._features[place + 1 :]:
                    kept.append((some, values))
                yield some, result
            if kept:
                held[first] = kept
            return

        def again(block: Values):
            rows, values = block
            mask = self._wanted[place]
            if mask is not None and not (mine := mask[rows]).all():
                rows, values = rows[mine], values[mine]
            return rows, apply(values, rows)[1] if len(rows) else None

        for some, result in map_blocks(again, before, asked.threads):
            if len(some):
                yield some, result

    def _chosen(self, place: int, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        mask = self._wanted[place]
        return rows if mask is None else rows[mask[rows]]

    def _context_at(self, place: int, band: Band) -> Callable[..., npt.NDArray[np.float32]]:
        """What gives the context of rows of a band, by what the pass before said of it and the strips beside it."""
        context, shares = _context_of(self._members[place]), self._shares[place - 1]
        window = self._strips.window(band)
        xyz = self._request.xyz[self._strips.rows_at(window)]
        tables = context.tables(xyz, shares[window], self._request.threads)

        def columns(rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
            out = np.empty((len(rows), len(context.tokens) * shares.shape[1]), np.float32)
            tables.fill(self._strips.places(rows) - window.start, out)
            return out

        return columns


#: The first strip of a band, and the one after its last.
Band = tuple[int, int]


class Strips:
    """Points in the order of strips of ground, each so many meters from south to north.

    Parameters
    ----------
    xyz : (n, 3) float64
    rows : (m,) int64 or None
        Points that are looked at; None for all.
    width : float
        Meters. Strips begin at multiples of it.
    """

    def __init__(
        self, xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, width: float
    ) -> None:
        number = cell_numbers(xyz[:, 1] if rows is None else xyz[rows, 1], width)
        self._order: npt.NDArray[np.int64] | None = None
        if rows is not None or (number[1:] < number[:-1]).any():  # else they follow each other already
            order = np.argsort(number, kind="stable")
            number = number[order]
            self._order = order if rows is None else rows[order]
            self._place = np.zeros(len(xyz), np.int32 if len(xyz) < 2**31 else np.int64)
            self._place[self._order] = np.arange(len(order))
        self._start = np.append(np.flatnonzero(begins_run(number)), len(number))

    def __len__(self) -> int:
        return int(self._start[-1])

    def bands(self) -> list[Band]:
        """Strips that are worked on together."""
        points = self._start[1:]
        out, first = [], 0
        while first < len(points):
            end = int(np.searchsorted(points, self._start[first] + BAND, side="right"))
            out.append((first, max(end, first + 1)))
            first = out[-1][1]
        return out

    def count(self, band: Band) -> int:
        """How many points a band has."""
        return int(self._start[band[1]] - self._start[band[0]])

    def rows(self, band: Band) -> npt.NDArray[np.int64]:
        """The points of a band."""
        return self.rows_at(slice(self._start[band[0]], self._start[band[1]]))

    def rows_at(self, part: slice) -> npt.NDArray[np.int64]:
        """The points at some places."""
        return np.arange(part.start, part.stop) if self._order is None else self._order[part]

    def window(self, band: Band) -> slice:
        """Places of the points of a band and of the strips beside it."""
        return slice(self._start[max(band[0] - 1, 0)], self._start[min(band[1] + 1, len(self._start) - 1)])

    def places(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Where points lie in this order."""
        return rows if self._order is None else self._place[rows].astype(np.int64)


def _mask(rows: npt.NDArray[np.int64] | None, n: int) -> npt.NDArray[np.bool_] | None:
    if rows is None:
        return None
    mask = np.zeros(n, np.bool_)
    mask[rows] = True
    return mask


def _context_of(one: Pass) -> Context:
    """Of a pass after the first, which has one."""
    assert one.context is not None
    return one.context


def weighed(p: npt.NDArray[np.float64], factors: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64]:
    """Probabilities (b, classes), each class's multiplied by its factor; None leaves them as they are."""
    if factors is None:
        return p
    p = p * factors
    p /= p.sum(axis=1, keepdims=True)
    return p


def joined(values: npt.NDArray[np.float32], context: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Features and context side by side."""
    return np.concatenate([values, context], axis=1)
