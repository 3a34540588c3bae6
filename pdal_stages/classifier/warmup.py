"""Compiling ahead of time what the default heights, training and classification use."""

from __future__ import annotations

import numpy as np

from ..terrain import filtered_ground, hag_minima
from .clouds import TrainingCloud
from .training import train
from .trainoptions import TrainingOptions


def warmup() -> None:
    """Fill the cache of compiled kernels with those of the defaults, e.g. at installation.

    Other neighborhoods are compiled where they are first used, or by :func:`pdal_stages.features.warmup`.
    """
    xyz = np.random.default_rng(0).uniform(0.0, 12.0, (400, 3))
    axes = np.ascontiguousarray(xyz.T)
    dimensions = filtered_ground(*axes, openings=(5,), threads=1)
    dimensions["HeightAboveGround"] = hag_minima(*axes)
    dimensions |= dict.fromkeys(("ReturnNumber", "NumberOfReturns"), np.ones(len(xyz), np.uint8))
    read = ("HeightAboveGround", "Ground", "HeightAboveOpening_5", "returns")
    options = TrainingOptions(dimensions=read, trees=1, count=50, threads=1)
    model = train(TrainingCloud(xyz, np.where(xyz[:, 2] > 6.0, 6, 2), dimensions), options, progress=False)
    model.predict(xyz, dimensions, threads=1)
