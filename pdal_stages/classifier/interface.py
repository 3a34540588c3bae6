"""Interface of all kinds of classifiers: their request and results, and how they are registered.

Imports only go downward, so this room cannot import the network or the stages of pipelines. Such a
room registers itself in its ``__init__``, which the package's own ``__init__`` imports; another
package by an entry point. A kind imports its modules when it is first needed, so that a forest is
applied without the network's modules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Report
from ..base.progress import Progress

if TYPE_CHECKING:  # they take long to import
    from ..features.plan import FeaturePlan
    from ..features.point_grid import CellGrid
    from .context_features import Context

#: The kind of a forest on features.
FOREST = "random_forest"
#: The kind of a forest on features that refines the passes of another model.
REFINED_FOREST = "refined_forest"


class ArrayRule(NamedTuple):
    """Type and axes of an array in a model file."""

    dtypes: tuple[str, ...]  #: allowed types, as NumPy writes them: ``<f4``
    ndim: int  #: number of axes


@dataclass(frozen=True)
class InputPlan:
    """Inputs of a classifier that has no :class:`FeaturePlan`."""

    names: tuple[str, ...]  #: its inputs, in order
    dimensions: tuple[str, ...]  #: which of them are dimensions of the points
    halo_m: float  #: meters around a tile whose points the tile's results depend on


class PassInputs(NamedTuple):
    """The inputs of some points that a pass read, and the probabilities that it gave them."""

    number: int  #: of the pass, from 0
    rows: npt.NDArray[np.int64]  #: (b,) rows in the cloud
    xyz: npt.NDArray[np.float64]  #: (b, 3) of the points that are computed for these, in meters
    values: npt.NDArray[np.float32]  #: (b, inputs)
    probabilities: npt.NDArray[np.float64]  #: (b, classes) before any factors


#: Receives what passes read.
Observe = Callable[[PassInputs], None]


class ClassStep(Enum):
    """Steps in which classified points get their class, in this order."""

    LIKELIEST = 1  #: of classes of lines none, where a point can be anything else
    GIVEN_GROUND = 2  #: what is too far from given ground gets its second class
    LINES = 3  #: what lies on a line gets the class of lines
    SURENESS = 4  #: what is not sure enough loses its class
    HEIGHTS = 5  #: low and medium vegetation


class ModelObserver:
    """Receives how points of a cloud come to their class; what it does not override is dropped."""

    def see_inputs(self, inputs: PassInputs) -> None:
        """Receive what a pass read of points to classify."""

    def see_classes(
        self,
        step: ClassStep,
        codes: npt.NDArray[np.uint8],
        least: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Receive the classes (n,) after a step, and the least reliability (n,) that keeps them."""

    def see_lines(self, probability: npt.NDArray[np.float32], codes: npt.NDArray[np.uint8]) -> None:
        """Receive the probability (n,) of classes of lines, before lines are found, and the class.

        Both are 0 of points that are no candidates.
        """


@dataclass(frozen=True, eq=False)
class PredictRequest:
    """A cloud, and the points of it that are to be classified."""

    xyz: npt.NDArray[np.float64]  #: (n, 3) meters
    dimensions: Mapping[str, npt.ArrayLike]  #: name to (n,) values
    #: (m,) points wanted, ascending; None for all; the others are neighbors
    rows: npt.NDArray[np.int64] | None = None
    threads: int | None = None
    memory_mb: float = 256.0  #: for work under way
    progress: Progress | None = None  #: is told of the points done
    grid: CellGrid | None = None  #: the index of the cloud, which lies in its order
    device: str = "cpu"  #: where a network is applied
    #: receives what passes that read features read of each block
    observe: Observe | None = None
    #: what is counted, complete when all blocks are read
    report: Report = field(default_factory=Report)

    @property
    def count(self) -> int:
        """Points wanted."""
        return len(self.xyz) if self.rows is None else len(self.rows)


class Block(NamedTuple):
    """Probabilities of some points."""

    rows: npt.NDArray[np.int64]  #: (b,) rows in the request's cloud
    probabilities: npt.NDArray[np.float64]  #: (b, classes)
    #: (b,) variance of a class's probability over a network's batches, mean over the classes
    variance: npt.NDArray[np.float64] | None = None


def weigh(
    p: npt.NDArray[np.float64], factors: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.float64]:
    """Multiply the probabilities (b, classes) of each class by its factor; None changes nothing."""
    if factors is None:
        return p
    p = p * factors
    p /= p.sum(axis=1, keepdims=True)
    return p


class Estimator(Protocol):
    """One pass of a model: what a forest, a refined forest, a network and others fulfil.

    One that reads features and context is a :class:`.feature_forest.FeatureEstimator`; one that
    reads the points themselves a :class:`PointEstimator`.
    """

    @property
    def name(self) -> str:
        """The kind, as a manifest has it."""

    @property
    def plan(self) -> FeaturePlan | InputPlan:
        """The inputs that it reads of the points."""

    @property
    def context(self) -> Context | None:
        """The context features that it reads of the pass before; None of the first pass."""

    def arrays(self) -> Mapping[str, npt.NDArray]:
        """Return the arrays that a model file stores."""

    def to_file(self, codes: Sequence[int]) -> JsonObject:
        """Return what a manifest says of it beside its arrays, where its classes are `codes`."""


@runtime_checkable
class PointEstimator(Estimator, Protocol):
    """An estimator that reads the points themselves: it is the only pass of its model."""

    def predict(self, request: PredictRequest) -> Iterator[Block]:
        """Yield blocks of probabilities, with each row wanted once."""


@runtime_checkable
class BatchEstimator(PointEstimator, Protocol):
    """An estimator that looks at parts of a cloud, one at once."""

    def batches(
        self, xyz: npt.NDArray[np.float64]
    ) -> Iterator[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]]:
        """Yield center (2,) and rows (k,) of each part of points (n, 3), in meters."""


class Trainer(Protocol):
    """Trains one kind; `options` are :class:`.training_options.TrainingOptions`."""

    @property
    def optional_inputs(self) -> Mapping[str, Sequence[str]]:
        """Dimensions used where the points have them, each with those that it is computed from."""

    def own_options(self, options: Any) -> Any:
        """Return the checked options that only this kind has, or None."""

    def inputs(self, options: Any) -> tuple[str, ...]:
        """Return the dimensions that the estimator will read."""

    def train(self, clouds: Any, options: Any, progress: bool) -> Any:
        """Return a ``Model``, trained on clouds that are prepared."""


class EstimatorKind(Protocol):
    """A kind of estimator. Its modules are imported when it is used."""

    @property
    def rules(self) -> Mapping[str, ArrayRule]:
        """The arrays of a model file; a name that ends in ``*`` stands for many."""

    @property
    def trainer(self) -> Trainer:
        """The trainer of this kind."""

    def from_file(
        self, entry: JsonObject, arrays: Mapping[str, npt.NDArray], codes: Sequence[int]
    ) -> Estimator:
        """Return the estimator that a pass of a manifest describes, with classes `codes`.

        ModelError where the entry contradicts itself.
        """


class Preprocessing(Protocol):
    """Knows the stages that compute a model's dimensions (``preparation``)."""

    def check(self, preparation: Sequence[StageJson]) -> list[StageJson]:
        """Return the stages in one spelling; ModelError for one that no model may have."""

    def algorithm_versions(self, preparation: Iterable[StageJson]) -> dict[str, int]:
        """Return the version of each stage's algorithm in this release."""

    def preparation_of(self, names: Iterable[str]) -> list[StageJson]:
        """Return the stages that compute these dimensions, as far as they are heights."""

    def made_of_coordinates(
        self,
        preparation: Sequence[StageJson],
        xyz: npt.NDArray[np.float64],
        usable: npt.NDArray[np.bool_] | None = None,
        threads: int | None = None,
        classes: npt.NDArray[np.uint8] | None = None,
    ) -> dict[str, npt.NDArray]:
        """Return the dimensions (n,) that the stages compute from coordinates (n, 3) in meters."""


#: The kinds by the name that manifests and the option ``algorithm`` use.
KINDS: dict[str, EstimatorKind] = {}
#: Entry points by which other packages register kinds: name -> ``module:KIND``.
ENTRY_POINTS = "pdal_stages.kinds"
_preprocessing: list[Callable[[], Preprocessing]] = []


def register_preprocessing(load: Callable[[], Preprocessing]) -> None:
    """Register what knows the stages, a room above this one."""
    _preprocessing.append(load)


def kinds() -> Mapping[str, EstimatorKind]:
    """Return all kinds that can be trained, those of other packages included."""
    return {**_kinds_of_other_packages(), **KINDS}


@cache
def _kinds_of_other_packages() -> dict[str, EstimatorKind]:
    entries = metadata.entry_points(group=ENTRY_POINTS)
    return {entry.name: entry.load() for entry in entries if entry.name not in KINDS}


def classifier_of(name: str) -> EstimatorKind:
    """Return a kind; ModelError for one that this release does not have."""
    kind = FOREST if name == REFINED_FOREST else name
    if (known := KINDS.get(kind) or kinds().get(kind)) is None:
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    return known


def trainer_of(name: str) -> Trainer:
    """Return what trains a kind, one of :func:`kinds`."""
    return (KINDS.get(name) or kinds()[name]).trainer


def preprocessing() -> Preprocessing:
    """Return what was registered."""
    return _preprocessing[-1]()
