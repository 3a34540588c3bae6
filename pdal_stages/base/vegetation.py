"""Low, medium and high vegetation, by the height above ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import OptionError

#: ASPRS codes of low, medium and high vegetation.
LOW, MEDIUM, HIGH = 3, 4, 5


def bands(values: Sequence[Any]) -> tuple[float, float] | None:
    """Below these heights in meters vegetation is low, and medium; None where no values are given.

    Raises
    ------
    OptionError
        If the values are not two heights, the lower one first.
    """
    if not values:
        return None
    try:
        low, medium = (float(one) for one in values)
    except (TypeError, ValueError):
        low = medium = 0.0
    if not 0.0 < low < medium < 1000.0:
        raise OptionError(
            "option 'vegetation_heights' must be two heights in meters, the lower one first",
            found=", ".join(map(str, values)),
            cure="For example 0.5,2",
        )
    return low, medium


def by_height(
    codes: NDArray[np.uint8], chosen: NDArray[np.bool_], height: NDArray, limits: tuple[float, float]
) -> None:
    """Make those of the chosen points that are high vegetation low or medium, in place; `height` in meters."""
    high = chosen & (codes == HIGH)
    low, medium = limits
    codes[high & (height < medium)] = MEDIUM
    codes[high & (height < low)] = LOW
