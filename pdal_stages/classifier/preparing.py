"""What makes the dimensions that a model reads, where coordinates are all there is.

The stages that do so stand above this room, which knows them by these questions alone.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt


class Preparing(Protocol):
    """Stages before a classifier, as a model file holds them."""

    def checked(self, preparation: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """The same in one spelling; :class:`ModelError` for what a model file may not ask for."""

    def preparation_of(self, names: Iterable[str]) -> list[dict[str, Any]]:
        """The stages that make these dimensions, as far as they are heights."""

    def made_of_coordinates(
        self,
        preparation: Sequence[Mapping[str, Any]],
        xyz: npt.NDArray[np.float64],
        usable: npt.NDArray[np.bool_] | None = None,
        threads: int | None = None,
    ) -> dict[str, npt.NDArray[Any]]:
        """The dimensions that the stages make; none where they need more than coordinates."""


def preparing() -> Preparing:
    """What knows the stages, imported when asked for."""
    return pkgutil.resolve_name("pdal_stages.stages.heights")
