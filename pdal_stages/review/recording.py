"""What the stages of `classify` make of some points of a cloud, kept step by step.

The points around them are read as far as the stages look, so results are those of a whole survey.
The model computes the points in question, and what these depend on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..base.columns import SomeRows
from ..base.errors import NoTerrainError
from ..base.grid import GridWindow
from ..base.las_boxes import Box, FilePoints, box_around, inside_box
from ..base.messages import Topic
from ..classifier.interface import ClassStep, PassInputs
from ..pipeline.copies import run_stages, selection
from ..pipeline.run import Pipeline
from ..pipeline.runtime import ExpandedStage, points_of
from ..pipeline.spatial_reference import Reference
from ..stages.apply_model import ApplyModel
from ..stages.base import WHOLE_CLOUD, Kept, Observer, Stage, used_distances
from ..stages.hag_morphological import HagMorphological
from ..stages.points import RESERVED

#: The dimension by which stages know the points that are explained: negative.
_OUTSIDE = f"{RESERVED}Outside"
#: Meters beyond the reach of the model and what follows, for neighbors of sparse points.
_MARGIN_M = 32.0
#: Dimensions of results, which are compared or that later runs begin with.
_OF_RESULTS = ("HeightAboveGround", "Reliability", "Checked")


@dataclass(frozen=True)
class Reaches:
    """Distances up to which others matter around the points that are explained, in meters.

    The first stages, such as noise, run on all points around. The ground filter, where it is not
    given its ground, takes of points far away the lowest of coarse cells. It classifies cells, and
    then it, the model and what follows run on points near alone.
    """

    first: int  #: number of the first stage that runs on points near alone
    model: int  #: number of the stage of the model
    ground: HagMorphological | None  #: this stage, where it finds the ground in cells
    used: Sequence[float]  #: of each stage: how far its results are used
    lines: float  #: what the model looks at among its results, where one may lie on a line
    near: float  #: what the stages from the first one on look at
    inner: float  #: within which results of the stages before it count
    outer: float  #: what these look at
    far: float  #: what the ground filter looks at

    @classmethod
    def of_stages(cls, stages: Sequence[Stage], is_classified: bool) -> Reaches:
        """Return the reaches of stages.

        Those after the model read the classes of points around from a file that `classify` wrote
        (`is_classified`); for another one they are computed.
        """
        reaches = [stage.halo_m() for stage in stages]
        first = model = next(n for n, stage in enumerate(stages) if isinstance(stage, ApplyModel))
        blocks = ground = None
        for number, stage in enumerate(stages[:model]):
            if isinstance(stage, HagMorphological) and (blocks := stage.blocks()) is not None:
                first, ground, reaches[number] = number, stage, 0.0

        def sees(later: int, earlier: int) -> bool:
            from_file = is_classified and earlier >= model
            return not from_file and stages[later].sees_results_of(stages[earlier])

        used = used_distances(reaches, sees)
        later = zip(used[first:], reaches[first:], strict=True)
        near = max(used_m + reach for used_m, reach in later) + _MARGIN_M
        inner = far = near
        if ground is not None and blocks is not None:
            inner += ground.reach_near_m
            far += blocks.margin + blocks.reach
        outer = inner + sum(reaches[:first])
        lines = sum(s.model.reach_of_lines_m for s in stages if isinstance(s, ApplyModel))
        return cls(first, model, ground, used, lines, near, inner, outer, max(far, outer))

    def limited(self, limit: float) -> Reaches:
        """Return these where points farther away than a limit count as far."""
        outer = min(self.outer, limit)
        inner = min(outer, max(self.near, outer - (self.outer - self.inner)))
        far = self.far if self.ground is not None else outer
        return replace(self, inner=inner, outer=outer, far=far)


#: What each step of the ground filter made of a piece of the cloud, by its name.
PieceRasters = dict[str, tuple[GridWindow, NDArray[np.float32]]]


@dataclass(eq=False)
class Recording(Observer):
    """Results of stages for the points that are explained, as the stages tell them."""

    cloud: FilePoints  #: the points near
    reference: Reference
    where: str | None  #: condition of the points that are classified
    rows: NDArray[np.int64]  #: (m,) of the points in question
    stages: list[Stage] = field(default_factory=list)
    classes: list[NDArray[np.uint8]] = field(default_factory=list)  #: (m,) after each stage
    pieces: list[PieceRasters] = field(default_factory=list)
    #: (m,) states of noise, and columns of the ground filter; empty without these stages
    noise: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    heights: dict[str, NDArray] = field(default_factory=dict)
    kept: dict[Kept, NDArray[np.bool_]] = field(default_factory=dict)  #: (m,) each
    inputs: list[PassInputs] = field(default_factory=list)
    #: (m,) classes after each step of the model's stage, and the least reliability that keeps them
    steps: dict[ClassStep, tuple[NDArray[np.uint8], NDArray[np.float32] | None]] = field(
        default_factory=dict
    )
    #: (m,) probability and class of lines, where the model has these
    lines: tuple[NDArray[np.float32], NDArray[np.uint8]] | None = None
    #: (m,) dimensions after all stages
    results: Mapping[str, NDArray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    #: which points (n,) have classes that are used, and whether some of these may be lines
    _used: NDArray[np.bool_] = field(init=False)
    _may_be_lines: bool = False

    def run(self, pipeline: Pipeline, reaches: Reaches, far: Sequence[NDArray[np.float64]]) -> None:
        """Run the stages: the first ones on all points, those after them on points near.

        `far` are parts of the points that :meth:`.HagMorphological.reduce_far` left.
        """
        unit, wkt = self.reference.units.horizontal, self.reference.wkt
        ours = pipeline.expanded.ours
        for each in ours:
            each.update_context(observer=self)
        cloud, known = self.cloud, selection(self.where, self.cloud)
        try:
            seen = run_stages(ours[: reaches.first], cloud, wkt, known, self._keep_classes)
        except NoTerrainError as error:
            raise NoTerrainError(
                f"around the place {error.what}",
                found=f"{len(cloud.number):,} points, all that are read",
                cure="Explain places nearer to ground, or leave --ground given out",
            ) from None
        near = _rows_in(cloud, self._box(reaches.near / unit))
        if (ground := reaches.ground) is not None:
            candidates = ground_candidates(ground, seen, wkt)
            x, y, _ = candidates
            inner = inside_box(x, y, [unit * side for side in self._box(reaches.inner / unit)])
            places = unit * np.column_stack([cloud[axis][self.rows] for axis in "XY"])
            blocks = ground.cells_near(
                candidates[:, inner], np.concatenate([*far]), places, reaches.near
            )
            ours[reaches.first].update_context(blocks=blocks)
        self.cloud, self.rows = cloud.take(near), np.searchsorted(near, self.rows)
        self.cloud.load(_OF_RESULTS)
        xy = np.column_stack([self.cloud[axis] for axis in "XY"])
        outside = unit * cKDTree(xy[self.rows]).query(xy, p=np.inf)[0]
        outside[self.rows] = -1.0
        known = {name: values[near] for name, values in seen.maps[0].items()}
        known[_OUTSIDE] = outside
        before, after = ours[reaches.first : reaches.model], ours[reaches.model :]
        known = {**run_stages(before, self.cloud, wkt, known, self._keep_classes).maps[0]}
        self._used = outside <= reaches.used[reaches.model]
        for each, used_m in zip(ours, reaches.used, strict=True):
            each.update_context(outside=_OUTSIDE, used_m=used_m)
        seen = run_stages(after, self.cloud, wkt, known, self._keep_classes)
        if self._may_be_lines:
            # Of lines all points around are needed, which few places are worth.
            self.inputs.clear()
            del self.stages[reaches.model :], self.classes[reaches.model :]
            after[0].update_context(used_m=reaches.used[reaches.model] + reaches.lines)
            seen = run_stages(after, self.cloud, wkt, known, self._keep_classes)
        self.results = SomeRows(seen, self.rows)
        texts = [*pipeline.expanded.warnings, *pipeline.messages]
        shown = (str(each) for each in texts if each.topic is not Topic.OTHER_DENSITY)
        self.notes = [*dict.fromkeys(shown)]

    def _box(self, reach: float) -> Box:
        """Return the box of the points in question, wider by a reach in units of coordinates."""
        return box_around(np.column_stack([self.cloud[axis][self.rows] for axis in "XY"]), reach)

    def _keep_classes(self, each: ExpandedStage, seen: Mapping[str, NDArray]) -> None:
        self.stages.append(each.stage)
        self.classes.append(seen["Classification"][self.rows])

    def see_noise(self, states: NDArray[np.uint8]) -> None:
        """Keep the states of noise."""
        self.noise = states[self.rows]

    def see_raster(self, name: str, window: GridWindow, values: NDArray[np.float32]) -> None:
        """Keep a raster; the first step's begins another piece."""
        if not self.pieces or name in self.pieces[-1]:
            self.pieces.append({})
        self.pieces[-1][name] = window, values

    def see_heights(self, columns: Mapping[str, NDArray]) -> None:
        """Keep the columns of the ground filter."""
        self.heights = {name: values[self.rows] for name, values in columns.items()}

    def see_kept(self, points: Mapping[Kept, NDArray[np.bool_]]) -> None:
        """Keep why the model leaves points alone."""
        self.kept = {reason: which[self.rows] for reason, which in points.items()}

    def see_inputs(self, inputs: PassInputs) -> None:
        """Keep what a pass read."""
        self.inputs.append(inputs)

    def see_classes(
        self,
        step: ClassStep,
        codes: NDArray[np.uint8],
        least: NDArray[np.float32] | None = None,
    ) -> None:
        """Keep classes after a step of the model's stage."""
        limit = None if least is None else least[self.rows]
        self.steps[step] = codes[self.rows], limit

    def see_lines(self, probability: NDArray[np.float32], codes: NDArray[np.uint8]) -> None:
        """Keep which points may be lines."""
        self.lines = probability[self.rows], codes[self.rows]
        self._may_be_lines = bool(probability[self._used].any())


def ground_candidates(
    ground: HagMorphological, columns: Mapping[str, NDArray], wkt: str
) -> NDArray[np.float64]:
    """Return the coordinates (3, n), in meters, of the points that may be ground."""
    module = {"spatialreference": {"wkt": wkt}}
    return ground.ground_candidates(points_of(ground, WHOLE_CLOUD, module, columns))


def _rows_in(columns: Mapping[str, NDArray], box: Box) -> NDArray[np.int64]:
    """Return the rows of the points in a box."""
    return np.flatnonzero(inside_box(columns["X"], columns["Y"], box))
