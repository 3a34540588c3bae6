"""Dimensions that our stages write: name, PDAL type, unit and meaning.

Points from a file have names alone. So a dimension that stages read in meters is known here by its
name; all others are read as the numbers that they are.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

#: The unit of a length upward that points have in the unit of their Z, whatever that is.
OF_Z = "unit of Z"


@dataclass(frozen=True)
class Dimension:
    """A dimension of points."""

    name: str
    type: str  #: PDAL's, such as ``float`` and ``uint8_t``
    unit: str  #: :data:`OF_Z`, ``m``, ``degree``; ``1`` for numbers without a unit
    meaning: str


CLASSIFICATION = Dimension("Classification", "uint8_t", "1", "class code, with flags in old LAS")
HEIGHT = Dimension("HeightAboveGround", "float", OF_Z, "height above the ground")
GROUND = Dimension("Ground", "uint8_t", "1", "1 for ground, else 0")
SLOPE = Dimension("Slope", "float", "degree", "slope of the terrain")
RELIABILITY = Dimension("Reliability", "float", "1", "probability of the class")
MARGIN = Dimension("Margin", "float", "1", "probability of the class minus the next one")
VARIANCE = Dimension("Variance", "float", "1", "variance of a network's batches, mean over classes")
OBJECT_ID = Dimension("ObjectID", "uint64_t", "1", "number of the object, 0 for none")
REFERENCE = Dimension("Reference", "uint8_t", "1", "true class")

_OPENING = re.compile(r"HeightAboveOpening_(\d+(?:_\d+)?)")
_KNOWN = {
    dimension.name: dimension
    for dimension in (
        *(CLASSIFICATION, HEIGHT, GROUND, SLOPE, RELIABILITY, MARGIN, VARIANCE, OBJECT_ID),
        REFERENCE,
    )
}


def opening(width: float) -> Dimension:
    """Return the height above an opening; a decimal point in its width (meters) becomes ``_``."""
    name = f"HeightAboveOpening_{width:g}".replace(".", "_")
    return Dimension(name, "float", OF_Z, f"height above the opening with a window of {width:g} m")


def opening_width(name: str) -> float | None:
    """Return the width of the window, meters, in the name of an opening; None of other names."""
    match = _OPENING.fullmatch(name)
    return float(match[1].replace("_", ".")) if match else None


def probability(code: int) -> Dimension:
    """Return the probability of a class."""
    return Dimension(f"Probability_{code}", "float", "1", f"probability of class {code}")


def known(name: str) -> Dimension | None:
    """Return the dimension of a name that our stages write and read; None for others."""
    width = opening_width(name)
    return _KNOWN.get(name) if width is None else opening(width)


def is_height(name: str) -> bool:
    """Return whether the values are lengths upward in the unit of Z, as Z itself is."""
    dimension = known(name)
    return name == "Z" or (dimension is not None and dimension.unit == OF_Z)
