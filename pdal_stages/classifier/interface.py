"""Interface of all kinds of classifiers: their request, results, and entries in model files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ..base.report import Report
from ..features import FeaturePlan
from ..features.point_grid import CellGrid


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


class Column(NamedTuple):
    """An input of a classifier, with the feature, the group and the neighborhood it belongs to."""

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
    memory_mb: float = 256.0  #: for work under way
    progress: Any = None  #: its ``update`` is called with the points done
    grid: CellGrid | None = None  #: the index of the cloud, which lies in its order
    device: str = "cpu"  #: where a network is applied
    report: Report = field(
        default_factory=Report
    )  #: what is counted, complete when all blocks are read

    @property
    def count(self) -> int:
        """Points wanted."""
        return len(self.xyz) if self.rows is None else len(self.rows)


class PassClassifier(Protocol):
    """Classifier that is one pass of a model.

    A kind that reads features and the context of the pass before has ``probabilities(values,
    rows)``: (b, classes) from features and context (b, inputs) at `rows`, and
    ``classes_before(codes)``: the classes of the pass before, where its own are `codes`. One that
    reads the points themselves can only be the first pass, and has ``predict(request)``, which
    yields a :class:`Block` after the other, with each row wanted once.
    """

    #: arrays that the kind stores in a model file; a name that ends in ``*`` stands for many
    rules: ClassVar[Mapping[str, ArrayRule]]

    @property
    def name(self) -> str:
        """The kind, as a manifest has it."""

    @property
    def plan(self) -> FeaturePlan | InputPlan:
        """Inputs that it reads of the points."""

    @property
    def features(self) -> Any:
        """Features that it reads; None for a kind that reads the points themselves."""

    @property
    def context(self) -> Any:
        """Context that it reads of the pass before; None for none."""

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> PassClassifier:
        """Return the classifier that a pass of a manifest describes.

        ModelError where the entry contradicts itself.
        """

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """Return what a manifest says of it beside its arrays."""

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return its arrays, for the model file."""

    def columns(self, codes: Sequence[int]) -> list[Column]:
        """Return its inputs, in order."""


class Block(NamedTuple):
    """Probabilities of some points."""

    rows: npt.NDArray[np.int64]  #: (b,) rows in the request's cloud
    probabilities: npt.NDArray[np.float64]  #: (b, classes)
    #: (b,) variance of a class's probability over a network's batches, mean over the classes
    variance: npt.NDArray[np.float64] | None = None


def weigh(
    p: npt.NDArray[np.float64], factors: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.float64]:
    """Multiply the probabilities (b, classes) of each class by its factor.

    None leaves them as they are.
    """
    if factors is None:
        return p
    p = p * factors
    p /= p.sum(axis=1, keepdims=True)
    return p
