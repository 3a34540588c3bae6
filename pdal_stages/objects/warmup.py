"""Compiling ahead of time what mends classes at the end of ``classify``."""

from __future__ import annotations

import numpy as np

from .consistency import consistent


def objects_part() -> None:
    """The kernels of :func:`.consistency.consistent`, each asked on a wall and a roof with leaves in their planes."""
    side = np.arange(0.0, 8.0, 0.25)
    u, v = (axis.ravel() for axis in np.meshgrid(side, side))
    roof, wall = np.column_stack([u, v, 0 * u + 8.0]), np.column_stack([u, 0 * u + 20.0, v])
    codes = np.full(2 * len(u), 6, np.uint8)
    codes[len(u) // 2 :: len(u)] = 5
    consistent(
        np.concatenate([roof, wall]),
        codes,
        height=np.full(len(codes), 4.0),
        ground=np.zeros(len(codes)),
        reliability=np.full(len(codes), 0.5, np.float32),
    )
