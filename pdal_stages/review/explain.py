"""Explain the classes of points: what each stage made of them, and which inputs decided."""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..base.dimensions import RELIABILITY
from ..base.errors import OptionError
from ..base.las import LasHeader, header_there
from ..base.las_boxes import box_around, read_around
from ..base.las_points import USUAL, LasColumns, layout_there
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.copies import selection
from ..pipeline.inputs_outputs import input_files, is_las
from ..pipeline.run import Pipeline
from ..pipeline.spatial_reference import Reference, check_one_reference, reference_of_file
from ..stages.apply_model import ApplyModel
from .explanation import Explanation
from .places import AskedPlace
from .recording import Reaches, Recording, ground_candidates
from .trace_points import trace_point

#: Files with fewer points together are read once, for all places (not tuned).
_FEW_POINTS = 5_000_000
#: Points around places that count in full, at most about: they take 0.15 GB a million.
_MOST_POINTS = 20_000_000
#: Dimensions of all points that are read.
_READ = (*USUAL, "ClassFlags")
#: How the note on points that count less begins.
_TOO_MANY = "there are too many points, so the ground may be another: of those farther away than"
#: Side in meters of squares of larger ones whose places are explained in one run (not tuned).
_SQUARE_M = 256.0


def explain_points(
    inputs: Sequence[str],
    places: Sequence[AskedPlace],
    request: ClassifyRequest,
    against: int | None = None,
) -> list[Explanation]:
    """Explain the points nearest to places.

    Parameters
    ----------
    inputs : sequence of str
        LAS and LAZ files, folders or patterns.
    places : sequence of AskedPlace
        In the reference system of the files.
    request : ClassifyRequest
        How the points are classified.
    against : int, optional
        Class of the model that the one found is compared with; by default the class of the file,
        where the model has it and finds another one, else the one that is next likely.

    Raises
    ------
    StageError
        Where no point is near a place, or the points cannot be classified.
    """
    files = input_files(inputs)
    if odd := [name for name in files if not is_las(name)]:
        cure = "Convert it first: pdal translate INPUT input.laz"
        raise OptionError("explain reads LAS and LAZ files", found=odd[0], cure=cure)
    references = {path: reference_of_file(path) for path in files}
    check_one_reference(references)
    exact = {**request.classifier_options, "compact": False}
    request = replace(request, dimensions=("Probability_",), classifier_options=exact)
    cloud = _Cloud(files, references[files[0]], request, against)
    out: dict[int, Explanation] = {}
    for members in cloud.squares(places):
        recording, away = cloud.record([places[number] for number in members])
        for at, number in enumerate(members):
            out[number] = trace_point(recording, at, away[at], against)
    return [out[number] for number in range(len(places))]


@dataclass(frozen=True)
class _Cloud:
    """The files in which points are explained, and how they are classified."""

    files: Sequence[str]
    reference: Reference
    request: ClassifyRequest
    against: int | None

    @cached_property
    def headers(self) -> list[LasHeader]:
        """Return the headers of files that have points."""
        return [header for path in self.files if (header := header_there(path)) and header.count]

    def squares(self, places: Sequence[AskedPlace]) -> list[list[int]]:
        """Return the numbers of the places that are explained in one run, of each run."""
        is_small = sum(header.count for header in self.headers) < _FEW_POINTS
        side = math.inf if is_small else _SQUARE_M / self.reference.units.horizontal
        squares: dict[tuple[float, float], list[int]] = {}
        for number, place in enumerate(places):
            squares.setdefault((place.x // side, place.y // side), []).append(number)
        return list(squares.values())

    def record(self, places: Sequence[AskedPlace]) -> tuple[Recording, list[float]]:
        """Return what the stages make of the points nearest to places, and how far these are."""
        unit, where = self.reference.units.horizontal, self.request.where
        pipeline = _checked_pipeline(self.request, self.files[0], self.against)
        stages = [each.stage for each in pipeline.expanded.ours]
        layouts = filter(None, map(layout_there, self.files))
        is_classified = any(RELIABILITY.name in layout.fields for layout in layouts)
        needed = Reaches.of_stages(stages, is_classified)
        xy = np.array([place[:2] for place in places])
        fitting = unit * _reach_that_fits(self.headers, xy, needed.outer / unit)
        reaches = needed.limited(fitting)
        far: list[NDArray[np.float64]] = [np.empty((0, 3))]

        def reduce(columns: LasColumns) -> None:
            if reaches.ground is not None:
                seen = ChainMap(selection(where, columns), cast(dict, columns))
                candidates = ground_candidates(reaches.ground, seen, self.reference.wkt)
                far.append(reaches.ground.reduce_far(candidates))

        near, outer, inner = (
            box_around(xy, reach_m / unit)
            for reach_m in (reaches.outer, reaches.far, reaches.inner)
        )
        names = None if where else _READ
        cloud = read_around(self.files, near, outer, inner, names, reduce)
        nearest = [place.nearest(cloud, unit) for place in places]
        rows = np.array([row for row, _ in nearest])
        recording = Recording(cloud, self.reference, where, rows)
        recording.run(pipeline, reaches, far)
        if fitting < needed.outer:
            lost = "only the lowest of each place count" if reaches.ground else "are not read"
            recording.notes.append(f"{_TOO_MANY} {fitting:.0f} m {lost}")
        return recording, [away for _, away in nearest]


def _checked_pipeline(request: ClassifyRequest, path: str, against: int | None) -> Pipeline:
    """Return the stages of a request; OptionError where they cannot be explained."""
    pipeline = request.pipeline(path, "explained.laz")
    if not pipeline.is_read_here:
        types = ", ".join(stage["type"] for stage in request.stages)
        what = "the model's heights are those of stages of PDAL, which explain does not run"
        raise OptionError(what, found=types, cure="Take another model")
    stages = [ours.stage for ours in pipeline.expanded.ours]
    codes = {c for each in stages if isinstance(each, ApplyModel) for c, _ in each.model.classes}
    if against is not None and against not in codes:
        known = f"classes {', '.join(map(str, sorted(codes)))}"
        what = f"the model cannot compare with class {against}, which it does not know"
        raise OptionError(what, found=known, cure="Give one of them with --against")
    return pipeline


def _reach_that_fits(headers: Sequence[LasHeader], xy: NDArray[np.float64], reach: float) -> float:
    """Return how far around places (m, 2) there are about `_MOST_POINTS`, `reach` at most."""
    while True:
        first, last = xy.min(axis=0) - reach, xy.max(axis=0) + reach
        points = 0.0
        for header in headers:
            low, high = np.reshape(header.box, (2, 2))
            inside = np.minimum(high, last) - np.maximum(low, first)
            points += header.count * np.prod(np.clip(inside / (high - low + 1e-9), 0.0, 1.0))
        if points <= _MOST_POINTS:
            return reach
        reach *= 0.9
