"""What a stage is: its type name, typed options, dimensions, halo, and what it does."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from numpy.typing import NDArray

from ..base.errors import OptionError, StageError
from .options import Option, parse_options
from .points import Points

#: Options every stage of ours has.
COMMON = (
    Option(
        "where",
        "expression",
        None,
        "Points the stage acts on; the others stay as they are but serve as neighbors",
    ),
    Option("threads", "integer", 0, "Threads to use; 0 is every core on offer", minimum=0, maximum=1024),
    Option(
        "horizontal_unit",
        "string",
        "",
        "Unit of x and y (metre, foot, us-ft), where the spatial reference is missing or wrong",
    ),
    Option(
        "vertical_unit",
        "string",
        "",
        "Unit of z, where the spatial reference does not say; otherwise as x and y",
    ),
)


class Stage(ABC):
    """Base of all stages; a subclass in a module of this package is a stage of the product.

    Class attributes give the type name, one-line summary, declared options and the source
    in the papers. Methods are called with parsed options.
    """

    type: ClassVar[str]
    summary: ClassVar[str]
    source: ClassVar[str] = ""
    options: ClassVar[tuple[Option, ...]] = ()
    example: ClassVar[dict[str, Any]] = {}
    #: Stages shown round the example in the docs.
    before: ClassVar[tuple[dict[str, Any], ...]] = ()
    after: ClassVar[tuple[Any, ...]] = ("output.laz",)
    #: Paragraphs of the docs page (Markdown).
    details: ClassVar[str] = ""
    #: Dimensions, for the docs of a stage whose example cannot be parsed without a file.
    dimensions_help: ClassVar[str] = ""
    #: What `where` means here; None where the stage has no such option.
    where_help: ClassVar[str | None] = ""

    @classmethod
    def all_options(cls) -> tuple[Option, ...]:
        """The stage's own options, then those all stages share."""
        return cls.options + COMMON

    @classmethod
    def parse(cls, given: Mapping[str, Any], where: str | None = None) -> dict[str, Any]:
        """Parse and check options; errors name the stage (and tag) in `where`."""
        place = where or cls.type
        try:
            values = parse_options(cls.all_options(), given)
            for name in ("horizontal_unit", "vertical_unit"):
                if values[name]:
                    from ..base.units import named_unit

                    named_unit(values[name], name)
            if values["where"] is not None:
                from .where import Expression

                Expression(values["where"])
            cls.check(values)
        except StageError as error:
            if error.where and not error.where.startswith(place):  # a file the stage reads
                error.where = f"{place}: {error.where}"
            raise error.at(place) from None
        return values

    @classmethod
    def check(cls, options: dict[str, Any]) -> None:
        """Refuse options that contradict each other; read the files they name."""

    @classmethod
    def reads(cls, options: dict[str, Any]) -> list[str]:
        """Dimensions the points must have, beyond X, Y, Z."""
        return []

    @classmethod
    def creates(cls, options: dict[str, Any]) -> dict[str, str]:
        """Dimensions made or overwritten: name -> PDAL type (``double``, ``float``, ``uint8_t``)."""
        return {}

    @classmethod
    def halo(cls, options: dict[str, Any]) -> float:
        """How far beyond a tile, in metres, points can change the tile's results."""
        return 0.0

    @classmethod
    def inner_reach(cls, options: dict[str, Any]) -> float:
        """How far apart, in metres, points use each other's results of this very stage; part of the halo."""
        return 0.0

    @classmethod
    def largest_class(cls, options: dict[str, Any]) -> int:
        """The largest class code the stage may write to `Classification` (0: none)."""
        return 0

    @classmethod
    @abstractmethod
    def run(cls, points: Points, options: dict[str, Any]) -> dict[str, NDArray]:
        """Do the work; return the dimensions that change, one value per point."""

    @classmethod
    def schema(cls) -> dict[str, Any]:
        """JSON Schema of the stage's object in a pipeline."""
        properties: dict[str, Any] = {
            "type": {"const": cls.type},
            "tag": {"type": "string"},
            "inputs": {"type": ["array", "string"]},
        }
        properties.update({option.name: option.schema() for option in cls.all_options()})
        required = ["type"] + [o.name for o in cls.all_options() if o.required]
        return {
            "type": "object",
            "description": cls.summary,
            "properties": properties,
            "required": required,
            "additionalProperties": False,
        }


def plan_error(option: str, error: StageError) -> OptionError:
    """Name the option in an error raised by a numpy-level function."""
    return OptionError(f"option '{option}': {error.what}", found=error.found, cure=error.cure)
