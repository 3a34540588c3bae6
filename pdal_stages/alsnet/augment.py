"""Changes to training batches, so that a network learns what does not matter: direction, noise, density."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from .networkoptions import NetworkOptions

#: Fewest points thinning leaves.
LEAST = 16


class Augmentation:
    """Rotation about z, noise and thinning of one batch, drawn anew for each."""

    def __init__(self, options: NetworkOptions, random: np.random.Generator) -> None:
        self.options, self.random = options, random

    def shift(self, spacing: float) -> npt.NDArray[np.float64]:
        """How far the batch's center is moved, (2,) meters."""
        return self.random.uniform(-1.0, 1.0, 2) * self.options.shift * spacing

    def __call__(self, xyz: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Coordinates from the batch's center (n, 3) to changed ones (m, 3) and the rows kept (m,)."""
        options, random = self.options, self.random
        kept = np.arange(len(xyz))
        if options.thin > 0.0:
            share = 1.0 - random.uniform(0.0, options.thin)
            kept = np.sort(random.permutation(len(xyz))[: max(min(LEAST, len(xyz)), round(share * len(xyz)))])
        out = xyz[kept]
        if options.rotate:
            angle = random.uniform(0.0, 2.0 * math.pi)
            c, s = math.cos(angle), math.sin(angle)
            out = out @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        if options.jitter > 0.0:
            noise = random.normal(0.0, options.jitter, out.shape)
            out = out + np.clip(noise, -3.0 * options.jitter, 3.0 * options.jitter)
        return out, kept
