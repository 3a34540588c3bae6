"""The calibration of `review`, learned from surveys that a model had not seen (see review.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdal_stages.review.expected import BOUNDS, LEAST, MOST

#: How far signals are believed on a survey that was not learned from: factors are raised to it. Half leaves what is expected
#: midway between what reliability and height say alone and what the surveys that were learned from say.
TRUST = 0.5


def learned_rates(
    wrong: NDArray[np.float64], known: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(4, reliabilities, heights) share of wrong points in each bin.

    Parameters
    ----------
    wrong, known : (surveys, 4, reliabilities, heights) float64
        Points.
    weight : (surveys,) float64
        Of a point of each survey.

    A bin with few points leans on its reliability over all heights, and that on its group.
    """
    along = weight[:, None, None, None]
    w, k = (wrong * along).sum(axis=0), (known * along).sum(axis=0)
    few = 300.0
    group = (w.sum(axis=(1, 2), keepdims=True) + 1.0) / (k.sum(axis=(1, 2), keepdims=True) + 50.0)
    level = (w.sum(axis=2, keepdims=True) + few * group) / (k.sum(axis=2, keepdims=True) + few)
    return np.clip((w + few * level) / (k + few), LEAST, MOST)


def learned_factors(
    bins: NDArray[np.int64],
    rate: NDArray[np.float64],
    wrong: NDArray[np.float64],
    known: NDArray[np.float64],
    weight: NDArray[np.float64],
    strength: float = 300.0,
    rounds: int = 25,
    trust: float = TRUST,
) -> tuple[float, tuple[NDArray[np.float64], ...]]:
    """The factor of each bin of each signal that makes expected and true numbers agree in all bins.

    Iterative proportional fitting of a Poisson rate, each factor drawn toward 1 as if `strength` weighted errors more
    agreed with it; in the end all are raised to `trust`.

    Parameters
    ----------
    bins : (n, signals)
    rate, wrong, known, weight : (n,) float64
    """
    expected = rate * known * weight
    true = wrong * weight
    base = float(true.sum() / max(expected.sum(), 1e-9))
    factors = [np.ones(len(bounds) + 1) for bounds in BOUNDS.values()]
    now = expected * base
    for _ in range(rounds):
        for column, factor in enumerate(factors):
            one = bins[:, column]
            e = np.bincount(one, now, len(factor))
            t = np.bincount(one, true, len(factor))
            # Half a step: signals say much the same, and would overshoot together.
            change = np.sqrt((t + strength * 1.0) / (e + strength * factor))
            factor *= change
            now *= change[one]
        change = true.sum() / max(now.sum(), 1e-9)
        base *= change
        now *= change
    return base**trust, tuple(factor**trust for factor in factors)
