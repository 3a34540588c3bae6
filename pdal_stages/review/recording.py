"""Points around a place, and what the stages of `classify` make of some of them, kept step by step.

All points within the reach of the stages are read, so results are those of a whole survey. The
model computes the points in question, and what these depend on.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..base.columns import LazyColumns, SomeRows
from ..base.dimensions import RELIABILITY
from ..base.errors import NoTerrainError, StageError
from ..base.grid import GridWindow
from ..base.las_check import beyond_box
from ..base.las_points import USUAL, LasColumns, Layout, read_records
from ..classifier.interface import ClassStep, PassInputs
from ..classifier.model import OTHER_DENSITY
from ..features.cell_means import density
from ..pipeline.copies import run_stages, selection
from ..pipeline.run import Pipeline
from ..pipeline.runtime import ExpandedStage
from ..pipeline.spatial_reference import Reference
from ..stages.apply_model import ApplyModel
from ..stages.base import Kept, Observer, Stage, used_distances
from ..stages.points import RESERVED
from .explanation import AskedPlace

#: The dimension by which stages know the points that are explained: negative.
_OUTSIDE = f"{RESERVED}Outside"
#: Dimensions that are read where a file has them.
_READ = (*USUAL, "ClassFlags", "HeightAboveGround", "Reliability", "Checked")
#: Meters beyond the reach of the model and what follows, for neighbors of sparse points.
_MARGIN_M = 32.0
#: Farthest that the nearest point may be, in meters, ...
_FARTHEST_M = 2.0
#: ... or in mean distances between points, where these are larger.
_FARTHEST_SPACINGS = 3.0
#: Points of a file that are compared with the box in its header.
_PROBED = 1000


def _is_in_its_box(path: str, layout: Layout) -> bool:
    """Return whether the first points of a file lie in the box that its header names.

    Not all are read for that: a file whose box is wrong has mostly no point in it.
    """
    for records in read_records(path, layout, 0, min(_PROBED, layout.header.count), only=["X"]):
        x, y = (layout.fields[axis].read(records) for axis in "XY")
        return beyond_box(path, (x.min(), y.min(), x.max(), y.max())) is None
    return True


class Surroundings(LazyColumns):
    """The dimensions of the points of files within a box, each read when it is asked for.

    Those that every run needs are read in the first pass; another one takes a pass of its own.
    """

    def __init__(self, files: Sequence[str], box: Sequence[float]) -> None:
        west, south, east, north = box
        self.files = files
        self._rows: dict[int, NDArray[np.int64]] = {}  #: of files that have points in the box
        self._layouts = {n: Layout.of_file(path) for n, path in enumerate(files)}
        for index, layout in list(self._layouts.items()):
            x0, y0, x1, y1 = layout.header.box
            apart = x0 > east or x1 < west or y0 > north or y1 < south
            if apart and _is_in_its_box(files[index], layout):
                del self._layouts[index]
        first = []
        for index, layout in self._layouts.items():
            names, rows, at = [n for n in layout.fields if n in _READ], [np.zeros(0, np.int64)], 0
            for records in read_records(files[index], layout, only=names):
                x, y = (layout.fields[axis].read(records) for axis in "XY")
                inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
                rows.append(at + np.flatnonzero(inside))
                first.append((layout, records if inside.all() else records[inside]))
                at += len(records)
            self._rows[index] = np.concatenate(rows)
        self._first = LasColumns(first)
        self._more: dict[str, NDArray] = {}
        counts = [len(rows) for rows in self._rows.values()]
        #: (n,) each: number of the file, and of the point in it
        self.file = np.repeat(np.fromiter(self._rows, np.int64), counts)
        self.number = np.concatenate([np.zeros(0, np.int64), *self._rows.values()])

    @property
    def names(self) -> Collection[str]:
        """Return the names of the dimensions."""
        return self._first.names

    def __getitem__(self, name: str) -> NDArray:
        """Return a dimension (n,)."""
        if name in _READ or name not in self:
            return self._first[name]
        if name not in self._more:
            parts: list[tuple[Layout, NDArray]] = []
            for index, layout in self._layouts.items():
                at, rows = 0, self._rows[index]
                for records in read_records(self.files[index], layout, only=[name]):
                    low, high = np.searchsorted(rows, (at, at + len(records)))
                    parts.append((layout, records[rows[low:high] - at]))
                    at += len(records)
            self._more[name] = LasColumns(parts)[name]
        return self._more[name]

    def nearest(self, place: AskedPlace, unit: float) -> tuple[int, float]:
        """Return the row of the nearest point and its distance in meters; StageError if far.

        `unit` are the meters of a unit of the coordinates.
        """
        reason, target = "no point at all", np.array([v for v in place[:3] if v is not None])
        if len(self.number):
            xyz = np.column_stack([self[axis] for axis in "XYZ"])
            away = unit * np.sqrt(((xyz[:, : len(target)] - target) ** 2).sum(axis=1))
            inside = np.flatnonzero(away <= place.doubtful_m)
            if len(inside) and "Reliability" in self:
                row = int(inside[np.argmin(self["Reliability"][inside])])
                return row, float(away[row])
            row, near = int(np.argmin(away)), away < 50.0
            spacing = 1.0 / np.sqrt(density(xyz[near] * unit)) if near.any() else 0.0
            if away[row] <= max(_FARTHEST_M, _FARTHEST_SPACINGS * spacing, place.doubtful_m):
                return row, float(away[row])
            reason = f"the nearest is {away[row]:.1f} m away"
            flat = unit * np.hypot(*(xyz[:, :2] - target[:2]).T)
            if len(target) == 3 and flat.min() <= _FARTHEST_M:
                reason += (
                    f"; without Z {flat.min():.1f} m, at a height of {xyz[flat.argmin(), 2]:.2f}"
                )
        raise StageError(
            "there is no point near this place",
            where=" ".join(f"{value:.12g}" for value in target),
            found=reason,
            cure="Give X and Y in the cloud's reference system, or name theirs with --crs",
        )


#: What each step of the ground filter made of a piece of the cloud, by its name.
PieceRasters = dict[str, tuple[GridWindow, NDArray[np.float32]]]


@dataclass(eq=False)
class Recording(Observer):
    """Results of stages for the points that are explained, as the stages tell them."""

    cloud: Surroundings
    reference: Reference
    where: str | None  #: condition of the points that are classified
    rows: NDArray[np.int64]  #: (m,) of the points in the surroundings
    rows_seen: NDArray[np.int64] = field(init=False)  #: (m,) of the points where stages run
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
    #: (m,) dimensions after all stages
    results: Mapping[str, NDArray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def run(self, pipeline: Pipeline) -> None:
        """Run the stages; those from the model on on points near, and for the points alone.

        Stages after the model read the classes of points around from a file that `classify` wrote;
        for another one they are computed.
        """
        ours, unit = pipeline.expanded.ours, self.reference.units.horizontal
        for each in ours:
            each.update_context(observer=self)
        first = next(n for n, each in enumerate(ours) if isinstance(each.stage, ApplyModel))
        columns, wkt = self.cloud, self.reference.wkt
        self.rows_seen = self.rows
        known = selection(self.where, columns)
        try:
            seen = run_stages(ours[:first], columns, wkt, known, self._keep_classes)
        except NoTerrainError as error:
            raise NoTerrainError(
                f"around the place {error.what}",
                found=f"{len(columns.number):,} points, all that are read",
                cure="Explain places nearer to ground, or leave --ground given out",
            ) from None
        reach = (sum(each.stage.halo_m() for each in ours[first:]) + _MARGIN_M) / unit
        near = _rows_near(columns, self.rows, reach)
        self.rows_seen = np.searchsorted(near, self.rows)
        xy = np.column_stack([columns[axis][near] for axis in "XY"])
        outside = unit * cKDTree(xy[self.rows_seen]).query(xy, p=np.inf)[0]
        outside[self.rows_seen] = -1.0
        after = [each.stage for each in ours[first:]]
        used = [0.0] * len(after)
        if RELIABILITY.name not in columns:  # else the file has the classes of points around
            reaches = [each.halo_m() for each in after]
            used = used_distances(reaches, lambda m, n: after[m].sees_results_of(after[n]))
        model_stage = cast(ApplyModel, after[0])  # finds lines among the points that it classifies
        used[0] += model_stage.model.reach_of_lines_m
        for each, used_m in zip(ours[first:], used, strict=True):
            each.update_context(outside=_OUTSIDE, used_m=used_m)
        part, known = SomeRows(seen, near), {_OUTSIDE: outside}
        seen = run_stages(ours[first:], part, wkt, known, self._keep_classes)
        self.results = SomeRows(seen, self.rows_seen)
        texts = [*pipeline.expanded.warnings, *pipeline.messages]
        self.notes = [text for text in texts if OTHER_DENSITY not in text]

    def _keep_classes(self, each: ExpandedStage, seen: Mapping[str, NDArray]) -> None:
        self.stages.append(each.stage)
        self.classes.append(seen["Classification"][self.rows_seen])

    def see_noise(self, states: NDArray[np.uint8]) -> None:
        """Keep the states of noise."""
        self.noise = states[self.rows_seen]

    def see_raster(self, name: str, window: GridWindow, values: NDArray[np.float32]) -> None:
        """Keep a raster; the first step's begins another piece."""
        if not self.pieces or name in self.pieces[-1]:
            self.pieces.append({})
        self.pieces[-1][name] = window, values

    def see_heights(self, columns: Mapping[str, NDArray]) -> None:
        """Keep the columns of the ground filter."""
        self.heights = {name: values[self.rows_seen] for name, values in columns.items()}

    def see_kept(self, points: Mapping[Kept, NDArray[np.bool_]]) -> None:
        """Keep why the model leaves points alone."""
        self.kept = {reason: which[self.rows_seen] for reason, which in points.items()}

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
        limit = None if least is None else least[self.rows_seen]
        self.steps[step] = codes[self.rows_seen], limit


def _rows_near(
    columns: Mapping[str, NDArray], rows: NDArray[np.int64], reach: float
) -> NDArray[np.int64]:
    """Return the rows of the points in the box around those of `rows`, `reach` wider."""
    near = np.ones(len(columns["X"]), np.bool_)
    for axis in (columns["X"], columns["Y"]):
        at = axis[rows]
        near &= (axis >= at.min() - reach) & (axis <= at.max() + reach)
    return np.flatnonzero(near)
