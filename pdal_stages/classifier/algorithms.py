"""What a classifier of clouds is, whatever is inside: one interface, and the names under which kinds are known."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.outputs import Output
from ..base.report import Report
from ..features import FeaturePlan
from ..features.index import CellGrid

#: Each kind by its word in manifests and options: its Algorithm and its Trainer, imported when asked for.
ALGORITHMS = {
    "random_forest": (
        "pdal_stages.classifier.featureforest:FeatureForest",
        "pdal_stages.classifier.foresttraining",
    ),
    "alsnet": ("pdal_stages.alsnet.algorithm:AlsNet", "pdal_stages.alsnet.training"),
}


#: Passes that training makes by itself, on top of others.
ON_TOP = {"refined_forest": "pdal_stages.classifier.refinement:RefinedForest"}


@dataclass(frozen=True)
class ArrayRule:
    """What an algorithm expects of one of its arrays."""

    dtypes: tuple[str, ...]  #: allowed types, as NumPy writes them: ``<f4``
    ndim: int  #: number of axes


@dataclass(frozen=True)
class InputPlan:
    """What a classifier looks at, where a :class:`FeaturePlan` does not say it."""

    names: tuple[str, ...]  #: its inputs, in order
    dimensions: tuple[str, ...]  #: which of them are dimensions of the points
    halo_m: float  #: meters around a tile whose points the tile's results depend on
    #: the most a point is asked for, where their number decides how far away they are
    most_neighbors: int = 0
    #: the most that these are asked for in turn
    second_neighbors: int = 0


class Column(NamedTuple):
    """An input for people: its name, the feature it belongs to, that feature's group, and its neighborhood."""

    name: str
    feature: str
    group: str
    neighborhood: str


@dataclass(frozen=True, eq=False)
class PredictRequest:
    """A cloud, and the points of it that are to be classified."""

    xyz: npt.NDArray[np.float64]  #: (n, 3) meters
    dimensions: Mapping[str, npt.ArrayLike]  #: name to (n,) values
    #: (m,) points wanted, ascending; None for all; the others are neighbors
    rows: npt.NDArray[np.int64] | None = None
    threads: int | None = None
    memory_mb: float = 512.0  #: for work under way
    progress: Any = None  #: its ``update`` is called with the points done
    grid: CellGrid | None = None  #: the index of the cloud, which lies in its order

    @property
    def count(self) -> int:
        """Points wanted."""
        return len(self.xyz) if self.rows is None else len(self.rows)


class Block(NamedTuple):
    """Some of the points wanted.

    `rows` index the cloud, `result` is what the asker's function made of their probabilities, `variance` is the
    (b,) variance of a class's probability where the algorithm has one.
    """

    rows: Any
    result: Any
    variance: npt.NDArray[np.floating] | None = None


@dataclass(eq=False)
class PredictResult:
    """Blocks that hold every point wanted once, and what was counted, complete when all blocks are read."""

    blocks: Iterable[Block]
    report: Report = field(default_factory=Report)


class Algorithm(Protocol):
    """A trained classifier of clouds."""

    name: ClassVar[str]  #: the word in the manifest
    #: of a model file's arrays; a name that ends in ``*`` stands for many
    rules: ClassVar[Mapping[str, ArrayRule]]
    gives_variance: ClassVar[bool]  #: whether its blocks have a variance
    #: what it computes of the points, which a next pass may share; None where it has its own way
    features: Any

    @property
    def plan(self) -> FeaturePlan | InputPlan: ...

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> Any:
        """Made from what a model file says of a pass, everything checked; `codes` are the classes."""

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays: what the schema asks of a pass, but for its scores."""

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays a model file stores."""

    def columns(self, codes: Sequence[int]) -> Sequence[Column]:
        """Its inputs, for people."""

    def predict(
        self, request: PredictRequest, finish: Callable[[npt.NDArray[np.float64]], Any]
    ) -> PredictResult:
        """Classify.

        Parameters
        ----------
        request : PredictRequest
        finish : function
            Called with the (b, classes) float64 probabilities of a block, which it may change, in a worker's
            thread where there are any; its result stands in the block.
        """


class Trainer(Protocol):
    """How a kind is trained: a module with these functions.

    It says itself what it needs and gives: the rooms above ask it, and know no kind by its name.

    `options` are ``TrainingOptions``, `clouds` ``TrainingCloud``s, and what comes out is a ``Model``: all of them rooms
    that stand on this one.
    """

    #: inputs used too where the user names none, and the dimensions that the points must have for each
    optional_inputs: Mapping[str, tuple[str, ...]]
    #: whether the record of its training, such as a curve, belongs into a run's report
    reports_training: bool

    def own_options(self, given: Any) -> Any:
        """The kind's own options, checked; None where it has none."""

    def inputs(self, options: Any) -> tuple[str, ...]:
        """Dimensions it uses as inputs, X, Y and Z among them."""

    def outputs(self, options: Any) -> list[Output]:
        """Files it writes beside the model."""

    def train(self, clouds: Sequence[Any], options: Any, progress: bool) -> Any: ...


def algorithm(name: str) -> type[Algorithm]:
    """The class of a kind by its name; ModelError where there is none."""
    if name in ON_TOP:
        return pkgutil.resolve_name(ON_TOP[name])
    if name not in ALGORITHMS:
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    return pkgutil.resolve_name(ALGORITHMS[name][0])


def trainer(name: str) -> Trainer:
    """What trains a kind, one of :data:`ALGORITHMS`."""
    return pkgutil.resolve_name(ALGORITHMS[name][1])
