"""Base class of stages: a stage is made once from checked options, describes itself, and runs."""

from __future__ import annotations

import builtins
import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.dimensions import CLASSIFICATION, Dimension
from ..base.errors import StageError
from ..base.files import Output, check_writable
from ..base.grid import GridWindow
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Count
from ..base.options import Option, decode_options, option, option_of, parse_options
from ..base.units import named_unit
from ..classifier.interface import ModelObserver
from .options import Selection, ignore_option
from .points import CodeLimit, Points
from .where_expression import Expression

_Placed = TypeVar("_Placed", bound="Stage")
#: What `where` means to stages of heights.
HEIGHTS_OUTSIDE = (
    "Points outside do not form the ground; they receive a height above it, unless they have one "
    "already or a stage before made it"
)


def files_read(stages: Sequence[StageJson]) -> list[str]:
    """Return the files of the readers among stages, as they are written."""
    readers = [stage for stage in stages if str(stage.get("type")).startswith("readers.")]
    return [str(stage["filename"]) for stage in readers if "filename" in stage]


def used_distances(reaches_m: Sequence[float], sees: Callable[[int, int], bool]) -> list[float]:
    """Return how far outside a tile later stages use the results of each stage, in meters.

    `reaches_m` are how far each looks; `sees(m, n)` tells whether stage m reads at neighbors what
    stage n before it makes.
    """
    used = [0.0] * len(reaches_m)
    for n in reversed(range(len(used))):
        for m in range(n + 1, len(used)):
            used[n] = max(used[n], used[m] + (reaches_m[m] if sees(m, n) else 0.0))
    return used


class Kept(Enum):
    """Reasons for which a model's stage leaves the class of a point; the first one counts."""

    OUTSIDE = 1  #: outside `where`
    IGNORED = 2
    GIVEN_GROUND = 3
    KEPT = 4


class Observer(ModelObserver):
    """Receives how stages come to their results; (n,) are the points that the stage runs on."""

    def see_noise(self, states: NDArray[np.uint8]) -> None:
        """Receive the states (n,) of :mod:`..terrain.detached`."""

    def see_raster(self, name: str, window: GridWindow, values: NDArray[np.float32]) -> None:
        """Receive what a step of the ground filter made of a piece of the cloud."""

    def see_heights(self, columns: Mapping[str, NDArray]) -> None:
        """Receive the columns (n,) of :func:`..terrain.heights.filtered_ground` by name."""

    def see_kept(self, points: Mapping[Kept, NDArray[np.bool_]]) -> None:
        """Receive which points (n,) are left alone by the model, and why."""


@dataclass(frozen=True)
class StageContext:
    """Facts that hold for one run of a stage; the default is a run of its own on a whole cloud."""

    #: Whether an earlier stage of the pipeline created a dimension that this one creates too: the
    #: values that points have are results then, not an input's leftovers.
    created_before: bool = False
    #: Why class codes above 31 do not fit the pipeline's writer; None where all fit.
    code_limit: CodeLimit | None = None
    #: In a tile: the dimension that holds how many meters a point lies outside the tile; negative
    #: inside. Else empty.
    outside: str = ""
    #: In a tile: how many meters outside it the results of this stage are still used, by later
    #: stages.
    used_m: float = 0.0
    #: In a tile: the blocks that an earlier round left for a stage that reaches far
    #: (:class:`FarReaching`).
    blocks: Sequence[Mapping[str, NDArray]] | None = None
    #: Receives how stages come to their results.
    observer: Observer | None = None

    def used(self, arrays: Mapping[str, NDArray]) -> NDArray[np.bool_] | None:
        """Return which points (n,) have results that are used; None outside tiles: all."""
        meters = arrays.get(self.outside)
        if meters is None:
            return None
        return meters <= self.used_m if self.used_m > 0 else meters < 0


#: Outside tiles and pipelines.
WHOLE_CLOUD = StageContext()


class Stage(ABC):
    """Base of all stages; see docs/adding-a-stage.md.

    A subclass declares its type, a summary and its options in its body, describes what it reads
    and creates and how far it looks, and does the work in :meth:`run`. Options are attributes. What
    is costly to derive from them (a plan, a model) is a ``functools.cached_property``, and numbers
    of points that it reports are :class:`..base.messages.Count`. A stage cannot be changed after it
    is made. ``class Mine(Stage, settings=MySettings)`` makes the fields of a dataclass of
    :class:`..base.checks.Settings` options, too.

    Parameters
    ----------
    raw_options : mapping
        Options as the user wrote them, from JSON or from the command line.
    place : str, optional
        How errors name the stage; by default its type.

    Attributes
    ----------
    options : dict
        Every option's parsed value by its name.
    set_options : frozenset of str
        Names of the options that are not left to their defaults.

    Raises
    ------
    StageError
        For options that are unknown, missing, wrong or contradictory, or name files that are; with
        `place` as where.
    """

    type: ClassVar[str]
    summary: ClassVar[str]
    source: ClassVar[str] = ""
    #: What becomes of the points outside `where`.
    where_help: ClassVar[str] = ""
    #: Dimensions that are read where the points have them.
    optional_dimensions: ClassVar[tuple[str, ...]] = ()
    #: Whether `where` only selects what to compute: tiles compute only results that are used.
    where_chooses: ClassVar[bool] = False
    #: Verb for the error on missing points ("there are no points to train on"); empty where a run
    #: without points is no error.
    needs_points: ClassVar[str] = ""
    #: For a stage that needs all points at once: the cure that is shown where it is run in tiles.
    #: Where that depends on options, `check` sets it; :meth:`needs_all_points` is then False.
    instead_of_tiles: str = ""
    #: For a stage that a model file may carry in its preprocessing: the options that the file may
    #: set. Model files come from strangers, so never an option that holds a path.
    in_models: ClassVar[tuple[str, ...]] = ()
    #: Raise it when the results change: models that were trained with another one warn.
    algorithm_version: ClassVar[int] = 1
    #: Options of the example on its page; needed where an option is required.
    example: ClassVar[JsonObject] = {}
    #: Whether it calls :meth:`Points.keep_only`: the next stage gets the points from PDAL anew.
    forgets: ClassVar[bool] = False
    #: Whether its results cost much: later stages of tiles that look around read them from a round
    #: before, and do not have them computed again in surroundings.
    costly: bool = False
    #: Whether points beyond the halo may matter; tiles then call :meth:`reach_of` and read farther.
    open_ended: ClassVar[bool] = False

    where: str | None = option(
        "expression", None, "A condition on points (PDAL's own filters do not see the others)"
    )
    threads: int = option("integer", 0, "Threads to use; 0 takes every available core", 0, 1024)
    horizontal_unit: str = option(
        "string",
        "",
        "Unit of x and y (meter, foot, us-ft), where the spatial reference is missing or wrong",
    )
    vertical_unit: str = option(
        "string",
        "",
        "Unit of z, where the spatial reference does not say; otherwise that of x and y",
    )

    #: The stages before it in the pipeline that create what it reads, as a model's preprocessing
    #: holds them.
    upstream: tuple[StageJson, ...] = ()

    def __init_subclass__(cls, settings: builtins.type | None = None) -> None:
        """Declare the fields of `settings` as options, but those that the class has already."""
        if settings is None:
            return
        for field in fields(settings):
            if field.metadata and not hasattr(cls, field.name):
                setattr(cls, field.name, option_of(settings, field.name))

    def __init__(self, raw_options: Mapping[str, object], place: str | None = None) -> None:
        self.place = place or self.type
        try:
            raw_options = self.complete(decode_options(self.all_options(), raw_options))
            self.set_options = frozenset(raw_options)
            self.options = parse_options(self.all_options(), raw_options)
            for name in ("horizontal_unit", "vertical_unit"):
                if self.options[name]:
                    named_unit(self.options[name], name)
            self._condition = None if self.where is None else Expression(self.where)
            self.check()
            for output in self.outputs():
                check_writable(output.path, output.what, output.kind)
        except StageError as error:
            raise error.prefixed(self.place) from None
        self._frozen = True

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse to change a stage after it is made."""
        if "_frozen" in self.__dict__:
            raise AttributeError(f"a stage cannot be changed after it is made: '{name}' is set")
        super().__setattr__(name, value)

    def after(self: _Placed, makers: Iterable[StageJson]) -> _Placed:
        """Return this stage placed behind the stages of a pipeline that create what it reads."""
        placed = copy.copy(self)
        placed.__dict__["upstream"] = tuple(makers)
        return placed

    @classmethod
    def all_options(cls) -> tuple[Option, ...]:
        """Return the stage's own options, then those that all stages share."""
        declared = [value for kind in cls.__mro__ for value in vars(kind).values()]
        options = {each.name: each for each in reversed(declared) if isinstance(each, Option)}
        where = options["where"]
        options["where"] = replace(where, help=f"{where.help}. {cls.where_help}")
        return tuple(reversed(options.values()))

    @classmethod
    def counts(cls) -> dict[str, Count]:
        """Return the counts that it may report, by name."""
        bodies = [vars(kind).items() for kind in reversed(cls.__mro__)]
        return {name: each for body in bodies for name, each in body if isinstance(each, Count)}

    @classmethod
    def complete(cls, raw_options: JsonObject) -> JsonObject:
        """Return the options of a user with those that a word among them stands for."""
        return raw_options

    @classmethod
    def needs_all_points(cls) -> bool:
        """Return whether it makes one thing of all points, so that views are merged before it."""
        return bool(cls.instead_of_tiles)

    @classmethod
    def describe_choices(cls) -> str:
        """Return a text on options whose words stand for several values."""
        return ""

    def check(self) -> None:
        """Refuse options that contradict each other; read the files that they name."""

    def check_upstream(self) -> str | None:
        """Return a warning about the stages upstream (:attr:`upstream`); None where they fit."""
        return None

    @property
    def hint(self) -> str | None:
        """Return the cure where a dimension is missing; None for that of :data:`.points.MAKERS`."""
        return None

    def inputs(self) -> list[str]:
        """Return the files that are read, without those of options that are file names."""
        return []

    def outputs(self) -> list[Output]:
        """Return the files that will be written."""
        return []

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have, beyond X, Y and Z."""
        return []

    def optional_reads(self) -> list[str]:
        """Return the dimensions that are read where the points have them, by names in any case."""
        return [*self.optional_dimensions, *(self._condition.names if self._condition else ())]

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        return ()

    def creates(self) -> dict[str, str]:
        """Return the PDAL types of :meth:`written_dimensions`, such as ``uint8_t``, by name."""
        return {dimension.name: dimension.type for dimension in self.written_dimensions()}

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return 0.0

    def parts(self) -> Sequence[JsonObject]:
        """Return the options, beside its own, of the stages that do the same one after the other.

        An option that they do not get is None. Where there are such stages, tiles run them instead,
        and the later ones read the results of the earlier ones around a tile from a round before.
        """
        return ()

    def blocks(self) -> Blocks | None:
        """Return the blocks that a :class:`FarReaching` stage needs before the tiles, if any."""
        return None

    def written_classes(self) -> set[int]:
        """Return the class codes that the stage may write to `Classification`."""
        return set()

    def sees_results_of(self, earlier: Stage) -> bool:
        """Return whether an earlier stage's results at neighbors can change this stage's results.

        Where they cannot, tiles do not compute them in their halo.
        """
        return True

    def reach_of(self, points: Points, context: StageContext, box: Sequence[float]) -> float:
        """Return how far around a tile the points lie that decide its results (`open_ended`).

        Parameters
        ----------
        points : Points
            What was read: the tile and some surroundings.
        context : StageContext
            It tells which results are used.
        box : sequence of float
            Min x, min y, max x, max y of the tile in meters.

        Returns
        -------
        float
            Meters; more than was read where that was not enough, infinity where nobody knows.
        """
        return 0.0

    @classmethod
    def from_pipeline(
        cls, raw_options: Mapping[str, object], before: Sequence[StageJson]
    ) -> JsonObject:
        """Return options that follow from the stages before, where the user does not set them."""
        return {}

    def points(
        self,
        arrays: Mapping[str, NDArray],
        context: StageContext = WHOLE_CLOUD,
        **about: Any,
    ) -> Points:
        """Return PDAL's arrays as this stage sees them: with its `where` and its units.

        `about` are fields of :class:`.points.Points` that describe the arrays, such as `wkt`.
        """
        return Points(
            arrays,
            where=self._condition,
            unit_names=(self.horizontal_unit, self.vertical_unit),
            meters_outside=arrays.get(context.outside),
            used=context.used(arrays) if self.where_chooses else None,
            code_limit=context.code_limit,
            **about,
        )

    @abstractmethod
    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Process the points of one view; return the dimensions that change.

        Parameters
        ----------
        points : Points
            At least one.
        context : StageContext
            The tile and the pipeline around the stage.

        Returns
        -------
        dict
            Dimension -> (n,) values for all points, those outside `where` included.
        """

    @classmethod
    def schema(cls) -> JsonObject:
        """Return the JSON Schema of the stage's object in a pipeline."""
        options = cls.all_options()
        shared = {"tag": {"type": "string"}, "inputs": {"type": ["array", "string"]}}
        return {
            "type": "object",
            "description": cls.summary,
            "properties": {"type": {"const": cls.type}, **shared}
            | {option.name: option.schema() for option in options},
            "required": ["type", *(option.name for option in options if option.required)],
            "additionalProperties": False,
        }


class ClassStage(Stage):
    """Base of stages that change the class of points, and nothing else."""

    where_chooses = True
    where_help = "Points outside keep their class but still serve as neighbors"
    ignore: Selection = ignore_option()
    #: Dimensions that it reads of a point's neighbors; None: all that it reads. Fewer save tiles
    #: work: stages that write others are not run in the halo.
    reads_around: ClassVar[frozenset[str] | None] = None

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification"]

    def sees_results_of(self, earlier: Stage) -> bool:
        """Neighbors matter by :attr:`reads_around` and by `ignore`, but not by other classes."""
        ignored, written = self.ignore, {name.lower() for name in earlier.creates()}
        of_neighbors = self.reads() if self.reads_around is None else self.reads_around
        read = (*of_neighbors, *(span.dimension for span in ignored.spans))
        ignores = earlier.written_classes() & set(ignored.codes)
        return bool(ignores) or not written.isdisjoint(name.lower() for name in read)

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        return (CLASSIFICATION,)


class Blocks(NamedTuple):
    """Squares of a grid that are computed once before the tiles; lengths in meters."""

    side: float
    reach: float  #: how far around a block points matter
    margin: float  #: how far beyond the points that are read a tile needs blocks
    overhang: float  #: how far beyond all points blocks hold something
    cell: float = 1.0  #: side of the cells that they are rasters of


def inside_block(block: tuple[int, int]) -> str:
    """Return the name of the array of the points inside a block (column, row)."""
    return f"inside/{block[0]}/{block[1]}"


class FarReaching(Stage):
    """A stage that looks too far for the surroundings of a tile: a round before serves it.

    The points of each tile are reduced to what matters far away (:meth:`reduce_points`), blocks of
    a grid are computed from that (:meth:`compute_block`), and a tile reads what it needs of those
    around it (:attr:`StageContext.blocks`).
    """

    @abstractmethod
    def reduce_points(self, points: Points) -> dict[str, NDArray[np.float64]]:
        """Return the points (n, 3) that blocks need: ``around``, and by block inside it.

        Blocks that hold points are named by :func:`inside_block`.
        """

    @abstractmethod
    def compute_block(
        self,
        far_points: NDArray[np.float64],
        inside: Iterable[NDArray[np.float64]],
        block: tuple[int, int],
    ) -> dict[str, NDArray]:
        """Compute a block (column, row) from the reduced points around and in it."""
