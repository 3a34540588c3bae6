"""Ground with a block on it: the smallest cloud that has two classes."""

from __future__ import annotations

import numpy as np

#: What `train` is told for a small model at once; the dimensions are left to the test.
QUICK_TRAINING = [
    "--count",
    "200",
    "--neighborhoods",
    "k8",
    "--feature-set",
    "Linearity,HeightRange",
]
QUICK_TRAINING += ["--trees", "8", "--no-progress", "--writers.classifiermodel.passes=1"]


def ground_and_block(
    n: int = 600,
    seed: int = 1,
    size: float = 30.0,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, np.ndarray]:
    """Ground (2) and a block (6) of 5 m over its quarter of high X and Y, in centimeters: PDAL's names -> values."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, n)).round(2)
    block = (x > size / 2) & (y > size / 2)
    z = np.where(block, 5.0, 0.0) + rng.normal(0, 0.02, n).round(2)
    return {
        "X": x + at[0],
        "Y": y + at[1],
        "Z": z + at[2],
        "Classification": np.where(block, 6, 2).astype(np.uint8),
    }
