"""Runs of equal values, and hashes that follow from what is hashed alone: splitmix64 (Steele, Lea, Flood 2014).

:func:`finalise` serves NumPy arrays as it is, and kernels through ``njit(forceinline=True)(finalise)``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

#: Values hashed at a time: few enough to stay in a core's cache.
_TOGETHER = 1 << 16
#: What splitmix64 adds before it mixes.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def finalise(h):
    """The finaliser of splitmix64: uint64 (an array, or in a kernel a number) to uint64."""
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


def hash_of(columns: Iterable[npt.ArrayLike], seed: int) -> npt.NDArray[np.uint64]:
    """A 64-bit hash of each point's values and the seed: every bit counts, but -0.0 is 0.0.

    Each column is an array (n,) of any type, such as one axis of the coordinates; there must be at least one.
    """
    arrays = [np.asarray(column) for column in columns]
    out = np.empty(len(arrays[0]), np.uint64)
    for start in range(0, len(out), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        value: Any = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
        for array in arrays:
            bits = (np.asarray(array[part], np.float64) + 0.0).view(np.uint64)
            value = finalise((value ^ bits) + GOLDEN)
        out[part] = value
    return out
