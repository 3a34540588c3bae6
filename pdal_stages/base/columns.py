"""Dimensions of points by name, each of which is read or computed when it is asked for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


class LazyColumns(Mapping[str, NDArray]):
    """Dimensions (n,) by name. Whether there is one is told without reading it."""

    @property
    @abstractmethod
    def names(self) -> Collection[str]:
        """Return the names of the dimensions."""

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of dimensions."""
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        """Return whether there is a dimension."""
        return name in self.names


@dataclass(eq=False)
class SomeRows(LazyColumns):
    """Dimensions of some points."""

    columns: Mapping[str, NDArray]
    rows: NDArray[np.int64]

    @property
    def names(self) -> Collection[str]:
        """Return the names of the dimensions."""
        return self.columns.keys()

    def __getitem__(self, name: str) -> NDArray:
        """Return a dimension (n,)."""
        return self.columns[name][self.rows]
