"""``writers.classifiermodel``: train a classifier on labelled points, write one model file [B16, W18]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import kinds
from ..base.errors import ModelError, StageError
from ..base.files import check_writable
from ..base.outputs import Output
from ..classifier import TrainingCloud, TrainingOptions, summary, train
from ..classifier.algorithms import ALGORITHMS, Trainer, trainer
from ..classifier.classes import ClassMap
from ..classifier.dimensions import ALWAYS, required, welcome
from ..classifier.trainoptions import MOST_PASSES
from ..features.voxels import LARGEST
from .base import Stage, files_read
from .options import option
from .points import Points
from .preparation import check
from .selection import UNWANTED, Selection

#: The trainer's own options.
_TRAINERS = {field.name: field.default for field in fields(TrainingOptions)}
#: The part of a model's description that fits in a pipeline's metadata.
_TOLD = ("strategy", "classes", "accuracy", "parameters")
#: Most files that a model names.
_NAMED = 20
#: The word for the dimensions that follow from what the points have.
AUTO = "auto"


class ClassifierModel(Stage):
    type = "writers.classifiermodel"
    summary = "Train a classifier on the labelled points that reach it, and write one model file"
    source = "[B16] sections 3.3-4.2, [W18] section 4.3, [WM19] for alsnet"
    instead_of_tiles = "Train without --tile: only samples are computed, so memory goes to the points alone"
    where_help = "Samples are drawn from the points inside; all points are neighbors."
    filename: str = option("filename", None, "The model file to write", required=True)
    label: str = option("string", "Classification", "Dimension that holds the labels")
    algorithm: str = option(
        "string",
        "random_forest",
        "A forest on computed features, or a network on the points themselves (needs PyTorch)",
        choices=tuple(ALGORITHMS),
    )
    alsnet: dict | None = option(
        "mapping",
        None,
        'Options of the network: {"configuration": "small", "epochs": 60, ...}; see the page on alsNet',
    )
    neighborhoods: list = option(
        "list",
        _TRAINERS["neighborhoods"],
        "Neighborhoods: tokens (c2, s1, k50, kopt, ropt, copt) or a preset (blomley2016, weinmann2018, he2017)",
    )
    feature_set: list = option(
        "list",
        _TRAINERS["feature_set"],
        "Groups (covariance, geometric, shapes, all) or single features. 'all' is the papers' set",
    )
    dimensions: list = option(
        "list",
        (AUTO,),
        "Dimensions of the points that are used as features too, e.g. HeightAboveGround, Intensity, ReturnRatio, or returns "
        "for all return features; auto: HeightAboveGround and, where the points have them, Ground, HeightAboveOpening_5, "
        "HeightAboveOpening_17 and returns",
        may_be_empty=True,
    )
    classes: dict | None = option(
        "mapping",
        None,
        'Labels and what they become: {"2": "Ground", "3,4,5": "5 Vegetation", "6": 6}, or a list of codes; '
        "default: every label met except 0, 1, 7, 12 and 18",
    )
    strategy: str = option(
        "string",
        "multiclass",
        "All classes at once, or 'target' against all the others",
        choices=("multiclass", "binary"),
    )
    target: int | None = option(
        "integer", None, "Class to find with the binary strategy", minimum=0, maximum=255
    )
    background: int = option(
        "integer", 1, "Code given to all other classes with the binary strategy", minimum=0, maximum=255
    )
    count: int = option(
        "integer",
        _TRAINERS["count"],
        "Samples per class; smaller classes are filled up with duplicates",
        minimum=1,
    )
    seed: int = option(
        "integer", 0, "Seed for sampling, trees and shape distributions", minimum=0, maximum=2**31 - 1
    )
    trees: list = option(
        "list",
        (_TRAINERS["trees"],),
        "Number of trees; of several values the best is found by cross-validation",
    )
    max_depth: list = option(
        "list", (0,), "Maximum depth of the trees, 0 for no limit; of several values the best is found"
    )
    min_samples_leaf: list = option(
        "list",
        (_TRAINERS["min_samples_leaf"],),
        "Minimum number of samples in a leaf; of several values the best is found",
    )
    max_samples: float = option(
        "number",
        _TRAINERS["max_samples"],
        "Share of the samples that each tree draws",
        minimum=0,
        exclusive=True,
        maximum=1,
    )
    max_features: str = option(
        "string",
        _TRAINERS["max_features"],
        "Features tried at each split: auto (a tenth, at least the square root), sqrt, log2, a number or a share",
    )
    prior_weight: float = option(
        "number",
        _TRAINERS["prior_weight"],
        "0: all classes count as equally frequent, as they are sampled; 1: each as frequent as in the training points",
        minimum=0,
        maximum=1,
    )
    folds: int | None = option(
        "integer",
        None,
        "Folds of cross-validation over groups or spatial blocks; 0 for none; default: 5, with a quarter of the trees",
        minimum=0,
    )
    groups: str = option(
        "string",
        "",
        "Dimension whose points of one value are held out together, such as the number of a tile or flight, so that the "
        "score is of tiles or flights that the model has not seen",
    )
    block_size: float = option("number", 25.0, "Side of these blocks", minimum=0, exclusive=True, unit="m")
    survey: str = option(
        "string",
        "",
        "Dimension that tells surveys apart: points of another value are not neighbors, and surveys weigh alike",
    )
    balance: bool = option(
        "boolean",
        _TRAINERS["balance"],
        "Take as many samples of a class from each survey and each thinned copy; false: as many as their share",
    )
    thin: list = option(
        "list",
        _TRAINERS["thin"],
        "Points per square metre of sparser copies to train on as well, so that the model bears sparse clouds",
        may_be_empty=True,
    )
    voxel: float = option(
        "number",
        _TRAINERS["voxel"],
        "Side of voxels: in training and in classifying one point represents each, and the others get its class; 0 for none",
        minimum=0,
        maximum=LARGEST,
        unit="m",
    )
    ignore: Selection = option(
        "selection",
        UNWANTED,
        "Points that are not even neighbors: labels (unless 'classes' names them), ranges of other dimensions such as "
        "ReturnNumber[0:0], or the word withheld",
        may_be_empty=True,
    )
    leave_one_survey_out: bool = option(
        "boolean", False, "Score each survey with forests grown without it; takes a training per survey"
    )
    passes: int = option(
        "integer",
        _TRAINERS["passes"],
        "Forests one after the other, each reading what the one before says of a point's surroundings",
        minimum=1,
        maximum=MOST_PASSES,
    )
    context: list = option(
        "list",
        _TRAINERS["context"],
        "What passes after the first read: own, or box, boxvotes, column, columnvotes and a cell's side (box0.5)",
    )
    pass_folds: int = option(
        "integer",
        _TRAINERS["pass_folds"],
        "Parts of the training ground held out in turn to train the passes after the first",
        minimum=2,
        maximum=100,
    )
    files: list = option("list", (), "Files that the model names; default: those of the readers")
    memory: int = option(
        "integer", 512, "Memory for blocks of points, in addition to the samples", minimum=16, unit="MB"
    )
    details = """
Samples `count` points of each class, spread over space; computes features for the samples only; fits the
percentiles and histogram thresholds; grows a Random Forest; writes [one model file](../model-file.md). A class with
fewer points has them several times, and the counts are in the file. Lists in `trees`, `max_depth` and
`min_samples_leaf` are searched by cross-validation over spatial blocks, so that neighbors never stand on both
sides. Where there is nothing to search, a quarter of the trees is cross-validated all the same, for the score alone
(`folds` 0: not). With `groups`, points of one tile or flight are held out together instead of blocks; `pdal-stages
train` holds out each of several files. With `passes` 2, a second forest also reads the first one's [probabilities all
around a point](../model-file.md#context), and is trained on what they are on ground the first has not seen. With
`"algorithm": "alsnet"` a network is trained instead, from `dimensions`, `classes`, `strategy`, `seed` and the options
in `alsnet` ([alsNet](../alsnet.md)). Points of several readers are merged first. `label` names the dimension that
holds the classes.
"""
    before = ({"type": "filters.hag_minima"},)
    after = ()
    example = {
        "type": "writers.classifiermodel",
        "filename": "town.model",
        "classes": {"2": "Ground", "5": "High vegetation", "6": "Building"},
        "count": 10000,
    }

    def __init__(self, given: Mapping[str, Any], place: str | None = None) -> None:
        given = dict(given)
        classes, share = given.get("classes"), given.get("max_features")
        if isinstance(classes, list | str) and not str(classes).lstrip().startswith("{"):
            # A list of codes is as good as a mapping.
            codes = (
                classes if isinstance(classes, list) else [c.strip() for c in classes.split(",") if c.strip()]
            )
            given["classes"] = {str(c): _number(c) for c in codes}
        if isinstance(share, int | float) and not isinstance(share, bool):
            given["max_features"] = str(share)
        self._preparation: list[dict[str, Any]] = []
        self._by_hand: list[str] = []
        super().__init__(given, place)

    @classmethod
    def from_pipeline(cls, given: Mapping[str, Any], before: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        return {"files": files_read(before)}

    def follows(self, preparation: list[dict[str, Any]]) -> str | None:
        self._preparation, self._by_hand = [], []
        try:
            self._preparation = check(preparation)
        except ModelError as error:
            self._by_hand = [str(stage["type"]) for stage in preparation]
            return (
                f"{self.type}: the model will not hold the stages before it, so `classify` cannot run them by itself: "
                f"{error.what}{f' (found {error.found})' if error.found is not None else ''}. Write a pipeline with "
                f"the same stages, {', '.join(self._by_hand)}, before filters.modelclassifier"
            )
        return None

    @cached_property
    def training(self) -> TrainingOptions:
        """The trainer's options."""
        values = {name: value for name, value in self.options.items() if name in _TRAINERS}
        for name in ("trees", "max_depth", "min_samples_leaf"):
            numbers = [int(v) if str(v).strip().lstrip("-").isdigit() else v for v in values[name]]
            values[name] = numbers[0] if len(numbers) == 1 else numbers
        values["max_features"] = _number(values["max_features"])
        if self.automatic:
            values["dimensions"] = ALWAYS
        values["ignore"] = self.ignore.codes
        values["thin"] = [_number(v) if isinstance(v, str) else v for v in values["thin"]]
        return TrainingOptions(**values, memory_mb=self.memory)

    @property
    def _trainer(self) -> Trainer:
        return trainer(self.algorithm)

    @property
    def automatic(self) -> bool:
        """Whether the dimensions follow from what the points have."""
        return list(self.dimensions) == [AUTO]

    @property
    def wished(self) -> tuple[str, ...]:
        """Dimensions worth making for the training, whether asked for or not."""
        names = required(self.training.inputs)
        return (*names, *self._trainer.optional_inputs) if self.automatic else names

    def _training_on(self, points: Points) -> TrainingOptions:
        """The trainer's options, with the dimensions that the points have."""
        if not self.automatic:
            return self.training

        optional = self._trainer.optional_inputs
        there = [name for name, needs in optional.items() if all(one in points.arrays for one in needs)]
        return replace(self.training, dimensions=(*ALWAYS, *there))

    def check(self) -> None:
        self.training.inputs  # noqa: B018  words that mean nothing are refused
        if self.training.classes is not None:
            ClassMap.parse(self.training.classes)
        for output in self.outputs():
            check_writable(output.path, output.what, output.kind)

    def outputs(self) -> list[Output]:
        return [Output(self.filename, "model", kinds.MODEL), *self._trainer.outputs(self.training)]

    def reads(self) -> list[str]:
        own = [name for name in (self.survey, self.groups) if name]
        return [self.label, *own, *required(self.training.inputs)]

    def run(self, points: Points) -> dict[str, NDArray]:
        if points.count == 0:
            raise StageError(
                "there are no points to train on",
                cure="Check the reader's file and the filters before this stage",
            )
        training = self._training_on(points)
        cloud = TrainingCloud(
            xyz=points.xyz,
            labels=points.codes_of(self.label),
            dimensions={
                name: points.dimension(name)
                for name in required((*training.inputs, *filter(None, [self.groups])))
            }
            | {name: points.arrays[name] for name in welcome(training.inputs) if name in points.arrays},
            name=", ".join(Path(name).name for name in self.files[:_NAMED])
            + ", ..." * (len(self.files) > _NAMED)
            or "the points",
            mask=points.mask,
        )
        gone = points.ignored(replace(self.ignore, codes=()))  # the labels among them are left to the trainer
        if gone.any():
            cloud = cloud.part(np.flatnonzero(~gone))
        model = train(self._surveys(cloud, points), training)
        model.info["preparation"] = self._preparation
        if self._by_hand:
            model.info["by_hand"] = self._by_hand
        model.save(self.filename)
        told = {key: model.info[key] for key in _TOLD if key in model.info}
        points.report.update({"model": self.filename, **told, "seconds": model.seconds})
        if scores := summary.scores(model.info):
            points.report["score"] = scores[0]
        crossed = model.info["accuracy"]["cross_validation"] or {}
        if "instead" in crossed:
            points.report["note"] = (
                f"blocks are held out, not {summary.groups_word(self.groups)}: {crossed['instead']}"
            )
        if self._trainer.reports_training:
            points.report["training"] = model.info["training"]
        return {}

    def _surveys(self, cloud: TrainingCloud, points: Points) -> list[TrainingCloud]:
        """The points as one cloud, or one for each value of the dimension `survey`."""
        if not self.survey:
            return [cloud]
        value = points.dimension(self.survey)
        parts = [(one, cloud.part(np.flatnonzero(value == one))) for one in np.unique(value)]
        return [replace(part, name=f"{self.survey} {one:g}", survey=None) for one, part in parts]


def _number(text: Any) -> Any:
    """``0.1`` as a share, ``24`` as a number of features or a class, all else as it is."""
    for kind in (int, float):
        try:
            return kind(text)
        except (TypeError, ValueError):
            continue
    return text
