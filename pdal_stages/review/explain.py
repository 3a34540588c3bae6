"""Explain the classes of points: what each stage made of them, and which inputs decided."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..base.errors import OptionError
from ..base.las import LasHeader, header_there
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_las
from ..pipeline.run import Pipeline
from ..pipeline.spatial_reference import check_one_reference, reference_of_file
from ..stages.apply_model import ApplyModel
from .explanation import AskedPlace, Explanation
from .recording import Recording, Surroundings
from .trace_points import trace_point

#: Files with fewer points together are read once, for all places (not tuned).
_FEW_POINTS = 5_000_000
#: Points that are read for one run at most, about: they take 0.4 GB a million.
_MOST_POINTS = 10_000_000
#: How the note on points that are left out begins.
_TOO_MANY = "there are too many points: wide roofs may count otherwise, as those farther away than"
#: Side in meters of squares of larger ones whose places are explained in one run (not tuned).
_SQUARE_M = 256.0


def explain_points(
    inputs: Sequence[str],
    places: Sequence[AskedPlace],
    request: ClassifyRequest,
    reach_m: float = math.inf,
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
    reach_m : float
        Points farther away are not read, though the stages may look farther: for hints.
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
    reference = references[files[0]]
    exact = {**request.classifier_options, "compact": False}
    request = replace(request, dimensions=("Probability_",), classifier_options=exact)
    unit = reference.units.horizontal
    headers = [header for path in files if (header := header_there(path)) and header.count]
    is_small = sum(header.count for header in headers) < _FEW_POINTS
    out: dict[int, Explanation] = {}
    for members in _squares(places, math.inf if is_small else _SQUARE_M / unit):
        pipeline = _checked_pipeline(request, files[0], against)
        far = min(reach_m, sum(ours.stage.halo_m() for ours in pipeline.expanded.ours)) / unit
        xy = np.array([places[number][:2] for number in members])
        reach = _reach_that_fits(headers, xy, far)
        box = [*(xy.min(axis=0) - reach), *(xy.max(axis=0) + reach)]
        cloud = Surroundings(files, box)
        nearest = [cloud.nearest(places[number], unit) for number in members]
        rows = np.array([row for row, _ in nearest])
        recording = Recording(cloud, reference, request.where, rows)
        recording.run(pipeline)
        if reach < far:
            recording.notes.append(f"{_TOO_MANY} {reach * unit:.0f} m are not read")
        for at, number in enumerate(members):
            out[number] = trace_point(recording, at, nearest[at][1], against)
    return [out[number] for number in range(len(places))]


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


def _squares(places: Sequence[AskedPlace], side: float) -> list[list[int]]:
    """Return the numbers of the places in each square."""
    squares: dict[tuple[float, float], list[int]] = {}
    for number, place in enumerate(places):
        squares.setdefault((place.x // side, place.y // side), []).append(number)
    return list(squares.values())
