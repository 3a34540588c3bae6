"""Parts of the training ground that are held out in turn: whole surveys where there are several, else strips."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError

#: Fewer surveys than this are cut into strips instead: too little would be left to train on.
SURVEYS = 3
#: Width of a strip in metres, halved until there are enough of them.
WIDTH, NARROWEST = 10.0, 0.01


@dataclass(frozen=True)
class Folds:
    """Which part of the training ground a point belongs to.

    Attributes
    ----------
    count : int
    surveys : dict of str to int, or None
        Fold of each survey, where whole surveys are folds.
    width : float
        Metres of a strip along the diagonal otherwise; every `count`-th strip is of the same fold.
    """

    count: int
    surveys: dict[str, int] | None = None
    width: float = WIDTH

    @classmethod
    def of(
        cls,
        clouds: Iterable[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]],
        surveys: Sequence[str],
        count: int,
    ) -> Folds:
        """Folds of these clouds.

        Parameters
        ----------
        clouds : iterable, again and again, of ((n, 3) float64 coordinates in metres, (n,) class positions)
            A position of -1 is not trained on.
        surveys : sequence of str
            The survey of each cloud.
        count : int
            How many are wanted; there are fewer where there are fewer surveys.

        Raises
        ------
        OptionError
            The labelled ground is too small to be cut.
        """
        names = sorted(set(surveys))
        if len(names) >= SURVEYS:
            labelled = dict.fromkeys(names, 0)
            for (_, position), name in zip(clouds, surveys, strict=True):
                labelled[name] += int(np.count_nonzero(position >= 0))
            load = [0] * min(count, len(names))
            fold_of = {}
            for name in sorted(names, key=lambda one: (-labelled[one], one)):
                fold_of[name] = load.index(min(load))
                load[fold_of[name]] += max(labelled[name], 1)
            return cls(len(load), fold_of)
        width = WIDTH
        while width >= NARROWEST:
            there: set[int] = set()
            for xyz, position in clouds:
                there.update(np.unique(_strip(xyz[position >= 0], width)).tolist())
            if len({strip % count for strip in there}) == count:
                return cls(count, None, width)
            width /= 2.0
        raise OptionError(
            f"the labelled ground is too small to be cut into {count} parts",
            cure="Give more training data, or set passes to 1",
        )

    def points(self, xyz: npt.NDArray[np.float64], survey: str) -> npt.NDArray[np.int16]:
        """The fold of each point of a cloud."""
        if self.surveys is not None:
            return np.full(len(xyz), self.surveys[survey], np.int16)
        return (_strip(xyz, self.width) % self.count).astype(np.int16)


def _strip(xyz: npt.NDArray[np.float64], width: float) -> npt.NDArray[np.int64]:
    """Strips across the diagonal, anchored to absolute coordinates: copies of a cloud share them."""
    return np.floor((xyz[:, 0] + xyz[:, 1]) * (np.sqrt(0.5) / width)).astype(np.int64)
