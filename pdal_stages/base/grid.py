"""Runs of equal keys and places of keys in sorted arrays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def begins_run(ascending: npt.NDArray) -> npt.NDArray[np.bool_]:
    """Which values of a sorted array (n,) differ from the one before."""
    new = np.ones(len(ascending), np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=new[1:])
    return new


def places_among(
    ascending: npt.NDArray, wanted: npt.NDArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """The index of each wanted value in a non-empty ascending array, and whether it is there."""
    place = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return place, ascending[place] == wanted
