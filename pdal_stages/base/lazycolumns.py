"""Columns of values that are made where they are looked at, a part at a time, instead of being held for all points."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray


class LazyColumn(ABC):
    """(n,) values; an index gives an array, and so does NumPy of all."""

    def __init__(self, count: int, dtype: np.dtype) -> None:
        self.shape, self.dtype = (count,), dtype

    @abstractmethod
    def __getitem__(self, index: Any) -> NDArray: ...

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        return np.asarray(self[slice(None)], dtype)


class Taken(LazyColumn):
    """Values of some rows of a table: ``values[rows]``."""

    def __init__(self, values: NDArray, rows: NDArray) -> None:
        super().__init__(len(rows), values.dtype)
        self._values, self._rows = values, rows

    def __getitem__(self, index: Any) -> NDArray:
        return self._values[self._rows[index]]


def as_column(values: Any) -> Any:
    """`values` as an array, or as the lazy column that they are."""
    return values if isinstance(values, LazyColumn) else np.asarray(values)
