"""Auto-context [TB10]: each pass reads the probabilities of the pass before around a point.

The cloud is worked on in bands from south to north. A pass works on a band as soon as the pass
before has done that band and the next one, so the features of a few bands are held, and those of a
band serve all passes that read the same ones.

[TB10] Tu and Bai 2010, Auto-context and its application to high-level vision tasks and 3D brain
image segmentation.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.grid import begins_run, cell_numbers
from ..base.threads import map_blocks
from ..features import FeaturePlan
from ..features.engine import FeatureBlock, Run
from .context_features import HEIGHT, CellContext, Context, count_shares, rows_needed
from .feature_forest import CloudFeatures, FeatureForest, FeatureReader, Features
from .interface import (
    Block,
    Estimator,
    InputPlan,
    PassInputs,
    PointEstimator,
    PredictRequest,
    weigh,
)

#: Points of a band at most, but for a band of one strip: the features of a few bands are held (not
#: tuned; results do not depend on it).
BAND = 150_000

#: Width of strips where there is no context, meters.
_ANY_WIDTH_M = 8.0
#: Share of the memory for blocks under way: features that are held for later passes need some, too
#: (not tuned).
_SHARE_OF_BLOCKS = 0.5


def plan_of(passes: Sequence[Estimator]) -> FeaturePlan | InputPlan:
    """Return the inputs of all passes; each later pass adds its reach to the halo."""
    plans = [each.plan for each in passes]
    if len(plans) == 1:
        return plans[0]
    halo_m = plans[0].halo_m
    for later in passes[1:]:
        assert later.context is not None
        halo_m = max(later.plan.halo_m, halo_m + later.context.reach)
    return InputPlan(
        tuple(dict.fromkeys(name for plan in plans for name in plan.names)),
        tuple(dict.fromkeys(name for plan in plans for name in plan.dimensions)),
        halo_m,
    )


@dataclass(frozen=True, eq=False)
class FoldForests:
    """Forests that read the same, each grown without one fold, as one pass over one cloud."""

    forests: Sequence[FeatureForest]
    fold: npt.NDArray[np.int16]  #: (n,) by point of the cloud: which forest classifies it

    @property
    def features(self) -> Any:
        """Features that all forests read."""
        return self.forests[0].features

    @property
    def context(self) -> Context | None:
        """Context that all forests read of the pass before."""
        return self.forests[0].context

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (b, classes) by the forests that have not seen the points' folds."""
        each, fold = {}, self.fold[rows]
        for number in np.unique(fold).tolist():
            each[number] = self.forests[number].probabilities(values[fold == number])
        out = np.empty((len(values), next(iter(each.values())).shape[1]))
        for number, p in each.items():
            out[fold == number] = p
        return out


class WeightedPass(NamedTuple):
    """A pass, and the factors of its probabilities."""

    classifier: Estimator | FeatureReader
    codes: Sequence[int]  #: its classes
    #: (classes,) what the probabilities are multiplied by before they are handed on
    factors: npt.NDArray[np.float64] | None = None


def classify(passes: Sequence[WeightedPass], request: PredictRequest) -> Iterator[Block]:
    """Yield the weighted probabilities of the last pass for all points wanted, block by block."""
    first = passes[0].classifier
    if isinstance(first, PointEstimator):  # the only pass
        yield from first.predict(request)
        return
    for rows, probabilities in PassRun(passes, request).blocks():
        yield Block(rows, probabilities)


def sample_context(
    passes: Sequence[WeightedPass], request: PredictRequest, context: Context
) -> npt.NDArray[np.float32]:
    """Return the context (m, columns) that a further pass would read at the m rows wanted."""
    assert request.rows is not None
    width = len(context.names(passes[-1].codes))
    out = np.empty((len(request.rows), width), np.float32)
    for rows, columns in PassRun(passes, request, context).blocks():
        out[np.searchsorted(request.rows, rows)] = columns
    return out


class PassRun:
    """Auto-context passes at work on one cloud, band by band.

    Parameters
    ----------
    passes : sequence of WeightedPass
        Each but the first reads the context of the one before.
    request : PredictRequest
    context : Context, optional
        With it the run gives the columns of this context, after the last pass, instead of
        probabilities.
    """

    def __init__(
        self,
        passes: Sequence[WeightedPass],
        request: PredictRequest,
        context: Context | None = None,
    ) -> None:
        self._passes, self._request = passes, request
        readers = [each.classifier for each in passes if isinstance(each.classifier, FeatureReader)]
        read: list[Features | None] = [reader.features for reader in readers]
        contexts = [reader.context for reader in readers[1:] if reader.context is not None]
        if context is not None:
            contexts.append(context)
            read.append(None)
        #: What each step reads of the pass before; the last step may be the context alone.
        self._contexts: list[Context | None] = [None, *contexts]
        self._last = len(read) - 1
        wanted = [request.rows]  # of each step
        for later in reversed(contexts):
            wanted.insert(0, rows_needed(request.xyz, wanted[0], later))
        self._wanted = [_mask(rows, len(request.xyz)) for rows in wanted]
        # Where no pass reads strips beside its own any width will do.
        width = max((each.strip for each in contexts), default=0.0) or _ANY_WIDTH_M
        self._strips = Strips(request.xyz, wanted[0], width)
        n = len(self._strips)
        #: (n, classes) of each step but the last, in the order of the strips
        self._shares = [np.zeros((n, len(each.codes)), np.uint16) for each in passes[: self._last]]
        self._features = _share_sources(read, request)

    def blocks(self) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray]]:
        """Yield rows of the request's cloud with their probabilities, or columns of the context."""
        if not self._request.count:
            return
        bands = self._strips.bands()
        #: by band: features that a later step reads as well -> their blocks
        held: dict[int, dict[CloudFeatures, list[FeatureBlock]]] = {}
        for lead in range(len(bands) + self._last + 1):
            for step in range(self._last + 1):
                number = lead - step
                if not 0 <= number < len(bands):
                    continue
                for rows, result in self._work(step, bands[number], held.setdefault(number, {})):
                    if step < self._last:
                        self._shares[step][self._strips.places(rows)] = result
                        continue
                    if self._request.progress is not None:
                        self._request.progress.update(len(rows))
                    yield rows, result
            held.pop(lead - self._last, None)

    def _work(
        self, step: int, band: Band, held: dict[CloudFeatures, list[FeatureBlock]]
    ) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray]]:
        """Yield (rows, result of the step) for the rows of a band that the step must look at."""
        features, mask = self._features[step], self._wanted[step]
        rows = self._strips.rows(band[0])
        rows = rows if mask is None else rows[mask[rows]]
        work = self._on_band(step, band)
        threads = self._request.threads
        if features in held:
            for kept, result in map_blocks(work.classify, held[features], threads):
                if result is not None:
                    yield kept, result
        elif features is not None and len(rows):
            held[features] = []
            run = features.run(rows, memory_share=_SHARE_OF_BLOCKS)
            on_blocks = replace(work, run=run, keep=features in self._features[step + 1 :])
            for block, result in map_blocks(on_blocks.compute, run.ranges, threads):
                features.count(run, block)
                if on_blocks.keep:
                    held[features].append(block)
                yield block.rows, result
        elif len(rows):
            yield rows, work.result(rows, None)

    def _on_band(self, step: int, band: Band) -> _StepOnBand:
        """Return what a step does with the blocks of a band.

        It reads the shares of the band and of the strips beside it.
        """
        columns = None
        if context := self._contexts[step]:
            rows, request = self._strips.rows(band[1]), self._request
            shares = self._shares[step - 1][band[1]]
            height = request.dimensions.get(HEIGHT) if context.segment_codes else None
            columns = context.cell_means(
                request.xyz[rows],
                shares,
                request.threads,
                self._passes[step - 1].codes,
                None if height is None else np.asarray(height)[rows],
            )
        weighted = self._passes[step] if step < len(self._passes) else None
        return _StepOnBand(
            weighted,
            step < self._last,
            columns,
            self._strips,
            band[1].start,
            self._wanted[step],
            self._observe(step),
        )

    def _observe(self, step: int) -> Callable[..., None] | None:
        """Return a function that hands on what a step read; None where nobody wants it."""
        request = self._request
        if request.observe is None:
            return None
        hand_on = request.observe
        return lambda rows, *read: hand_on(PassInputs(step, rows, request.xyz[rows], *read))


@dataclass(frozen=True, eq=False)
class _StepOnBand:
    """One step on the blocks of one band.

    :meth:`compute` and :meth:`classify` are called in worker threads.
    """

    weighted_pass: WeightedPass | None  #: None where the columns of the context are the result
    hands_on: bool  #: whether the result is shares for the next pass
    context: CellContext | None  #: of the band and the strips beside it
    strips: Strips
    first_place: int  #: of the points of `context`, among the strips
    #: of rows in the request's cloud: those that the step must look at; None: all
    mask: npt.NDArray[np.bool_] | None
    observe: Callable[..., None] | None  #: receives rows, what a pass reads, and probabilities
    run: Run | None = None  #: that computes the features
    keep: bool = False  #: whether a later step needs the features

    def compute(self, part: tuple[int, int]) -> tuple[FeatureBlock, npt.NDArray]:
        """Return a block of features, with values if a later step needs them, and the result."""
        assert self.run is not None
        block = self.run.compute(part)
        result = self.result(block.rows, block.values)
        return (block if self.keep else block._replace(values=block.values[:0].copy())), result

    def classify(self, block: FeatureBlock) -> tuple[npt.NDArray[np.int64], npt.NDArray | None]:
        """Return the rows of a block that are wanted, and what the step makes of their features."""
        rows, values = block.rows, block.values
        if self.mask is not None:
            wanted = self.mask[rows]
            rows, values = rows[wanted], values[wanted]
        return rows, self.result(rows, values) if len(rows) else None

    def result(
        self, rows: npt.NDArray[np.int64], values: npt.NDArray[np.float32] | None
    ) -> npt.NDArray:
        """Return shares (b, classes), probabilities or context columns of a block."""
        parts = [] if values is None else [values]
        if self.context is not None:
            parts.append(self.context.columns(self.strips.places(rows) - self.first_place))
        read = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        if self.weighted_pass is None:
            return read
        classifier, _, factors = self.weighted_pass
        assert isinstance(classifier, FeatureReader)
        probabilities = classifier.probabilities(read, rows)
        if self.observe is not None:
            self.observe(rows, read, probabilities)
        p = weigh(probabilities, factors)
        return count_shares(p) if self.hands_on else p


def _share_sources(
    read: Sequence[Features | None], request: PredictRequest
) -> list[CloudFeatures | None]:
    """Return what computes the features of each step; equal features are computed once."""
    sources: dict[str, CloudFeatures] = {}
    out: list[CloudFeatures | None] = []
    for features in read:
        if features is None:
            out.append(None)
            continue
        key = json.dumps([features.plan.names, features.to_dict()])
        if key not in sources:
            sources[key] = CloudFeatures(features, request)
        out.append(sources[key])
    return out


#: Places of the points of a band, and of these and the strips beside it.
Band = tuple[slice, slice]


class Strips:
    """Points `rows` (None: all) in the order of strips of `width` meters, from south to north.

    Strips begin at multiples of the width.
    """

    def __init__(
        self, xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, width: float
    ) -> None:
        """Sort the rows by strip."""
        number = cell_numbers(xyz[:, 1] if rows is None else xyz[rows, 1], width)
        self._order: npt.NDArray[np.int64] | None = None
        # Else they follow each other already.
        if rows is not None or (number[1:] < number[:-1]).any():
            order = np.argsort(number, kind="stable")
            number = number[order]
            self._order = order if rows is None else rows[order]
            self._place = np.zeros(len(xyz), np.int32 if len(xyz) < 2**31 else np.int64)
            self._place[self._order] = np.arange(len(order))
        self._start = np.append(np.flatnonzero(begins_run(number)), len(number))

    def __len__(self) -> int:
        """Return the number of points that are looked at."""
        return int(self._start[-1])

    def bands(self) -> list[Band]:
        """Return strips that are worked on together."""
        start, last, out, first = self._start, len(self._start) - 1, [], 0
        while first < last:
            end = max(first + 1, int(np.searchsorted(start, start[first] + BAND, side="right")) - 1)
            beside = slice(start[max(first - 1, 0)], start[min(end + 1, last)])
            out.append((slice(start[first], start[end]), beside))
            first = end
        return out

    def rows(self, part: slice) -> npt.NDArray[np.int64]:
        """Return the rows of the points at some places."""
        return np.arange(part.start, part.stop) if self._order is None else self._order[part]

    def places(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the places of some rows in the order of the strips."""
        return rows if self._order is None else self._place[rows].astype(np.int64)


def _mask(rows: npt.NDArray[np.int64] | None, n: int) -> npt.NDArray[np.bool_] | None:
    if rows is None:
        return None
    mask = np.zeros(n, np.bool_)
    mask[rows] = True
    return mask
