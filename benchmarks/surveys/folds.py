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
from lines import labeled_line
from recipe import OPTIONS, strip_of, training_clouds
from surveys import GROUPS, LINE_SURVEY, SURVEYS, TOWER, WIRE

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
#: Strip across the labeled line that is left out with each group of surveys.
STRIP_OF_GROUP = {
    group: strip for strip, group in enumerate(g for g in GROUPS if g != SURVEYS[LINE_SURVEY].group)
}
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
    """The copies of the surveys that are trained on, and models without one part of them."""

    def __init__(self, data: Path, trained: Iterable[str], folder: Path) -> None:
        names = sorted(trained)
        each = {name: training_clouds(data, name) for name in names}
        self.clouds = [cloud for clouds in each.values() for cloud in clouds]
        self.tables = [compute_features(cloud, folder) for cloud in self.clouds]
        labeled = label_classes(self.clouds, OPTIONS)
        self.classes = list(zip(labeled.classes.codes, labeled.classes.names, strict=True))
        self.codes = list(labeled.classes.codes)
        surveys = [cloud.survey for cloud in self.clouds]
        self.samples = draw_samples(
            labeled,
            len(self.classes),
            OPTIONS.count,
            OPTIONS.seed,
            surveys,
            fill_up=OPTIONS.fill_up,
        )
        group_of = np.array([SURVEYS[name].group for name in surveys])
        #: Surveys of one fold are left out together for the votes that a later pass reads, as the
        #: trainer does it.
        self.fold_of = np.array([names.index(name) % VOTE_FOLDS for name in surveys])
        self.group = group_of[self.samples.cloud]
        self.fold = self.fold_of[self.samples.cloud]
        self.values = self.samples.take(self.tables.__getitem__)
        line = labeled_line(data)
        strips = [
            line.strip(cloud.xyz)
            if SURVEYS[name].tells(WIRE)
            else np.full(len(cloud.xyz), strip_of(number))
            for name, clouds in each.items()
            for number, cloud in enumerate(clouds)
        ]
        self.strip_of_tower = line.strip_of_tower
        #: strip of the labeled line that a sample is from, or -1: all but wires and towers
        self.strip = np.where(self._of_line, self.samples.take(strips.__getitem__), -1)
        self.without = cache(self._without)

    @property
    def _of_line(self) -> npt.NDArray[np.bool_]:
        """Which samples are wires and towers."""
        return np.isin(np.array(self.codes)[self.samples.label], (WIRE, TOWER))

    def _without(self, group: str, with_lines: bool = False) -> Model:
        """Return the model of all surveys but those of this group.

        It has not seen one strip across the labeled line either, nor copies of its wires
        (:data:`STRIP_OF_GROUP`), and no tower where that strip holds the only one. Without the
        survey of that line there are no wires, but `with_lines` copies of them in other surveys
        stay.
        """
        kept = self.group != group
        if group in STRIP_OF_GROUP:
            kept &= self.strip != STRIP_OF_GROUP[group]
            if STRIP_OF_GROUP[group] == self.strip_of_tower:
                kept &= np.array(self.codes)[self.samples.label] != TOWER
        elif not with_lines:
            kept &= ~self._of_line
        return self._train(kept)

    def _train(self, kept: npt.NDArray[np.bool_]) -> Model:
        """Return the model of these samples."""
        passes, values = [], self.values
        votes: Votes = {}
        for number in range(OPTIONS.passes):
            if number:
                votes = self._vote(kept, values, votes)
                values = np.concatenate([self.values, self._context_of_samples(votes)], axis=1)
            forest = self._grow(values, kept, OPTIONS.trees)
            passes.append(FeatureForest(FEATURES, forest, CONTEXT if number else None))
        # The shipped model is of the same make; its counts of samples are replaced.
        info = {**copy.deepcopy(load_model("standard").info), "training": self._training(kept)}
        info["passes"] = [{"importances": None}] * len(passes)
        info["lines"] = list(OPTIONS.lines)
        counts = {"available": 0, "samples": 0, "duplicates": 0}
        info["classes"] = [
            {"code": code, "name": name, "labels": [code], **counts} for code, name in self.classes
        ]
        return Model(tuple(passes), self.classes, {**info, "voxel": OPTIONS.voxel})

    def _grow(
        self, values: npt.NDArray[np.float32], kept: npt.NDArray[np.bool_], trees: int
    ) -> Forest:
        # One sample of each class stays, if with weight 0: the forest needs all classes.
        first = np.unique(self.samples.label, return_index=True)[1]
        rows = np.union1d(np.flatnonzero(kept), first)
        weight = np.where(kept, self.samples.weight, 0)[rows]
        values = np.asfortranarray(values[rows])
        return grow_forest(values, self.samples.label[rows], weight, trees, OPTIONS)[0]

    def _vote(
        self, kept: npt.NDArray[np.bool_], values: npt.NDArray[np.float32], before: Votes
    ) -> Votes:
        """Return a pass's votes for the clouds that are trained on, by forests that have seen
        neither what is left out nor the cloud's fold.

        `values` are what the pass reads of the samples, `before` the votes of the pass before it,
        if there is one.
        """
        votes, trees = {}, fold_trees(OPTIONS.trees)
        sampled = np.unique(self.samples.cloud[kept])
        for fold in np.unique(self.fold_of[sampled]).tolist():
            forest = self._grow(values, kept & (self.fold != fold), trees)
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

    def _training(self, kept: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """Return what a model file stores about its training."""
        used = [self.clouds[number] for number in np.unique(self.samples.cloud[kept]).tolist()]
        clouds = [{"name": cloud.name, "points": len(cloud.xyz)} for cloud in used]
        samples = int(np.count_nonzero(kept))
        return {"clouds": clouds, "count": OPTIONS.count, "seed": OPTIONS.seed, "samples": samples}
