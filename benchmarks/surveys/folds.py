"""Models that have not seen one group of the surveys, at little more than the cost of one model.

The features of a point do not depend on who is left out, so they are computed once, for every point
of every copy, and kept in a folder. Each model is trained as the shipped one is: a later pass reads
what forests without the survey (and without the group) say of it.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from recipe import OPTIONS, training_clouds
from surveys import SURVEYS

from pdal_stages import Model, TrainingCloud
from pdal_stages.classifier.context_features import HEIGHT, Context, count_shares
from pdal_stages.classifier.feature_forest import CloudFeatures, FeatureForest, Features
from pdal_stages.classifier.interface import PredictRequest
from pdal_stages.classifier.model import load_model
from pdal_stages.classifier.random_forest import Forest, grow_forest
from pdal_stages.classifier.sampling import draw_samples
from pdal_stages.classifier.train_forest import feature_plan, fold_trees
from pdal_stages.classifier.training_clouds import label_classes

#: Parts of the surveys that are left out in turn for the votes that a later pass reads.
VOTE_FOLDS = 5
FEATURES = Features(feature_plan(OPTIONS))
CONTEXT = Context(tuple(OPTIONS.context))
#: Votes (n, classes) for all points of a cloud, by the cloud's number.
Votes = dict[int, npt.NDArray[np.uint16]]


def compute_features(cloud: TrainingCloud, folder: Path) -> npt.NDArray[np.float32]:
    """Return the first pass's features (n, features) of all points; they are kept in the folder."""
    arrays = [cloud.xyz, *(np.asarray(values) for _, values in sorted(cloud.dimensions.items()))]
    contents = [repr(FEATURES.plan.names).encode(), *(one.tobytes() for one in arrays)]
    path = folder / f"{hashlib.sha256(b''.join(contents)).hexdigest()[:24]}.npy"
    if not path.exists():
        out = np.empty((len(cloud.xyz), len(FEATURES.plan.names)), np.float32)
        request = PredictRequest(cloud.xyz, cloud.dimensions)
        for block in CloudFeatures(FEATURES, request).blocks(None):
            out[block.rows] = block.values
        np.save(path, out)
    return np.load(path, mmap_mode="r")


class GroupsLeftOut:
    """The copies of the surveys that are trained on, and models without one group of them."""

    def __init__(self, data: Path, trained: Iterable[str], folder: Path) -> None:
        names = sorted(trained)
        self.clouds = [cloud for name in names for cloud in training_clouds(data, name)]
        self.tables = [compute_features(cloud, folder) for cloud in self.clouds]
        labeled = label_classes(self.clouds, OPTIONS)
        self.classes = list(zip(labeled.classes.codes, labeled.classes.names, strict=True))
        self.codes = list(labeled.classes.codes)
        surveys = [cloud.survey for cloud in self.clouds]
        self.samples = draw_samples(
            labeled, len(self.classes), OPTIONS.count, OPTIONS.seed, surveys
        )
        self.group_of = np.array([SURVEYS[name].group for name in surveys])
        #: Surveys of one fold are left out together for the votes that a later pass reads, as the
        #: trainer does it.
        self.fold_of = np.array([names.index(name) % VOTE_FOLDS for name in surveys])
        self.group = self.group_of[self.samples.cloud]
        self.fold = self.fold_of[self.samples.cloud]
        self.values = self.samples.take(self.tables.__getitem__)
        self.without = cache(self._train_without)

    def _train_without(self, group: str) -> Model:
        """Return the model of all surveys but those of this group."""
        kept = self.group != group
        passes, values = [], self.values
        votes: Votes = {}
        for number in range(OPTIONS.passes):
            if number:
                votes = self._vote(group, values, votes)
                values = np.concatenate([self.values, self._context_of_samples(votes)], axis=1)
            forest = self._grow(values, kept, OPTIONS.trees)
            passes.append(FeatureForest(FEATURES, forest, CONTEXT if number else None))
        # The shipped model is of the same make; its counts of samples are replaced.
        info = {**copy.deepcopy(load_model("standard").info), "training": self._training(group)}
        info["passes"] = [{"importances": None}] * len(passes)
        return Model(tuple(passes), self.classes, {**info, "voxel": OPTIONS.voxel})

    def _grow(
        self, values: npt.NDArray[np.float32], kept: npt.NDArray[np.bool_], trees: int
    ) -> Forest:
        values = np.asfortranarray(values[kept])
        label, weight = self.samples.label[kept], self.samples.weight[kept]
        return grow_forest(values, label, weight, trees, OPTIONS)[0]

    def _vote(self, group: str, values: npt.NDArray[np.float32], before: Votes) -> Votes:
        """Return a pass's votes for the clouds that are trained on, by forests that have seen
        neither the group nor the cloud's fold.

        `values` are what the pass reads of the samples, `before` the votes of the pass before it,
        if there is one.
        """
        votes, trees = {}, fold_trees(OPTIONS.trees)
        sampled = np.unique(self.samples.cloud[self.group != group])
        for fold in np.unique(self.fold_of[sampled]).tolist():
            forest = self._grow(values, (self.group != group) & (self.fold != fold), trees)
            for number in sampled[self.fold_of[sampled] == fold].tolist():
                read = np.ascontiguousarray(self.tables[number])
                if before:
                    every = np.arange(len(read))
                    context = self._context(number, before[number], every)
                    read = np.concatenate([read, context], axis=1)
                votes[number] = count_shares(forest.predict_proba(read))
        return votes

    def _context_of_samples(self, votes: Votes) -> npt.NDArray[np.float32]:
        """Return the samples' context (samples, columns); 0 for those of clouds without votes."""
        out = np.zeros((len(self.samples), len(CONTEXT.names(self.codes))), np.float32)
        for number, shares in votes.items():
            at, rows = self.samples.of_cloud(number)
            out[at] = self._context(number, shares, rows)
        return out

    def _context(
        self, number: int, shares: npt.NDArray[np.uint16], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float32]:
        """Return the context (m, columns) of some of a cloud's points."""
        cloud = self.clouds[number]
        height = cloud.dimensions[HEIGHT]
        return CONTEXT.cell_means(cloud.xyz, shares, None, self.codes, height).columns(rows)

    def _training(self, without: str) -> dict[str, Any]:
        """Return what a model file stores about its training."""
        used = [
            cloud
            for cloud, group in zip(self.clouds, self.group_of, strict=True)
            if group != without
        ]
        clouds = [{"name": cloud.name, "points": len(cloud.xyz)} for cloud in used]
        samples = int(np.count_nonzero(self.group != without))
        return {"clouds": clouds, "count": OPTIONS.count, "seed": OPTIONS.seed, "samples": samples}
