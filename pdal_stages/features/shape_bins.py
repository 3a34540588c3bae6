"""Thresholds of shape distributions' bins, which sample neighborhoods fill evenly [B16 3.2.2]."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ..base.errors import OptionError
from .registry import SHAPE_BINS, SHAPES

#: The metrics, in the order of the rows of all threshold arrays.
METRICS = tuple(SHAPES)
#: Inner thresholds of the bins.
INNER = SHAPE_BINS - 1
#: How a metric in radians or meters becomes the value that kernels compare, and the way back.
COMPARABLE: dict[str, tuple[Callable, Callable]] = {
    "A3": (
        lambda t: -np.cos(t) * np.abs(np.cos(t)),
        lambda v: np.arccos(np.clip(-np.sign(v) * np.sqrt(np.abs(v)), -1, 1)),
    ),
    "D1": (np.square, np.sqrt),
    "D2": (np.square, np.sqrt),
    "D3": (lambda t: 4 * t**4, lambda v: (v / 4) ** 0.25),
    "D4": (lambda t: 6 * t**3, lambda v: np.cbrt(v / 6)),
}

_CURE = "Fit the thresholds again, or take them from the model file as it was written"


class ShapeBins:
    """Bins of A3 (radians) and D1, D2, D3, D4 (meters) for each neighborhood.

    Bin i holds the values with ``threshold[i - 1] < value <= threshold[i]``; the first and the
    last bin are open.

    Parameters
    ----------
    thresholds : mapping of str to (5, 9) array
        Neighborhood token -> ascending inner thresholds of A3, D1, D2, D3, D4, in radians and
        meters.

    Raises
    ------
    OptionError
        Where thresholds are not 5 x 9 finite, ascending numbers, angles outside 0..pi or lengths
        below 0.
    """

    def __init__(self, thresholds: Mapping[str, Any]) -> None:
        self._thresholds = {
            str(token): _check(str(token), rows) for token, rows in thresholds.items()
        }

    @classmethod
    def fit(cls, values: Mapping[str, np.ndarray]) -> ShapeBins:
        """Return thresholds at the 10 %, 20 %, ... 90 % quantiles of sample values.

        A threshold is one of the values, so values that often repeat (areas of 0 on a line) make
        equal thresholds and empty bins, and nothing else does. `values` are the pulls (m, 5, 255)
        of m sample neighborhoods by neighborhood token, in the comparable form of
        :func:`shape_distributions.shape_values`. NaN (neighborhoods without points) is left out;
        where nothing is left, the thresholds are 0.
        """
        result = {}
        for token, sample in values.items():
            rows = np.zeros((len(METRICS), INNER))
            rows[0] = -1.0  # an angle of 0
            for m in range(len(METRICS)):
                column = np.asarray(sample)[:, m, :].ravel()
                column = np.sort(column[np.isfinite(column)]).astype(np.float64)
                if len(column):
                    place = np.ceil(len(column) * np.arange(1, SHAPE_BINS) / SHAPE_BINS)
                    rows[m] = column[place.astype(int) - 1]
            result[token] = [
                COMPARABLE[name][1](row) for name, row in zip(METRICS, rows, strict=True)
            ]
        return cls(result)

    @property
    def tokens(self) -> tuple[str, ...]:
        """The neighborhoods there are thresholds for."""
        return tuple(self._thresholds)

    def thresholds(self, token: str) -> np.ndarray:
        """Return thresholds (metrics, 9) float64 of one neighborhood, in radians and meters."""
        try:
            return self._thresholds[token].copy()
        except KeyError:
            raise OptionError(
                f"there are no shape thresholds for the neighborhood '{token}'",
                found=", ".join(self._thresholds) or "none at all",
                cure="Fit them for the same neighborhoods that are computed",
            ) from None

    def comparable(self, tokens: Iterable[str]) -> np.ndarray:
        """Return thresholds as the kernels compare them: (neighborhoods, metrics, 9) float32."""
        rows = [
            COMPARABLE[name][0](row)
            for token in tokens
            for name, row in zip(METRICS, self.thresholds(token), strict=True)
        ]
        return np.array(rows, np.float32).reshape(-1, len(METRICS), INNER)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"c1": {"A3": [9 numbers], "D1": ...}, ...}``, JSON-able and exact."""
        return {
            token: {name: [float(v) for v in row] for name, row in zip(METRICS, rows, strict=True)}
            for token, rows in self._thresholds.items()
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ShapeBins:
        """Return the bins that :meth:`to_dict` described; OptionError for another description."""
        each = data.values() if isinstance(data, Mapping) else [None]
        if not all(isinstance(rows, Mapping) and set(rows) == set(METRICS) for rows in each):
            raise OptionError(
                f"shape thresholds must be those of {', '.join(METRICS)} of each neighborhood",
                found=repr(data)[:80],
                cure=_CURE,
            )
        return cls({token: [rows[name] for name in METRICS] for token, rows in data.items()})

    def __eq__(self, other: object) -> bool:
        """Return whether all thresholds are equal."""
        return isinstance(other, ShapeBins) and self.to_dict() == other.to_dict()


def _check(token: str, rows: Any) -> np.ndarray:
    """Return thresholds as an array (metrics, 9); OptionError where they cannot be."""
    try:
        array = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (len(METRICS), INNER):
        raise OptionError(
            f"the shape thresholds of '{token}' must be {INNER} numbers for each of "
            f"{', '.join(METRICS)}",
            cure=_CURE,
        )
    for name, row in zip(METRICS, array, strict=True):
        top = math.pi if name == "A3" else math.inf
        if not (
            np.isfinite(row).all() and (np.diff(row) >= 0).all() and row[0] >= 0 and row[-1] <= top
        ):
            raise OptionError(
                f"the {name} thresholds of '{token}' must be finite, ascending, and "
                + ("from 0 to pi" if name == "A3" else "not below 0"),
                found=", ".join(f"{v:g}" for v in row),
                cure=_CURE,
            )
    return array
