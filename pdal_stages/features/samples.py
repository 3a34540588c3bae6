"""The points whose neighborhoods the shape thresholds are fitted to [B16 3.2.2]."""

from __future__ import annotations

import numpy as np

from .shapes import point_seeds

#: Sample neighborhoods [B16 3.2.2].
SAMPLES = 500

#: Points hashed at a time.
CHUNK = 1_000_000


def smallest_hashes(xyz: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The SAMPLES points with the smallest hash of (seed, coordinates); copies of a point count once.

    Hashes (m,), ascending, and rows (m,) of the points.
    """
    hashes, rows = np.zeros(0, np.uint64), np.zeros(0, np.int64)
    for start in range(0, len(xyz), CHUNK):
        part = np.asarray(xyz[start : start + CHUNK])
        x, y, z = part.T
        hashes = np.concatenate((hashes, point_seeds(x, y, z, seed, "samples")))
        rows = np.concatenate((rows, np.arange(start, start + len(part))))
        hashes, first = np.unique(hashes, return_index=True)
        hashes, rows = hashes[:SAMPLES], rows[first[:SAMPLES]]
    return hashes, rows
