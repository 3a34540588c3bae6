"""Features of queries: an array with names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ..base.errors import suggest
from ..base.report import Report
from .shape_bins import ShapeBins


@dataclass
class FeatureTable:
    """Features of queries: an array with names, which NumPy and scikit-learn take as it is.

    pandas, too: ``pandas.DataFrame(table, columns=list(table))``.
    """

    values: np.ndarray  #: (m, F) float32
    names: tuple[str, ...]  #: of the columns
    #: As given or fitted, both; hand them to another call to get comparable features.
    bins: ShapeBins | None = None
    copt_threshold: float | None = None
    report: Report = field(default_factory=Report)  #: see :class:`FeatureEngine`

    def __len__(self) -> int:
        """Return the number of queries."""
        return len(self.values)

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of queries and features."""
        return self.values.shape

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        """Return the values, for NumPy."""
        return np.array(self.values, dtype) if copy else np.asarray(self.values, dtype)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names, as a data frame does."""
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        """Return whether there is a feature of that name."""
        return name in self.names

    def __getitem__(self, name: str | list[str]) -> np.ndarray:
        """Return the column of a name, a view; or those of several names, (m, names)."""
        if isinstance(name, list):
            return np.stack([self[each] for each in name], axis=1)
        if name not in self.names:
            raise KeyError(
                f"no feature '{name}' in this table. {suggest(name, self.names)}".strip()
            )
        return self.values[:, self.names.index(name)]
