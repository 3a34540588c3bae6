"""Models that miss one survey each, at little more than the cost of one.

What is computed of the points does not depend on who is left out, so it is computed once, for every point of every copy, and
kept in a folder. The surroundings that the second pass reads of survey B where A is left out come from a forest grown
without both, which serves where B is left out and A is read, too.
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

from pdal_stages.classifier import FeatureForest, Forest, Model, TrainingCloud
from pdal_stages.classifier.algorithms import PredictRequest
from pdal_stages.classifier.clouds import label_classes
from pdal_stages.classifier.context import Context
from pdal_stages.classifier.featureforest import CloudFeatures, Features
from pdal_stages.classifier.foresttraining import FOLD_TREES, feature_plan
from pdal_stages.classifier.growing import TreeOptions, grow
from pdal_stages.classifier.sampling import draw_samples
from pdal_stages.classifier.smoothing import count_shares
from pdal_stages.classifier.trees import Ranked
from pdal_stages.stages.loading import load_model

#: Of a forest of a model that misses a survey, by default: what the card's and the review's figures are of.
TREES = 20
FEATURES = Features(feature_plan(OPTIONS))
CONTEXT = Context(tuple(OPTIONS.context))


def features_of(cloud: TrainingCloud) -> npt.NDArray[np.float32]:
    """What the first pass reads of all points, (n, features)."""
    out = np.empty((len(cloud.xyz), len(FEATURES.plan.names)), np.float32)
    request = PredictRequest(cloud.xyz, cloud.dimensions)
    for rows, values in CloudFeatures(FEATURES, request).blocks(None, lambda values, rows: values):
        out[rows] = values
    return out


class LeaveOneOut:
    """The copies of all surveys, and models of so many trees a pass without one of these."""

    def __init__(self, data: Path, surveys: Iterable[str], folder: Path, trees: int = TREES) -> None:
        self.trees = trees
        self.names = sorted(surveys)
        self.clouds: list[TrainingCloud] = []
        self.tables: list[npt.NDArray[np.float32]] = []
        for name in self.names:
            for cloud in training_clouds(data, name):
                path = folder / f"{len(self.clouds)}.npy"
                np.save(path, features_of(cloud))
                self.clouds.append(cloud)
                self.tables.append(np.load(path, mmap_mode="r"))
        labeled = label_classes(self.clouds, OPTIONS)
        self.classes = list(zip(labeled.classes.codes, labeled.classes.names, strict=True))
        of = [cloud.flight for cloud in self.clouds]
        self.samples = draw_samples(labeled, len(self.classes), OPTIONS.count, OPTIONS.seed, of)
        self.survey = np.array([self.names.index(name) for name in of])[self.samples.cloud]
        self.ranked = Ranked.of(self.samples.take(self.tables.__getitem__))
        self._pair = cache(self._grown_without)

    def _grow(self, ranked: Ranked, kept: npt.NDArray[np.bool_], trees: int) -> Forest:
        setting = TreeOptions(None, OPTIONS.min_samples_leaf, OPTIONS.max_samples, OPTIONS.max_features)
        weight = self.samples.weight * kept
        grown = grow(ranked, self.samples.label, weight, trees, setting, OPTIONS.seed)
        return Forest.from_trees([tree for tree, _, _ in grown], ranked.columns)

    def _grown_without(self, one: int, other: int) -> Forest:
        kept = (self.survey != one) & (self.survey != other)
        return self._grow(self.ranked, kept, max(1, round(FOLD_TREES * self.trees)))

    def without(self, name: str) -> Model:
        """The model of all surveys but this one."""
        left = self.names.index(name)
        kept = self.survey != left
        first = self._grow(self.ranked, kept, self.trees)
        around = np.zeros((len(self.samples), len(CONTEXT.tokens) * len(self.classes)), np.float32)
        for number, (cloud, table) in enumerate(zip(self.clouds, self.tables, strict=True)):
            at, rows = self.samples.of_cloud(number)
            if not len(at) or cloud.flight == name:
                continue
            forest = self._pair(*sorted((left, self.names.index(cloud.flight))))
            part = np.empty((len(at), around.shape[1]), np.float32)
            shares = count_shares(forest.predict_proba(np.ascontiguousarray(table)))
            CONTEXT.tables(cloud.xyz, shares).fill(rows, part)
            around[at] = part
        both = self.ranked.beside(Ranked.of(around))
        second = self._grow(both, kept, self.trees)
        passes = FeatureForest(FEATURES, first), FeatureForest(FEATURES, second, CONTEXT)
        # What is known of the shipped model, which is of the same make, but for what is known of its samples.
        info = {**copy.deepcopy(load_model("standard").info), "training": self._training(name)}
        for one, ranked in zip(info["passes"], (self.ranked, both), strict=True):
            low, high = ranked.limits(0)
            one.update(percentiles={"low": low, "high": high, "limited": False}, importances=None)
        return Model(passes, self.classes, {**info, "voxel": OPTIONS.voxel})

    def _training(self, without: str) -> dict[str, Any]:
        """What a model file says of its training."""
        clouds = [{"name": c.name, "points": len(c.xyz)} for c in self.clouds if c.flight != without]
        samples = int(np.count_nonzero(self.survey != self.names.index(without)))
        return {"clouds": clouds, "count": OPTIONS.count, "seed": OPTIONS.seed, "samples": samples}
