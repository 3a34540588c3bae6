"""What kinds of classifiers of clouds share: what they are asked and answer, and the names by which they are known.

A kind is a class with ``name``, ``rules`` (of its arrays in a model file; a name that ends in ``*`` stands for many),
``plan``, ``features`` and ``context`` (None without), ``from_file(entry, arrays, codes)``, ``to_file(codes)``, ``arrays()``
and ``columns(codes)``. It has ``probabilities(read, rows)`` where it has features, and else ``predict(request, finish)``,
which yields (rows, what `finish` made of their probabilities) block by block. What trains it is a module with
``optional_inputs`` (each with the dimensions it needs), ``own_options(given)``, ``inputs(options)``,
``outputs(options)`` and ``train(clouds, options, progress)``.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, ModelError
from ..base.report import Report
from ..base.settings import Settings, setting
from ..features import return_features
from ..features.point_grid import CellGrid

#: What every point has: the feature engine takes these from the coordinates.
COORDINATES = ("X", "Y", "Z")
#: What a model is trained on by default: always this, and these where points have them.
DEFAULT_DIMENSIONS = ("HeightAboveGround",)
OPTIONAL_DIMENSIONS = ("Ground", "HeightAboveOpening_5", "HeightAboveOpening_17")
#: 1 where a person has checked a point's class.
CHECKED = "Checked"

_READ = "It comes from the reader; this source has none. Use a model trained without it"
_MAKERS = {
    "HeightAboveGround": (
        "In Python filtered_ground(xyz) makes it; in a pipeline put filters.hag_morphological before this stage, or "
        "what the model was trained with"
    ),
    **dict.fromkeys(("Intensity", *return_features.SOURCES), _READ),
}
#: Each kind by its word in manifests and options: its class, and what trains it, imported when asked for.
ALGORITHMS = {
    "random_forest": (
        "pdal_stages.classifier.feature_forest:FeatureForest",
        "pdal_stages.classifier.train_forest",
    ),
    "alsnet": ("pdal_stages.alsnet.classifier:AlsNet", "pdal_stages.alsnet.training"),
}
#: A forest on top of other passes, which only training on a base makes.
REFINED = "refined_forest"


class ArrayRule(NamedTuple):
    """What a kind expects of one of its arrays."""

    dtypes: tuple[str, ...]  #: allowed types, as NumPy writes them: ``<f4``
    ndim: int  #: number of axes


@dataclass(frozen=True)
class InputPlan:
    """What a classifier looks at, where a :class:`FeaturePlan` does not say it."""

    names: tuple[str, ...]  #: its inputs, in order
    dimensions: tuple[str, ...]  #: which of them are dimensions of the points
    halo_m: float  #: meters around a tile whose points the tile's results depend on


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
    memory_mb: float = 256.0  #: for work under way
    progress: Any = None  #: its ``update`` is called with the points done
    grid: CellGrid | None = None  #: the index of the cloud, which lies in its order
    #: whether a network adds "variance", (b,) float64, to the mapping that `finish` makes
    variance: bool = False
    device: str = "cpu"  #: where a network is applied
    report: Report = field(
        default_factory=Report
    )  #: what is counted, complete when all blocks are read

    @property
    def count(self) -> int:
        """Points wanted."""
        return len(self.xyz) if self.rows is None else len(self.rows)


@dataclass(frozen=True)
class PredictionOptions(Settings):
    """How a cloud is classified."""

    threads: int | None = None
    memory_mb: float = setting(256.0, "number", "Memory for blocks of points", 1, None, unit="MB")
    probabilities: bool = False  #: whether to return them
    margin: bool = False
    variance: bool = False  #: of the probabilities over a network's batches
    device: str = setting(
        "cpu",
        "string",
        "Where a network is applied: cpu (NumPy, the same bits everywhere), cuda, or auto",
        choices=("cpu", "cuda", "auto"),
    )
    #: points less reliable do not get the winning class, and are counted
    reject_below: float | None = setting(
        None, "number", "Points with a lower Reliability are rejected", 0, 1
    )
    rejected_code: int | None = setting(
        None, "integer", "Class code for rejected points; by default they keep theirs", 0, 255
    )
    #: as `reject_below`, for points of each class; the larger one counts
    limits: Mapping[int, float] | None = None


@dataclass(frozen=True, eq=False)
class Prediction:
    """Classes given to a cloud's points, in its order; numbers are 0 for points that were not classified."""

    classification: npt.NDArray[np.uint8]  #: (n,) ASPRS codes
    reliability: npt.NDArray[np.float32]  #: (n,) probability of the winning class
    unsure: npt.NDArray[np.int64]  #: (m,) points that were not reliable enough, and so rejected
    report: Report  #: counts, notes and warnings for the metadata
    margin: npt.NDArray[np.float32] | None = None  #: (n,) winning minus second probability
    #: (n,) variance of a class's probability over a network's batches, mean over the classes
    variance: npt.NDArray[np.float32] | None = None
    #: (n, classes) in the order of ``Model.classes``
    probabilities: npt.NDArray[np.float32] | None = None


def algorithm(name: str) -> Any:
    """The class of a kind by its name; ModelError where there is none."""
    if name not in (*ALGORITHMS, REFINED):
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    return pkgutil.resolve_name(ALGORITHMS["random_forest" if name == REFINED else name][0])


def trainer(name: str) -> Any:
    """What trains a kind, one of :data:`ALGORITHMS`."""
    return pkgutil.resolve_name(ALGORITHMS[name][1])


def required(names: Iterable[str]) -> tuple[str, ...]:
    """Dimensions the cloud must have for these dimension features."""
    return tuple(
        dict.fromkeys(
            name
            for name in names
            if name not in COORDINATES and return_features.parse(name) is None
        )
    )


def optional(names: Iterable[str]) -> tuple[str, ...]:
    """Dimensions that these features can do without but use where the cloud has them."""
    return (
        return_features.SOURCES
        if any(return_features.parse(name) is not None for name in names)
        else ()
    )


def known(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | None = None,
    where: str | None = None,
) -> list[npt.NDArray[Any]]:
    """Values (n,) of the dimensions that these features need, checked as by :func:`gather`, and of those that they use."""
    found = [*required(names), *(name for name in optional(names) if name in dimensions)]
    for name in found:
        gather((name,), dimensions, n, rows, where)  # one after the other: it may be a copy
    return [np.asarray(dimensions[name]) for name in found]


def with_returns(
    names: Iterable[str],
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    threads: int | None = None,
) -> Mapping[str, npt.ArrayLike]:
    """The dimensions and those of `names` that are made of return numbers and the points around."""
    made = return_features.return_features(names, xyz, dimensions, threads)
    return {**dimensions, **made} if made else dimensions


def gather(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | None = None,
    where: str | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """The values (len(rows),) of dimension features at some of n points, all by default, by name.

    `dimensions` are (n,) values of the whole cloud, see :func:`with_returns`; `where` is the cloud, for error texts.
    DimensionError where one is missing, of another length, or not finite somewhere.
    """
    out = {}
    for name in names:
        if name in COORDINATES:
            continue
        if name not in dimensions:
            cure = _MAKERS.get(name, f"Put the stage that creates {name} before this one")
            raise DimensionError(f"the dimension {name} is missing", where=where, cure=cure)
        values = np.asarray(dimensions[name])
        if values.shape != (n,) or values.dtype.kind not in "fiub":
            raise DimensionError(
                f"the dimension {name} must have one value per point",
                where=where,
                found=f"{values.dtype} of shape {values.shape}",
            )
        out[name] = values if rows is None else values[rows]
        if values.dtype.kind == "f" and (bad := np.count_nonzero(~np.isfinite(out[name]))):
            raise DimensionError(
                f"the dimension {name} is not finite at some points",
                where=where,
                found=f"{bad:,} points",
                cure=f"Remove them before this stage. {_MAKERS.get(name, '')}",
            )
    return out


def preparation_module() -> Any:
    """The module that knows the stages which make dimensions; it stands above this room, and is imported when asked for."""
    return pkgutil.resolve_name("pdal_stages.stages.preprocessing")
