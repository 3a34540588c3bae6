"""Define what a stage is: an object made once from checked options, which then describes itself and
runs.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import Output, check_writable
from ..base.units import named_unit
from .context import WHOLE_CLOUD, StageContext
from .options import Option, option, parse_options
from .points import Points
from .where_expression import Expression

#: What `where` means to stages of heights.
HEIGHTS_OUTSIDE = (
    "Points outside do not form the ground; they receive a height above it, unless they have one "
    "already or a stage "
    "before made it"
)


def files_read(stages: Sequence[Mapping[str, Any]]) -> list[str]:
    """Files of the readers among stages, as they are written."""
    readers = [stage for stage in stages if str(stage.get("type")).startswith("readers.")]
    return [str(stage["filename"]) for stage in readers if "filename" in stage]


class Stage(ABC):
    """Base of all stages; a subclass in a module of this package is a stage of the product.

    A subclass gives its type name and a one-line summary, declares its options in its body, says
    what it reads, creates and how far it looks, and does the work in :meth:`run`. A stage object
    holds parsed options as attributes; what is costly to make of them (a plan, a model) belongs in
    a ``functools.cached_property``.

    Parameters
    ----------
    given : mapping
        Options as the user gave them, from JSON or from the command line.
    place : str, optional
        What errors call the stage; by default its type.

    Attributes
    ----------
    options : dict
        Every option's parsed value by its name.
    given : frozenset of str
        Names of the options that the user gave.

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
    #: Whether `where` only chooses what to compute, so that tiles may narrow it down to what is
    #: seen.
    where_chooses: ClassVar[bool] = False
    #: What a stage that cannot run without points does with them, as a message says it.
    needs_points: ClassVar[str] = ""
    #: For a stage that makes one thing of all points, and gets them as one view: what to do instead
    #: of running it in tiles.
    instead_of_tiles: str = ""
    #: For a stage that a model file may carry, to be run by whoever applies it: the options that
    #: the file may give. Model files come from strangers, so none that holds a path.
    in_models: ClassVar[tuple[str, ...]] = ()
    #: For the same: raise it when results change. Models store it, and warn where they were trained
    #: with another one.
    algorithm_version: ClassVar[int] = 1
    #: Counts that it puts into its report (:meth:`Points.tally`): name -> what these points are.
    #: Tiles add them up, and `classify` prints them.
    counts: ClassVar[Mapping[str, str]] = {}
    #: Options of the example on its page; needed where an option is required.
    example: ClassVar[Mapping[str, Any]] = {}
    #: Whether it forgets most dimensions (:meth:`Points.keep_only`) and then needs much memory: the
    #: next stage gets the points from PDAL anew.
    forgets: ClassVar[bool] = False
    #: Whether points beyond the halo may matter; tiles then ask :meth:`reach_of`, and are read
    #: wider.
    open_ended: ClassVar[bool] = False

    where: str | None = option(
        "expression", None, "A condition on points (PDAL's own filters do not see the others)"
    )
    threads: int = option(
        "integer", 0, "Threads to use; 0 takes every available core", minimum=0, maximum=1024
    )
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
    upstream: tuple[Mapping[str, Any], ...] = ()

    def __init__(self, given: Mapping[str, Any], place: str | None = None) -> None:
        self.place = place or self.type
        self.given = frozenset(given)
        try:
            self.options = parse_options(self.all_options(), given)
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

    def __setattr__(self, name: str, value: Any) -> None:
        if "_frozen" in self.__dict__:
            raise AttributeError(f"a stage cannot be changed after it is made: '{name}' is set")
        super().__setattr__(name, value)

    def after(self, makers: Iterable[Mapping[str, Any]]) -> Self:
        """Return this stage placed behind the stages of a pipeline that create what it reads."""
        placed = copy.copy(self)
        placed.__dict__["upstream"] = tuple(makers)
        return placed

    @classmethod
    def all_options(cls) -> tuple[Option, ...]:
        """The stage's own options, then those all stages share."""
        every = [
            one for kind in cls.__mro__ for one in vars(kind).values() if isinstance(one, Option)
        ]
        where = every.index(vars(Stage)["where"])
        every[where] = replace(every[where], help=f"{every[where].help}. {cls.where_help}")
        return tuple(every)

    @classmethod
    def describe_choices(cls) -> str:
        """Return text on options whose words stand for more than a value, shown after them."""
        return ""

    def check(self) -> None:
        """Refuse options that contradict each other; read the files they name."""

    def check_upstream(self) -> str | None:
        """Return a warning about the stages upstream (:attr:`upstream`); None where they fit."""
        return None

    @property
    def hint(self) -> str | None:
        """What to do where a dimension that it reads is missing, if it knows better than
        :data:`MAKERS`.
        """
        return None

    def inputs(self) -> list[str]:
        """Files the stage reads, beside those that its options of kind ``filename`` and ``model``
        name.
        """
        return []

    def outputs(self) -> list[Output]:
        """Files the stage will write."""
        return []

    def reads(self) -> list[str]:
        """Dimensions the points must have, beyond X, Y, Z."""
        return []

    def creates(self) -> dict[str, str]:
        """Dimensions made or overwritten: name -> PDAL type (``double``, ``float``,
        ``uint8_t``).
        """
        return {}

    def halo_m(self) -> float:
        """How far beyond a tile, in meters, points can change the tile's results."""
        return 0.0

    def largest_class(self) -> int:
        """The largest class code the stage may write to `Classification` (0: none)."""
        return 0

    def reach_of(self, points: Points, context: StageContext, box: Sequence[float]) -> float:
        """Return how far around a tile lie the points that decide its results, for an open-ended
        stage.

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
        cls, given: Mapping[str, Any], before: Sequence[Mapping[str, Any]]
    ) -> dict[str, Any]:
        """Options that the stage takes from the stages before it in the pipeline, where its own do
        not give them.
        """
        return {}

    def points(
        self,
        arrays: Mapping[str, NDArray],
        context: StageContext = WHOLE_CLOUD,
        *,
        wkt: str = "",
        legacy_flags: bool = False,
        overlap_as_flag: bool = False,
    ) -> Points:
        """PDAL's arrays as this stage sees them: with its `where` and its units."""
        units = (self.horizontal_unit, self.vertical_unit)
        return Points(
            arrays,
            wkt,
            self._condition,
            units,
            legacy_flags,
            overlap_as_flag,
            arrays.get(context.outside),
            context.used(arrays) if self.where_chooses else None,
            context.code_limit,
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
    def schema(cls) -> dict[str, Any]:
        """JSON Schema of the stage's object in a pipeline."""
        properties: dict[str, Any] = {
            "type": {"const": cls.type},
            "tag": {"type": "string"},
            "inputs": {"type": ["array", "string"]},
        }
        properties.update({option.name: option.schema() for option in cls.all_options()})
        return {
            "type": "object",
            "description": cls.summary,
            "properties": properties,
            "required": ["type"] + [o.name for o in cls.all_options() if o.required],
            "additionalProperties": False,
        }


class ClassStage(Stage):
    """Base of the stages that give points another class, and change nothing else."""

    where_chooses = True

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification"]

    def creates(self) -> dict[str, str]:
        """Return the dimensions that are written, with their PDAL types."""
        return {"Classification": "uint8_t"}
