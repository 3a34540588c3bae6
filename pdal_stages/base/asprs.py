"""Class codes of ASPRS: names, colors, groups of codes (LAS 1.4-R15, tables 9 and 17)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_CLASSES: dict[int, tuple[str, tuple[int, int, int]]] = {
    0: ("Created, never classified", (150, 150, 150)),
    1: ("Unclassified", (170, 170, 170)),
    2: ("Ground", (176, 137, 84)),
    3: ("Low vegetation", (186, 219, 110)),
    4: ("Medium vegetation", (113, 184, 72)),
    5: ("High vegetation", (34, 122, 52)),
    6: ("Building", (214, 78, 60)),
    7: ("Low point (noise)", (196, 45, 196)),
    8: ("Model key-point", (120, 90, 50)),
    9: ("Water", (60, 132, 214)),
    10: ("Rail", (110, 90, 140)),
    11: ("Road surface", (90, 90, 98)),
    12: ("Overlap", (230, 200, 120)),
    13: ("Wire - guard (shield)", (240, 170, 60)),
    14: ("Wire - conductor (phase)", (250, 190, 20)),
    15: ("Transmission tower", (120, 70, 190)),
    16: ("Wire-structure connector", (220, 130, 30)),
    17: ("Bridge deck", (90, 170, 180)),
    18: ("High noise", (240, 80, 240)),
    19: ("Overhead structure", (60, 110, 130)),
    20: ("Ignored ground", (150, 120, 90)),
    21: ("Snow", (225, 238, 250)),
    22: ("Temporal exclusion", (130, 130, 150)),
}
NAMES = {code: name for code, (name, _) in _CLASSES.items()}

#: Codes of noise points: below the ground (7) and in the air (18).
NOISE = (7, 18)
UNCLASSIFIED = 1  #: processed, without a class
GROUND = 2
LOW_VEGETATION = 3
MEDIUM_VEGETATION = 4
HIGH_VEGETATION = 5
BUILDING = 6
WIRE = 14  #: conductors
WIRES = (13, WIRE)  #: guard wires, too
TOWER = 15  #: transmission towers
BRIDGE = 17  #: bridge decks
WATER = 9
#: Classes of the terrain's surface, which ground that is given consists of: ground, water, road.
TERRAIN = (GROUND, WATER, 11)
#: Wires, towers and what connects them: no part of a canopy.
WIRES_AND_TOWERS = (13, 14, 15, 16)
#: Codes that say nothing about the object: never classified, unclassified.
UNLABELED = (0, 1)
#: Overlap of strips, before LAS 1.4 had a flag for it.
OVERLAP = 12
#: Codes that say nothing about the object. They are neither trained on nor scored unless they are
#: named.
UNINFORMATIVE = tuple(sorted((*UNLABELED, *NOISE, OVERLAP)))
#: Largest code LAS 1.0-1.3 point formats (0-5) hold: five bits.
LEGACY_LIMIT = 31


def class_name(code: int) -> str:
    """Return ASPRS's name of a class, or ``Reserved`` below 64 and ``User class`` from there on."""
    code = int(code)
    return NAMES.get(code, f"Reserved {code}" if code < 64 else f"User class {code}")


def class_color(code: int) -> tuple[int, int, int]:
    """Return an sRGB color (0-255) for maps; codes without an ASPRS class get a fixed color."""
    code = int(code)
    if code in _CLASSES:
        return _CLASSES[code][1]
    mixed = (code * 2654435761) & 0xFFFFFFFF
    return (70 + (mixed & 127), 70 + ((mixed >> 8) & 127), 70 + ((mixed >> 16) & 127))


def by_height(
    codes: NDArray[np.uint8],
    chosen: NDArray[np.bool_],
    height: NDArray,
    limits: Sequence[float],
) -> None:
    """Reclassify the chosen points of high vegetation by height, in place.

    Heights below ``limits[0]`` become low, below ``limits[1]`` medium vegetation; in meters.
    """
    high = chosen & (codes == HIGH_VEGETATION)
    low, medium = limits
    codes[high & (height < medium)] = MEDIUM_VEGETATION
    codes[high & (height < low)] = LOW_VEGETATION
