"""Runs of equal values in what is sorted."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def begins_run(ascending: npt.NDArray) -> npt.NDArray[np.bool_]:
    """Which values of a sorted array (n,) are not those before them."""
    new = np.ones(len(ascending), np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=new[1:])
    return new
