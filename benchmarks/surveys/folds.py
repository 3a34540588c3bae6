"""Models that miss one fold of the surveys each, at little more than the cost of one.

What is computed of the points does not depend on who is left out, so it is computed once, for every point of every copy, and
kept in a folder. The surroundings that a later pass reads of fold B where A is left out come from forests grown
without both; that of the first pass serves where B is left out and A is read, too.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from recipe import OPTIONS, training_clouds
from surveys import SURVEYS

from pdal_stages import Model, TrainingCloud
from pdal_stages.classifier.algorithms import PredictRequest
from pdal_stages.classifier.clouds import label_classes
from pdal_stages.classifier.context import Context, count_shares
from pdal_stages.classifier.featureforest import CloudFeatures, FeatureForest, Features
from pdal_stages.classifier.forest import Forest, grow_forest
from pdal_stages.classifier.foresttraining import FOLD_TREES, feature_plan
from pdal_stages.classifier.model import load_model
from pdal_stages.classifier.sampling import draw_samples

#: Of a forest of a model that misses a survey, by default: what the card's and the review's figures are of.
TREES = 20
FEATURES = Features(feature_plan(OPTIONS))
CONTEXT = Context(tuple(OPTIONS.context))
#: What a pass said of all points of a cloud, (n, classes), by the cloud's number.
Votes = dict[int, npt.NDArray[np.uint16]]


def features_of(cloud: TrainingCloud) -> npt.NDArray[np.float32]:
    """What the first pass reads of all points, (n, features)."""
    out = np.empty((len(cloud.xyz), len(FEATURES.plan.names)), np.float32)
    request = PredictRequest(cloud.xyz, cloud.dimensions)
    for rows, values in CloudFeatures(FEATURES, request).blocks(None, lambda values, rows: values):
        out[rows] = values
    return out


class LeaveOneOut:
    """The copies of all surveys, and models of so many trees a pass without one fold of these."""

    def __init__(
        self, data: Path, surveys: Iterable[str], folder: Path, trees: int = TREES
    ) -> None:
        self.trees = trees
        names = sorted(surveys)
        self.folds = sorted({SURVEYS[name].fold for name in names})
        self.clouds: list[TrainingCloud] = []
        self.tables: list[npt.NDArray[np.float32]] = []
        for name in names:
            for cloud in training_clouds(data, name):
                path = folder / f"{len(self.clouds)}.npy"
                np.save(path, features_of(cloud))
                self.clouds.append(cloud)
                self.tables.append(np.load(path, mmap_mode="r"))
        labeled = label_classes(self.clouds, OPTIONS)
        self.classes = list(zip(labeled.classes.codes, labeled.classes.names, strict=True))
        of = [cloud.survey for cloud in self.clouds]
        self.samples = draw_samples(labeled, len(self.classes), OPTIONS.count, OPTIONS.seed, of)
        self.fold_of = np.array([SURVEYS[name].fold for name in of])
        self.fold = self.fold_of[self.samples.cloud]
        self.values = self.samples.take(self.tables.__getitem__)
        self._pair = cache(self._grown_without)
        self.without_fold = cache(self._without_fold)

    def _grow(
        self, values: npt.NDArray[np.float32], kept: npt.NDArray[np.bool_], trees: int
    ) -> Forest:
        names = ("seed", "min_samples_leaf", "max_samples", "max_features")
        setting = {name: getattr(OPTIONS, name) for name in names}
        weight = self.samples.weight * kept
        values = np.asfortranarray(values)
        return grow_forest(values, self.samples.label, weight, trees, **setting)[0]

    def _grown_without(self, one: int, other: int) -> Forest:
        kept = (self.fold != one) & (self.fold != other)
        return self._grow(self.values, kept, self._few)

    @property
    def _few(self) -> int:
        """Trees of a forest whose votes the next pass is trained on."""
        return max(1, round(FOLD_TREES * self.trees))

    def without(self, name: str) -> Model:
        """The model of all surveys but those of this one's fold."""
        return self.without_fold(SURVEYS[name].fold)

    def _without_fold(self, left: int) -> Model:
        kept = self.fold != left
        passes, values = [], self.values
        votes: Votes = {}
        for number in range(OPTIONS.passes):
            if number:
                votes = self._votes(left, values, votes)
                values = np.concatenate([self.values, self._around(votes)], axis=1)
            forest = self._grow(values, kept, self.trees)
            passes.append(FeatureForest(FEATURES, forest, CONTEXT if number else None))
        # What is known of the shipped model, which is of the same make, but for what is known of its samples.
        info = {**copy.deepcopy(load_model("standard").info), "training": self._training(left)}
        info["passes"] = [{"importances": None}] * len(passes)
        return Model(tuple(passes), self.classes, {**info, "voxel": OPTIONS.voxel})

    def _votes(self, left: int, values: npt.NDArray[np.float32], before: Votes) -> Votes:
        """What a pass says of all points of the clouds that are trained on where a fold is left out, by forests that have
        seen neither that nor the cloud's own: `values` is what the pass reads of the samples, `before` what the pass before
        said, nothing of the first pass."""
        found = {}
        for other in self.folds:
            if other == left:
                continue
            if before:
                kept = (self.fold != left) & (self.fold != other)
                forest = self._grow(values, kept, self._few)
            else:
                forest = self._pair(*sorted((left, other)))
            for number, (cloud, table) in enumerate(zip(self.clouds, self.tables, strict=True)):
                if self.fold_of[number] != other or not len(self.samples.of_cloud(number)[0]):
                    continue
                read = np.ascontiguousarray(table)
                if before:
                    around = self._context(cloud, before[number], np.arange(len(cloud.xyz)))
                    read = np.concatenate([read, around], axis=1)
                found[number] = count_shares(forest.predict_proba(read))
        return found

    def _around(self, votes: Votes) -> npt.NDArray[np.float32]:
        """The samples' context; 0 of those of clouds without votes."""
        out = np.zeros((len(self.samples), len(CONTEXT.tokens) * len(self.classes)), np.float32)
        for number, shares in votes.items():
            at, rows = self.samples.of_cloud(number)
            out[at] = self._context(self.clouds[number], shares, rows)
        return out

    def _context(
        self, cloud: TrainingCloud, shares: npt.NDArray[np.uint16], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float32]:
        """(m, columns) of some of a cloud's points."""
        return CONTEXT.columns_of(cloud.xyz, shares)(rows)

    def _training(self, without: int) -> dict[str, Any]:
        """What a model file says of its training."""
        used = [
            cloud for cloud, fold in zip(self.clouds, self.fold_of, strict=True) if fold != without
        ]
        clouds = [{"name": cloud.name, "points": len(cloud.xyz)} for cloud in used]
        samples = int(np.count_nonzero(self.fold != without))
        return {"clouds": clouds, "count": OPTIONS.count, "seed": OPTIONS.seed, "samples": samples}
