"""Heights above openings of the minimum grid: a profile of what a point stands on, without any threshold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.jit import njit


def opening_names(windows: Sequence[float]) -> list[str]:
    """Dimensions of the windows: ``HeightAboveOpening_5``; a decimal point becomes ``_``."""
    return [f"HeightAboveOpening_{window:g}".replace(".", "_") for window in windows]


@njit
def above_opening(x, y, z, cell, left, bottom, opening, fallback, out):
    """z minus the opening, bilinear between the centers of measured cells; `fallback` where there is none."""
    h, w = opening.shape
    for p in range(len(x)):
        u, v = x[p] / cell - 0.5, y[p] / cell - 0.5
        i, j = int(np.floor(u)), int(np.floor(v))
        s, t = u - i, v - j
        level, total = 0.0, 0.0
        for b in range(2):
            for a in range(2):
                row, column = j + b - bottom, i + a - left
                if not (0 <= row < h and 0 <= column < w):
                    continue
                value = opening[row, column]
                weight = (s if a else 1.0 - s) * (t if b else 1.0 - t)
                if np.isfinite(value) and weight > 0.0:
                    level += weight * value
                    total += weight
        out[p] = z[p] - level / total if total > 0.0 else fallback[p]
