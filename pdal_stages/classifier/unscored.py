"""Why a model has no held-out score, and what to label next so that it has one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError

#: Classes that are named.
_NAMED = 3


def why_unscored(
    errors: Sequence[OptionError],
    xy: npt.NDArray[np.float64],
    label: npt.NDArray[Any],
    classes: Sequence[tuple[int, str]],
    block_size: float,
    gap: float,
) -> str:
    """What is wrong with the labels and what to label next.

    Parameters
    ----------
    errors : sequence of OptionError
        What each way of holding out ground ended with.
    xy : (n, 2) float64
        Where the samples are, meters.
    label : (n,) int
        The place of each one's class in `classes`.
    classes : sequence of (code, name)
    block_size, gap : float
        Meters: blocks of ground that are held out, and what is left out around them.
    """
    cell = np.floor(xy / block_size).astype(np.int64)
    lines = []
    for place, (code, name) in enumerate(classes):
        mine = label == place
        blocks = len(np.unique(cell[mine], axis=0))
        low, high = xy[mine].min(axis=0), xy[mine].max(axis=0)
        wide = np.maximum(high - low, 1.0)
        lines.append((blocks, float(wide.max()), code, name, low, wide))
    lines.sort(key=lambda one: one[:3])
    fewest = lines[0][0]
    alone = [one for one in lines if one[0] <= max(4, fewest)][:_NAMED]
    away = f"{block_size + gap:.0f} m"
    named = "; ".join(
        f"{code} {name}, all within {wide[0]:.0f} x {wide[1]:.0f} m at {low[0] + wide[0] / 2:.0f}, "
        f"{low[1] + wide[1] / 2:.0f}"
        for _, _, code, name, low, wide in alone
    )
    reason = f"{errors[-1].what} ({errors[-1].found})" if errors else "nothing was held out"
    return (
        f"there is no score on ground held out: {reason}. What is printed is out of bag, of samples whose neighbors were "
        f"trained on, and says little about other ground. Label next, at least {away} away: {named}"
    )
