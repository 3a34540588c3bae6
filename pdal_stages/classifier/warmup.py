"""Compiling ahead of time what the default heights, training and classification use.

:func:`warmup` does it all; :func:`features_part` and :func:`other_part` are two halves with few kernels in common.
"""

from __future__ import annotations

import numpy as np

from ..features import compute_features
from ..features.voxels import represent
from ..terrain import detached_noise, filtered_ground, hag_minima
from .clouds import TrainingCloud
from .context import OWN, Context
from .forest import Forest
from .training import train
from .trainoptions import TrainingOptions
from .trees import Ranked, grow_tree


def warmup() -> None:
    """Fill the cache of compiled kernels with those of the defaults, e.g. at installation.

    Other neighborhoods are compiled where they are first used, or by :func:`pdal_stages.features.warmup`.
    """
    xyz = _cloud()
    dimensions = _heights(xyz)
    dimensions |= dict.fromkeys(("ReturnNumber", "NumberOfReturns"), np.ones(len(xyz), np.uint8))
    read = ("HeightAboveGround", "Ground", "HeightAboveOpening_5", "returns")
    options = TrainingOptions(dimensions=read, trees=1, count=50, threads=1)
    model = train(TrainingCloud(xyz, np.where(xyz[:, 2] > 6.0, 6, 2), dimensions), options, progress=False)
    model.predict(xyz, dimensions, threads=1)


def features_part() -> None:
    """The kernels of features."""
    compute_features(_cloud(), None, "s5,k10", ("covariance", "geometric", "surfaces"), threads=1)


def other_part() -> None:
    """Those of heights, forests and context."""
    xyz = _cloud()
    _heights(xyz)
    shares = np.zeros((len(xyz), 2), np.uint16)
    tokens = (OWN, *TrainingOptions().context)  # shipped models read the point's own as well
    tables = Context.parse(tokens).tables(xyz, shares, threads=1)
    tables.fill(np.arange(len(xyz)), np.empty((len(xyz), 2 * len(tables.tokens)), np.float32))
    leaf = np.zeros(1, np.float32), np.ones((1, 2), np.uint32)
    represent(xyz, 1.0)
    ranked = Ranked.of(np.zeros((2, 1), np.float32), threads=1)
    tree = grow_tree(ranked, np.arange(2), np.ones(2, np.int64), tried=1, seed=0)
    tree.shares(ranked, np.arange(2))
    Forest(np.ones(1, np.int32), np.full(1, -1, np.int16), *leaf, n_features=1).predict_proba(
        np.zeros((1, 1), np.float32)
    )


def _cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.0, 12.0, (400, 3))


def _bridge() -> np.ndarray:
    """A deck over a valley, with land at both of its ends: what is asked of decks is asked only where one may be."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-120.0, 120.0), np.arange(-80.0, 80.0)))
    return np.column_stack([x, y, np.where(abs(y) <= 4.0, 6.0, np.clip((abs(x) - 15.0) / 7.5, 0.0, 6.0))])


def _heights(xyz: np.ndarray) -> dict[str, np.ndarray]:
    axes = np.ascontiguousarray(xyz.T)
    detached_noise(*axes)
    filtered_ground(*np.ascontiguousarray(_bridge().T), openings=(5,), decks=True, threads=1)
    dimensions = filtered_ground(*axes, openings=(5,), threads=1)
    dimensions["HeightAboveGround"] = hag_minima(*axes)
    return dimensions
