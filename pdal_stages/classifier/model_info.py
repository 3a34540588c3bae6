"""What a model file says of its model: the entries of its manifest, by ``model.json``.

The reader checks files against that schema, so that entries that it requires are there.
"""

from __future__ import annotations

from typing import TypedDict

from ..base.json_types import JsonObject, StageJson
from .training_percentiles import PercentileTable


class PassScores(TypedDict, total=False):
    """Entries on a classifier that it does not need itself to classify."""

    importances: list[float] | None  #: of its inputs; None of a network
    percentiles: PercentileTable
    codes: list[int]  #: its classes, where they are not those of the model
    factors: list[float] | None  #: of their probabilities


class Priors(TypedDict):
    """Factors of the classes' probabilities (``prior_weight``)."""

    weight: float
    factors: list[float]


class SampleCounts(TypedDict):
    """Points of a class: those there are, different ones drawn, and those drawn once more."""

    available: int
    samples: int
    duplicates: int


class ClassInfo(SampleCounts):
    """A class of a model, and the points that it was trained on."""

    code: int
    name: str
    labels: list[int]  #: codes of the training points that count as this class


class DensityRange(TypedDict):
    """Densities that a model was trained at, points/m2."""

    low: float
    high: float


class BaseInfo(TypedDict):
    """The model that another one was trained on top of."""

    name: str
    sha256: str


class ModelInfo(TypedDict, total=False):
    """A model, its training and its accuracy.

    What made the training data is known once the training stage has it.
    """

    preparation: list[StageJson]
    algorithms: dict[str, int]  #: versions of what computed the training data, by stage
    by_hand: list[str]
    passes: list[PassScores]
    base: BaseInfo
    strategy: str
    target: int | None
    background: int | None
    classes: list[ClassInfo]
    training: JsonObject
    priors: Priors | None
    lines: list[int]
    sureness: JsonObject
    voxel: float
    densities: DensityRange
    accuracy: JsonObject
    created_by: dict[str, str]
