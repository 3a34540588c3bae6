"""Percentiles of a model's inputs by class: what a value of a point is compared with."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

#: Percentiles of each input over the training samples of each class.
PERCENTILES = (1, 5, 25, 50, 75, 95, 99)
#: Bytes of JSON that the percentiles of a pass may take; larger ones are left out.
LIMIT_BYTES = 100_000

#: By input and class code, as text: the values at :data:`PERCENTILES`.
PercentileTable = dict[str, dict[str, list[float]]]


def percentiles_by_class(
    values: npt.NDArray[np.float32],
    label: npt.NDArray[np.integer],
    names: Sequence[str],
    codes: Sequence[int],
) -> PercentileTable | None:
    """Return the percentiles of training samples, or None where these take too many bytes.

    Parameters
    ----------
    values : (n, inputs) float32
        Inputs of the samples.
    label : (n,) int
        Positions of their classes in `codes`.
    names : sequence of str
        Names of the inputs.
    codes : sequence of int
        Class codes.
    """
    table: PercentileTable = {name: {} for name in names}
    for position, code in enumerate(codes):
        rows = np.flatnonzero(label == position)
        if not len(rows):
            continue
        for column, name in enumerate(names):
            row = np.percentile(values[rows, column], PERCENTILES, method="nearest")
            table[name][str(code)] = [float(f"{value:.4g}") for value in row]
    return table if len(json.dumps(table)) < LIMIT_BYTES else None


def share_below(value: float, percentiles: Sequence[float]) -> float:
    """Return the share of training samples with lower values, by :data:`PERCENTILES`.

    Of values that many samples have it is the middle of their shares.
    """
    known = np.array([-np.inf, *percentiles, np.inf])
    shares = np.array([0.0, *PERCENTILES, 100.0]) / 100.0
    first, end = (int(np.searchsorted(known, value, side)) for side in ("left", "right"))
    if end > first:  # some have this very value
        return float(shares[first] + shares[end - 1]) / 2.0
    low, high = known[first - 1], known[first]
    part = (value - low) / (high - low) if np.isfinite(high - low) else 0.5
    return float(shares[first - 1] + part * (shares[first] - shares[first - 1]))
