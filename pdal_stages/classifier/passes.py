"""Several passes as one classifier: each reads, beside its features, what the one before said all around."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from ..base.report import Report
from .algorithms import Algorithm, Block, InputPlan, PredictRequest, PredictResult
from .context import Context, around
from .featureforest import CloudFeatures, Features
from .smoothing import count_shares
from .sweep import Passed, Sweep

#: Of the memory for work under way, what features that wait for the next pass may take.
_KEPT = 0.5


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
        rows = [request.rows]  # wanted of each pass
        for one in members[:0:-1]:
            rows.insert(0, around(request.xyz, rows[0], _context_of(one)))
        self._rows = rows
        self._of_clouds: list[CloudFeatures] = []
        for one in members:
            if one.features is not None:
                self._features_of(one.features)

    def _features_of(self, features: Features) -> CloudFeatures:
        """One for passes that read the same features, so that these are computed once."""
        for one in self._of_clouds:
            if one.features is features or one.features.to_dict() == features.to_dict():
                return one
        self._of_clouds.append(CloudFeatures(features, self._request))
        self.report.merge(self._of_clouds[-1].report)
        return self._of_clouds[-1]

    def blocks(
        self, last: Callable[[Any, npt.NDArray[np.int64], npt.NDArray[np.float32]], Any]
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``last(values, rows, context)``) for all points asked for; called in workers' threads."""
        if not self._request.count:
            return
        stream = self._first()
        for number in range(1, len(self._members) - 1):
            stream = _passed(self._swept(number, stream, self._handing_on(number)))
        progress = self._request.progress
        for rows, result in self._swept(len(self._members) - 1, stream, last):
            if progress is not None:
                progress.update(len(rows))
            yield rows, result
        for one in reversed(self._of_clouds):  # the last pass looks at what is asked for, others farther
            self.report.merge(one.report)

    def _first(self) -> Iterator[Passed]:
        first = self._members[0]
        if first.features is None:
            asked = self._request
            inner = PredictRequest(asked.xyz, asked.dimensions, self._rows[0], asked.threads, asked.memory_mb)
            factors = self._factors[0]
            predicted = cast(Algorithm, first).predict(inner, lambda p: count_shares(weighed(p, factors)))
            every = np.arange(len(asked.xyz))
            for block in predicted.blocks:
                yield Passed(every[block.rows], block.result, None)
            self.report.merge(predicted.report)
            return
        blocks = self._features_of(first.features).blocks(
            self._rows[0], self._handing_on(0), 1.0 - _KEPT, shown=False
        )
        yield from _passed(blocks)

    def _handing_on(self, number: int) -> Callable[..., tuple[npt.NDArray[np.uint16], Any]]:
        """What a pass makes of a block: its shares, and the features where the next pass reads the same ones."""
        one, after = self._members[number : number + 2]
        same = (
            one.features is not None
            and after.features is not None
            and self._features_of(one.features) is self._features_of(after.features)
        )

        def apply(values, rows, context=None):
            read = values if context is None else joined(values, context)
            p = weighed(one.probabilities(read, rows), self._factors[number])
            return count_shares(p), values if same else None

        return apply

    def _swept(self, number: int, stream: Iterator[Passed], apply) -> Iterator[tuple[Any, Any]]:
        one, asked = self._members[number], self._request
        again = None
        if one.features is not None:
            features_here = self._features_of(one.features)

            def again(rows, apply_again):
                return features_here.blocks(rows, apply_again, 1.0 - _KEPT, counted=False)

        sweep = Sweep(
            asked.xyz,
            self._rows[number - 1],
            self._rows[number],
            _context_of(one),
            self._classes[number - 1],
            threads=asked.threads,
            keep_bytes=asked.memory_mb * 2**20 * _KEPT / (len(self._members) - 1),
            again=again,
        )
        return sweep.run(stream, apply)


def _passed(blocks: Iterable[tuple[npt.NDArray[np.int64], Any]]) -> Iterator[Passed]:
    return (Passed(rows, shares, values) for rows, (shares, values) in blocks)


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
