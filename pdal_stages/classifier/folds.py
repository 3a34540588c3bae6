"""Parts of the training ground that are held out in turn: whole surveys or groups where there are several, else strips."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError

#: A cloud's survey, or the (n,) group of each of its points.
Groups = str | npt.NDArray[Any]
#: Fewer of them than this are cut into strips instead: too little would be left to train on.
SURVEYS = 3
#: Width of a strip in metres, halved until there are enough of them.
WIDTH, NARROWEST = 10.0, 0.01


@dataclass(frozen=True)
class Folds:
    """Which part of the training ground a point belongs to.

    Attributes
    ----------
    count : int
    of_group : dict, or None
        Fold of each survey or group, where whole ones are folds.
    width : float
        Metres of a strip along the diagonal otherwise; every `count`-th strip is of the same fold.
    """

    count: int
    of_group: dict[Any, int] | None = None
    width: float = WIDTH

    @classmethod
    def of(
        cls,
        clouds: Iterable[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]],
        groups: Sequence[Groups],
        count: int,
    ) -> Folds:
        """Folds of these clouds.

        Parameters
        ----------
        clouds : iterable, again and again, of ((n, 3) float64 coordinates in metres, (n,) class positions)
            A position of -1 is not trained on.
        groups : sequence of str or (n,) array
            The survey of each cloud, or the group of each of its points.
        count : int
            How many are wanted; there are fewer where there are fewer surveys or groups.

        Raises
        ------
        OptionError
            The labelled ground is too small to be cut.
        """
        labelled = _labelled(clouds, groups)
        if len(labelled) >= SURVEYS:
            load = [0] * min(count, len(labelled))
            fold_of = {}
            for name in sorted(labelled, key=lambda one: (-labelled[one].sum(), one)):
                fold_of[name] = load.index(min(load))
                load[fold_of[name]] += max(int(labelled[name].sum()), 1)
            if all(isinstance(one, str) for one in groups) or _none_lacks_a_class(labelled, fold_of):
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

    def points(self, xyz: npt.NDArray[np.float64], group: Groups) -> npt.NDArray[np.int16]:
        """The fold of each point of a cloud of this survey, or of points of these groups."""
        if self.of_group is not None:
            if isinstance(group, str):
                return np.full(len(xyz), self.of_group[group], np.int16)
            names, index = np.unique(group, return_inverse=True)
            return np.array([self.of_group[name] for name in names.tolist()], np.int16)[index.reshape(-1)]
        return (_strip(xyz, self.width) % self.count).astype(np.int16)


def _labelled(
    clouds: Iterable[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]], groups: Sequence[Groups]
) -> dict[Any, npt.NDArray[np.int64]]:
    """How many points of each class a survey or group has."""
    found: dict[Any, npt.NDArray[np.int64]] = {}
    for (_, position), group in zip(clouds, groups, strict=True):
        used = position >= 0
        parts = [(group, used)] if isinstance(group, str) else []
        if not isinstance(group, str):
            parts = [(name, used & (group == name)) for name in np.unique(group).tolist()]
        for name, mine in parts:
            found[name] = found.get(name, np.zeros(256, np.int64)) + np.bincount(
                position[mine], minlength=256
            )
    return found


def _none_lacks_a_class(labelled: dict[Any, npt.NDArray[np.int64]], fold_of: dict[Any, int]) -> bool:
    """Whether outside each fold there is every class."""
    total = np.sum(list(labelled.values()), axis=0)
    for number in set(fold_of.values()):
        held = np.sum([labelled[name] for name, fold in fold_of.items() if fold == number], axis=0)
        if ((total > 0) & (total == held)).any():
            return False
    return True


def _strip(xyz: npt.NDArray[np.float64], width: float) -> npt.NDArray[np.int64]:
    """Strips across the diagonal, anchored to absolute coordinates: copies of a cloud share them."""
    return np.floor((xyz[:, 0] + xyz[:, 1]) * (np.sqrt(0.5) / width)).astype(np.int64)
