"""``writers.classifiermodel``: train a classifier on labelled points, write one model file [B16, W18]."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import check_writable
from ..classifier import TrainingCloud, TrainingOptions, train
from .base import Stage
from .options import Option
from .points import Points

#: Options of this stage that are not the trainer's.
_OWN = {"filename", "label", "where", "threads", "memory", "horizontal_unit", "vertical_unit"}


def _default(name: str) -> Any:
    """The trainer's own default."""
    return TrainingOptions.__dataclass_fields__[name].default


class ClassifierModel(Stage):
    type = "writers.classifiermodel"
    summary = "Train a classifier on the labelled points that reach it, and write one model file"
    source = "[B16] sections 3.3-4.2, [W18] section 4.3, [WM19] for alsnet"
    where_help = "Samples are drawn from the points inside; all points are neighbors."
    options = (
        Option("filename", "filename", None, "The model file to write", required=True),
        Option("label", "string", "Classification", "Dimension that holds the labels"),
        Option(
            "algorithm",
            "string",
            "random_forest",
            "A forest on computed features, or a network on the points themselves (needs PyTorch)",
            choices=("random_forest", "alsnet"),
        ),
        Option(
            "alsnet",
            "mapping",
            None,
            'Options of the network: {"configuration": "small", "epochs": 60, ...}; see the page on alsNet',
        ),
        Option(
            "neighborhoods",
            "list",
            ("weinmann2018",),
            "Neighborhoods: tokens (c2, s1, k50, kopt, ropt, copt) or a preset (blomley2016, weinmann2018, he2017)",
        ),
        Option(
            "feature_set",
            "list",
            _default("feature_set"),
            "Groups (covariance, geometric, shapes, all) or single features. 'all' is the papers' set",
        ),
        Option(
            "dimensions",
            "list",
            ("HeightAboveGround",),
            "Dimensions of the points used as features too (Intensity, ReturnNumber, NumberOfReturns, ReturnRatio)",
            may_be_empty=True,
        ),
        Option(
            "classes",
            "mapping",
            None,
            'Labels and what they become: {"2": "Ground", "3,4,5": "5 Vegetation", "6": 6}, or a list of codes; '
            "default: every label met except 0, 1, 7, 12 and 18",
        ),
        Option(
            "strategy",
            "string",
            "multiclass",
            "All classes at once, or 'target' against all others",
            choices=("multiclass", "binary"),
        ),
        Option("target", "integer", None, "Class to find with the binary strategy", minimum=0, maximum=255),
        Option("background", "integer", 1, "Code of all other classes with it", minimum=0, maximum=255),
        Option(
            "count",
            "integer",
            _default("count"),
            "Samples of each class; smaller classes are duplicated",
            minimum=1,
        ),
        Option(
            "seed",
            "integer",
            0,
            "Seed of sampling, trees and shape distributions",
            minimum=0,
            maximum=2**31 - 1,
        ),
        Option(
            "trees",
            "list",
            (_default("trees"),),
            "Number of trees; several values are searched by cross-validation",
        ),
        Option("max_depth", "list", (0,), "Depth of trees, 0 for no limit; several values are searched"),
        Option(
            "min_samples_leaf",
            "list",
            (_default("min_samples_leaf"),),
            "Samples a leaf must have; several values are searched",
        ),
        Option(
            "max_samples",
            "number",
            _default("max_samples"),
            "Share of the samples each tree draws",
            minimum=0,
            exclusive=True,
            maximum=1,
        ),
        Option(
            "max_features",
            "string",
            _default("max_features"),
            "Features tried at a split: auto (a tenth, at least the square root), sqrt, log2, a number or a share",
        ),
        Option(
            "prior_weight",
            "number",
            _default("prior_weight"),
            "0: all classes count as equally frequent, as they are sampled; 1: as frequent as in the training points",
            minimum=0,
            maximum=1,
        ),
        Option("folds", "integer", 0, "Folds of cross-validation over spatial blocks; 0 for none", minimum=0),
        Option("block_size", "number", 25.0, "Side of those blocks", minimum=0, exclusive=True, unit="m"),
        Option(
            "memory", "integer", 512, "Memory for blocks of points, over the samples", minimum=16, unit="MB"
        ),
    )
    details = """
Samples `count` points of each class, spread over space; computes features for the samples only; fits the
percentiles and histogram thresholds; grows a Random Forest; writes [one model file](../model-file.md). A class with
fewer points has them several times, and the counts are in the file. Lists in `trees`, `max_depth` and
`min_samples_leaf` are searched by cross-validation over spatial blocks, so that neighbors never stand on both
sides. With `"algorithm": "alsnet"` a network is trained instead, from `dimensions`, `classes`,
`strategy`, `seed` and the options in `alsnet` ([alsNet](../alsnet.md)). Points of several readers are
merged first. `label` names the dimension that holds the classes.
"""
    before = ({"type": "filters.hag_minima"},)
    after = ()
    example = {
        "type": "writers.classifiermodel",
        "filename": "town.model",
        "classes": {"2": "Ground", "5": "High vegetation", "6": "Building"},
        "count": 10000,
    }

    @classmethod
    def parse(cls, given, where=None):
        # A list of codes is as good as a mapping.
        classes = given.get("classes")
        if isinstance(classes, list | str) and not str(classes).lstrip().startswith("{"):
            codes = (
                classes if isinstance(classes, list) else [c.strip() for c in classes.split(",") if c.strip()]
            )
            given = {**given, "classes": {str(c): _code(c) for c in codes}}
        share = given.get("max_features")
        if isinstance(share, int | float) and not isinstance(share, bool):
            given = {**given, "max_features": str(share)}
        return super().parse(given, where)

    @classmethod
    def training_options(cls, options: dict[str, Any]) -> TrainingOptions:
        """The trainer's options."""
        values = {name: value for name, value in options.items() if name not in _OWN}
        for name in ("trees", "max_depth", "min_samples_leaf"):
            numbers = [int(v) if str(v).strip().lstrip("-").isdigit() else v for v in values[name]]
            values[name] = numbers[0] if len(numbers) == 1 else numbers
        values["max_features"] = _number(values["max_features"])
        return TrainingOptions(**values, threads=options["threads"], memory_mb=options["memory"])

    @classmethod
    def check(cls, options: dict[str, Any]) -> None:
        from ..classifier.classes import ClassMap
        from ..features import FeaturePlan

        training = cls.training_options(options)
        if training.algorithm == "alsnet":
            cls._plan_dimensions(options)
            if training.alsnet.checkpoint:
                check_writable(training.alsnet.checkpoint, "checkpoint")
        else:
            FeaturePlan.parse(
                training.neighborhoods, feature_set=training.feature_set, dimensions=training.dimensions
            )
        if training.classes is not None:
            ClassMap.parse(training.classes)
        check_writable(options["filename"], "model")

    @classmethod
    def reads(cls, options: dict[str, Any]) -> list[str]:
        from ..classifier.dimensions import required

        return [options["label"], *required(cls._plan_dimensions(options))]

    @classmethod
    def _plan_dimensions(cls, options: dict[str, Any]) -> tuple[str, ...]:
        from ..features import FeaturePlan

        training = cls.training_options(options)
        if training.algorithm == "alsnet":
            from ..alsnet.networkmodel import input_names

            return input_names(training.alsnet.coordinates, training.dimensions)
        plan = FeaturePlan.parse(
            training.neighborhoods, feature_set=training.feature_set, dimensions=training.dimensions
        )
        return plan.dimensions

    @classmethod
    def run(cls, points: Points, options: dict[str, Any]) -> dict[str, NDArray]:
        if points.count == 0:
            raise StageError(
                "there are no points to train on",
                cure="Check the reader's file and the filters before this stage",
            )
        needed = cls.reads(options)[1:]
        cloud = TrainingCloud(
            xyz=points.xyz,
            labels=points.codes_of(options["label"]),
            dimensions={name: points.dimension(name) for name in needed},
            name="the points",
            mask=points.mask,
        )
        model = train([cloud], cls.training_options(options))
        model.save(options["filename"])
        points.report.update({"model": options["filename"], **_brief(model.info), "seconds": model.seconds})
        if options["algorithm"] == "alsnet":  # with the curve
            points.report["training"] = _plain(model.info["training"])
        return {}


def _code(label: Any) -> Any:
    try:
        return int(label)
    except (TypeError, ValueError):
        return label


def _number(text: str) -> Any:
    """``0.1`` as a share, ``24`` as a number of features, words as they are."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _brief(info: dict[str, Any]) -> dict[str, Any]:
    """The part of a model's description that fits in a pipeline's metadata."""
    keep = ("strategy", "classes", "accuracy", "parameters")
    return {key: _plain(info[key]) for key in keep if key in info}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
