"""Interface of all kinds of classifiers: their request and results, and how they are registered.

Imports only go downward, so this room cannot import the network or the stages of pipelines. Such a
room registers itself in its ``__init__``, which the package's own ``__init__`` imports. What it
registers are functions that import the implementation when it is first needed, so that a forest is
applied without the network's modules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.messages import Report
from ..features.point_grid import CellGrid

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


_kinds: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {}
_preprocessing: list[Callable[[], Any]] = []


def register_kind(name: str, classifier: Callable[[], Any], trainer: Callable[[], Any]) -> None:
    """Register a kind of classifier by the name that manifests and the option `algorithm` use.

    Its classifier is a class, and an object of it one pass of a model, with

    - ``rules``: name -> :class:`ArrayRule` of the arrays that the kind stores in a model file; a
      name that ends in ``*`` stands for many;
    - ``name``: the kind, as a manifest has it;
    - ``plan``: the inputs that it reads of the points, a ``FeaturePlan`` or :class:`InputPlan`;
    - ``features``: the features that it reads; None for a kind that reads the points themselves;
    - ``context``: the context that it reads of the pass before, or None;
    - ``from_file(entry, arrays, codes)``: the classifier that a pass of a manifest describes, with
      classes `codes`; ModelError where the entry contradicts itself;
    - ``to_file(codes)`` and ``arrays()``: what a model file stores of it.

    A kind that reads features and context has ``probabilities(values, rows)``: (b, classes) from
    features and context (b, inputs) at `rows`, and ``classes_before(codes)``: the classes of the
    pass before, where its own are `codes`. One that reads the points themselves can only be the
    first pass, and has ``predict(request)``, which yields a :class:`Block` after the other, with
    each row wanted once.

    Its trainer is a module with

    - ``optional_inputs``: dimensions that training uses where the points have them, each with the
      dimensions that it is computed from;
    - ``own_options(options)``: the checked options that only this kind has, or None;
    - ``inputs(options)``: the dimensions that the classifier will read;
    - ``train(clouds, options, progress)``: a ``Model``, trained on clouds that are prepared.
    """
    _kinds[name] = classifier, trainer


def register_preprocessing(load: Callable[[], Any]) -> None:
    """Register the module that knows the stages which compute a model's dimensions.

    It has

    - ``check(preparation)``: the stages in one spelling; ModelError for one that no model may have;
    - ``algorithm_versions(preparation)``: the version of each stage's algorithm in this release;
    - ``preparation_of(names)``: the stages that compute these dimensions, as far as they are
      heights;
    - ``made_of_coordinates(preparation, xyz, usable, threads, classes)``: the dimensions (n,) that
      the stages compute from coordinates (n, 3) in meters.
    """
    _preprocessing.append(load)


def kinds() -> tuple[str, ...]:
    """Return the names of the kinds that can be trained."""
    return tuple(_kinds)


def classifier_of(name: str) -> Any:
    """Return the class of a kind; ModelError for one that this release does not have."""
    kind = FOREST if name == REFINED_FOREST else name
    if kind not in _kinds:
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    return _kinds[kind][0]()


def trainer_of(name: str) -> Any:
    """Return the module that trains a kind, one of :func:`kinds`."""
    return _kinds[name][1]()


def preprocessing() -> Any:
    """Return the module that was registered."""
    return _preprocessing[-1]()
