"""Select training samples where a person corrected the classes of a base model.

Corrected points lie where the base was unsure; a forest trained on these alone does not learn what
the rest looks like. So samples are drawn from the checked points and from others of which the base
is sure: of each class about as many as were checked of the most frequent class. A hash of the
coordinates decides which.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.hashing import hash_rows
from ..classifier.input_dimensions import CHECKED
from .points import Points

#: Reliability from which on a base is sure of a point: 19 of 20 such points are right.
SURE = 0.95


def select_checked(
    points: Points, codes: NDArray[np.uint8], base_codes: Sequence[int], seed: int
) -> NDArray[np.bool_] | None:
    """Return which points (n,) samples are drawn from, and report it; None where none was checked.

    Parameters
    ----------
    points : Points
    codes : (n,) array of uint8
        Class codes.
    base_codes : sequence of int
        Class codes of the base; empty without a base.
    seed : int
        Seed of the hash.

    Raises
    ------
    StageError
        If all checked points lie outside `where`.
    """
    checked = np.asarray(points.arrays[CHECKED]) > 0
    if not checked.any():
        return None
    chosen = checked & points.inside
    if not chosen.any():
        count = f"{np.count_nonzero(checked):,} checked points"
        raise StageError("no checked point lies inside 'where'", found=count)
    wanted = np.count_nonzero(chosen)
    points.report.figures["checked"] = wanted
    text = f"{wanted:,} of {points.count:,} points were checked by a person ({CHECKED}): samples "
    text += "are drawn from these"
    if base_codes and points.reliability is not None:
        sure = points.inside & ~checked & (points.reliability >= SURE)
        counts = np.bincount(codes[chosen], minlength=256)[base_codes]
        beside = 0
        for code in np.asarray(base_codes)[counts > 0]:
            rows = np.flatnonzero(sure & (codes == code))
            beside += min(counts.max(), len(rows))
            share = counts.max() / max(len(rows), 1)
            chosen[rows[hash_rows(points.xyz[rows].T, seed) / 2.0**64 < share]] = True
        text += f", and from about {beside:,} others of which the base is sure: it is kept where "
        text += "nobody looked"
    points.report.note(text)
    return chosen
