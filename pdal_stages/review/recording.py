"""Points around a place, and what the stages of `classify` make of some of them, kept step by step.

All points within the reach of the stages are read, so results are those of a whole survey. The
model computes the points in question, and what these depend on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.grid import GridWindow
from ..base.las_points import Layout, RecordColumns, read_records
from ..classifier.interface import PassInputs
from ..features.cell_means import density
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.copies import selection
from ..pipeline.run import Pipeline
from ..pipeline.runtime import ExpandedStage
from ..pipeline.spatial_reference import Reference
from ..stages.apply_model import ApplyModel
from ..stages.base import Observer
from ..stages.points import RESERVED
from .explanation import AskedPlace

#: The dimension by which stages know the points that are explained: negative.
_OUTSIDE = f"{RESERVED}Outside"
#: Farthest that the nearest point may be, in meters, ...
_FARTHEST_M = 2.0
#: ... or in mean distances between points, where these are larger.
_FARTHEST_SPACINGS = 3.0


class Surroundings:
    """Points of files within a box."""

    def __init__(self, files: Sequence[str], box: Sequence[float]) -> None:
        self.files = files
        west, south, east, north = box
        parts: list[tuple[Layout, NDArray]] = []
        places = [np.zeros((2, 0), np.int64)]
        for index, path in enumerate(files):
            layout, at = Layout.of_file(path), 0
            x0, y0, x1, y1 = layout.header.box
            if x0 > east or x1 < west or y0 > north or y1 < south:
                continue
            for records in read_records(path, layout):
                x, y = (layout.column(records, axis) for axis in "XY")
                rows = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))
                parts.append((layout, records[rows] if len(rows) < len(records) else records))
                places.append(np.stack([np.full(len(rows), index), rows + at]))
                at += len(records)
        self.columns = RecordColumns(parts)
        #: (n,) each: number of the file, and of the point in it
        self.file, self.number = np.concatenate(places, axis=1)

    def nearest(self, place: AskedPlace, unit: float) -> tuple[int, float]:
        """Return the row of the nearest point and its distance in meters; StageError if far.

        `unit` are the meters of a unit of the coordinates.
        """
        found = "no point at all"
        if len(self.number):
            xyz = np.column_stack([self.columns[axis] for axis in "XYZ"])
            asked = np.array([value for value in place if value is not None])
            away = unit * np.sqrt(((xyz[:, : len(asked)] - asked) ** 2).sum(axis=1))
            row, near = int(np.argmin(away)), away < 50.0
            spacing = 1.0 / np.sqrt(density(xyz[near] * unit)) if near.any() else 0.0
            if away[row] <= max(_FARTHEST_M, _FARTHEST_SPACINGS * spacing):
                return row, float(away[row])
            found = f"the nearest is {away[row]:.1f} m away"
        raise StageError(
            "there is no point near this place",
            where=" ".join(f"{value:.2f}" for value in place if value is not None),
            found=found,
            cure="Give X and Y in the cloud's reference system, or name theirs with --crs",
        )


@dataclass(eq=False)
class Recording:
    """What stages made of the points that are explained, and how they came to it."""

    around: Surroundings
    request: ClassifyRequest
    reference: Reference
    rows: NDArray[np.int64]  #: (m,) of the points
    stages: list[ExpandedStage] = field(default_factory=list)
    classes: list[NDArray[np.uint8]] = field(default_factory=list)  #: (m,) after each stage
    #: by piece of the cloud what each step of the ground filter made
    pieces: list[dict[str, tuple[GridWindow, NDArray[np.float32]]]] = field(default_factory=list)
    heights: Mapping[str, NDArray] = field(default_factory=dict)  #: columns of the ground filter
    inputs: list[PassInputs] = field(default_factory=list)
    seen: Mapping[str, NDArray] = field(default_factory=dict)  #: dimensions after all stages
    notes: list[str] = field(default_factory=list)

    def run(self, pipeline: Pipeline) -> None:
        """Run the stages; those from the model on compute the points alone."""
        columns, outside = self.around.columns, np.ones(len(self.around.number), np.float32)
        outside[self.rows] = -1.0
        observer = Observer(self._keep, self._keep_heights, self.inputs.append)
        facts: dict[str, str] = {}
        for each in pipeline.expanded.ours:
            facts |= {"outside": _OUTSIDE} if isinstance(each.stage, ApplyModel) else {}
            each.update_context(observer=observer, **facts)
        known = {_OUTSIDE: outside, **selection(self.request.where, columns)}
        self.seen = pipeline.run_here(columns, self.reference.wkt, known, self._keep_classes)
        self.notes = [text for text in pipeline.messages if "points/m2" not in text]

    def _keep(self, name: str, window: GridWindow, values: NDArray[np.float32]) -> None:
        if not self.pieces or name in self.pieces[-1]:  # each piece begins with the same step
            self.pieces.append({})
        self.pieces[-1][name] = window, values

    def _keep_heights(self, columns: Mapping[str, NDArray]) -> None:
        self.heights = columns

    def _keep_classes(self, each: ExpandedStage, seen: Mapping[str, NDArray]) -> None:
        self.stages.append(each)
        self.classes.append(np.array(seen["Classification"][self.rows]))
