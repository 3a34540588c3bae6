"""Passes over one cloud: each reads, beside its features, what the one before said around a point.

The cloud is worked on in bands from south to north. A pass works on a band as soon as the pass before has done that band
and the next one, so the features of a few bands are held, and those of a band serve all passes that read the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.grid import begins_run, cell_numbers
from ..base.threads import map_blocks
from ..features import FeaturePlan
from .context_features import Context, around, count_shares
from .feature_forest import CloudFeatures, FeatureForest, weighed
from .interface import InputPlan, PredictRequest

#: Points of a band at most, but for a band of one strip.
BAND = 75_000


def plan_of(passes: Sequence[Any]) -> FeaturePlan | InputPlan:
    """What all passes look at; the halo is the passes' own, one after the other."""
    plans = [one.plan for one in passes]
    if len(plans) == 1:
        return plans[0]
    halo_m = plans[0].halo_m
    for one in passes[1:]:
        halo_m = max(one.plan.halo_m, halo_m + one.context.reach)
    return InputPlan(
        tuple(dict.fromkeys(name for plan in plans for name in plan.names)),
        tuple(dict.fromkeys(name for plan in plans for name in plan.dimensions)),
        halo_m,
    )


@dataclass(frozen=True, eq=False)
class FoldForests:
    """Forests that read the same, each grown without one fold, as one pass over one cloud."""

    forests: Sequence[FeatureForest]
    fold: npt.NDArray[np.int16]  #: (n,) of every point of the cloud: the forest that judges it

    @property
    def features(self) -> Any:
        return self.forests[0].features

    @property
    def context(self) -> Context | None:
        return self.forests[0].context

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Of each point from the forest that has not seen its fold."""
        each, fold = {}, self.fold[rows]
        for number in np.unique(fold).tolist():
            each[number] = self.forests[number].probabilities(values[fold == number])
        out = np.empty((len(values), next(iter(each.values())).shape[1]))
        for number, p in each.items():
            out[fold == number] = p
        return out


class WeightedPass(NamedTuple):
    """A pass, and what its probabilities are weighted by."""

    #: It has `features` (None where it reads context alone), `context` (None for the first), and
    #: ``probabilities(read, rows)``, (b, classes) of points by their features and then their context, side by side.
    #: A first one without features is applied by its own ``predict``.
    classifier: Any
    classes: int
    #: (classes,) what these probabilities are multiplied by before they are handed on
    factors: npt.NDArray[np.float64] | None = None


def predict(
    passes: Sequence[WeightedPass],
    request: PredictRequest,
    finish: Callable[[npt.NDArray[np.float64]], Any],
) -> Iterator[tuple[Any, Any]]:
    """Classify by some passes: (rows, what `finish` made of them) block by block.

    `finish` makes the results of the (b, classes) float64 probabilities of a block, which it may change, in a worker's
    thread where there are any.
    """
    last = passes[-1].classifier
    if len(passes) == 1 and last.features is None:
        yield from last.predict(request, finish)
        return
    yield from PassRun(passes, request).blocks(
        lambda read, rows: finish(last.probabilities(read, rows))
    )


def sample_context(
    passes: Sequence[WeightedPass], request: PredictRequest, context: Context
) -> npt.NDArray[np.float32]:
    """(m, columns): the context that some passes give the m points asked for, ascending."""
    asked: Any = request.rows
    out = np.empty((len(asked), len(context.tokens) * passes[-1].classes), np.float32)
    last = WeightedPass(SimpleNamespace(context=context, features=None), 0)
    for rows, columns in PassRun([*passes, last], request).blocks(lambda columns, rows: columns):
        out[np.searchsorted(asked, rows)] = columns
    return out


class PassRun:
    """Passes at work on one cloud; of the last only its features and context are looked at."""

    def __init__(self, passes: Sequence[WeightedPass], request: PredictRequest) -> None:
        members = [each.classifier for each in passes]
        self._members, self._request, self._factors = (
            members,
            request,
            [each.factors for each in passes],
        )
        wanted = [request.rows]  # of each pass
        for one in members[:0:-1]:
            wanted.insert(0, around(request.xyz, wanted[0], one.context))
        self._wanted = [_mask(rows, len(request.xyz)) for rows in wanted]
        width = max((one.context.strip for one in members[1:]), default=0.0) or 8.0
        self._strips = Strips(request.xyz, wanted[0], width)
        self._shares = [np.zeros((len(self._strips), n), np.uint16) for _, n, _ in passes[:-1]]
        self._features: list[CloudFeatures | None] = []
        for one in members:
            # One for passes that read the same features, so that these are computed once.
            same = (
                f
                for f in self._features
                if f is not None and f.features.to_dict() == one.features.to_dict()
            )
            found = None if one.features is None else next(same, None)
            if found is None and one.features is not None:
                found = CloudFeatures(one.features, request)
            self._features.append(found)

    def blocks(
        self, last: Callable[[npt.NDArray[np.float32], npt.NDArray[np.int64]], Any]
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``last(read, rows)``) for all points asked for; called in workers' threads."""
        if not self._request.count:
            return
        strips, number, progress = self._strips, len(self._members), self._request.progress
        bands = strips.bands()
        first = 0
        if self._features[0] is None:
            self._ask_algorithm()
            first = 1
        held: dict[
            int, dict[Any, list[Any]]
        ] = {}  # band -> features -> (rows, values) of its blocks
        for step in range(len(bands) + number):
            for place in range(first, number):
                if not 0 <= step - place < len(bands):
                    continue
                there = held.setdefault(step - place, {})
                finish = last if place == number - 1 else self._handing_on(place)
                for rows, result in self._work(place, bands[step - place], there, finish):
                    if place < number - 1:
                        self._shares[place][strips.places(rows)] = result
                        continue
                    if progress is not None:
                        progress.update(len(rows))
                    yield rows, result
            held.pop(step - number + 1, None)

    def _ask_algorithm(self) -> None:
        """Let a first pass of another kind, which has its own way through a cloud, say its probabilities."""
        factors = self._factors[0]
        rows = None if self._wanted[0] is None else np.flatnonzero(self._wanted[0])
        inner = replace(self._request, rows=rows, progress=None, grid=None)
        every = np.arange(len(inner.xyz))
        for rows, result in self._members[0].predict(
            inner, lambda p: count_shares(weighed(p, factors))
        ):
            self._shares[0][self._strips.places(every[rows])] = result

    def _handing_on(self, place: int) -> Callable[..., npt.NDArray[np.uint16]]:
        """What a pass makes of a block for the next one."""
        one, factors = self._members[place], self._factors[place]
        return lambda read, rows: count_shares(weighed(one.probabilities(read, rows), factors))

    def _work(
        self, place: int, band: Band, held: dict[Any, list[Any]], finish: Callable[..., Any]
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, what `finish` makes of them) of a band's points that the pass `place` is to look at."""
        features, mask = self._features[place], self._wanted[place]
        later = features in self._features[place + 1 :]
        context = self._context_at(place, band) if place else None
        rows = self._strips.rows(band[0])
        rows = rows if mask is None else rows[mask[rows]]

        def result(values: Any, rows: npt.NDArray[np.int64]) -> Any:
            parts = [values, None if context is None else context(rows)]
            there = [part for part in parts if part is not None]
            return finish(there[0] if len(there) == 1 else np.concatenate(there, axis=1), rows)

        def again(block: Any) -> tuple[npt.NDArray[np.int64], Any]:
            mine = slice(None) if mask is None else mask[block[0]]
            rows, values = (part[mine] for part in block)
            return rows, result(values, rows) if len(rows) else None

        if features in held:
            for some, made in map_blocks(again, held[features], self._request.threads):
                if len(some):
                    yield some, made
        elif features is not None:
            held[features] = []
            both = features.blocks(rows, lambda values, some: (values, result(values, some)), 0.5)
            for some, (values, made) in both:
                if later:
                    held[features].append((some, values))
                yield some, made
        elif len(rows):
            yield rows, result(None, rows)

    def _context_at(self, place: int, band: Band) -> Callable[..., npt.NDArray[np.float32]]:
        """What gives the context of rows of a band, by what the pass before said of it and the strips beside it."""
        context, shares = self._members[place].context, self._shares[place - 1]
        xyz = self._request.xyz[self._strips.rows(band[1])]
        columns = context.columns_of(xyz, shares[band[1]], self._request.threads)
        return lambda rows: columns(self._strips.places(rows) - band[1].start)


#: Places of the points of a band, and of these and the strips beside it.
Band = tuple[slice, slice]


class Strips:
    """Points in the order of strips of ground, each `width` meters from south to north; `rows` are looked at, None for all.

    Strips begin at multiples of the width.
    """

    def __init__(
        self, xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, width: float
    ) -> None:
        number = cell_numbers(xyz[:, 1] if rows is None else xyz[rows, 1], width)
        self._order: npt.NDArray[np.int64] | None = None
        if (
            rows is not None or (number[1:] < number[:-1]).any()
        ):  # else they follow each other already
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
        start, last, out, first = self._start, len(self._start) - 1, [], 0
        while first < last:
            end = max(first + 1, int(np.searchsorted(start, start[first] + BAND, side="right")) - 1)
            beside = slice(start[max(first - 1, 0)], start[min(end + 1, last)])
            out.append((slice(start[first], start[end]), beside))
            first = end
        return out

    def rows(self, part: slice) -> npt.NDArray[np.int64]:
        """The points at some places."""
        return np.arange(part.start, part.stop) if self._order is None else self._order[part]

    def places(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Where points lie in this order."""
        return rows if self._order is None else self._place[rows].astype(np.int64)


def _mask(rows: npt.NDArray[np.int64] | None, n: int) -> npt.NDArray[np.bool_] | None:
    if rows is None:
        return None
    mask = np.zeros(n, np.bool_)
    mask[rows] = True
    return mask
