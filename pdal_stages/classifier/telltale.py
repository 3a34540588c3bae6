"""Dimensions that say the class by themselves: a copy of the labels among what a model is trained on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.hashing import coordinate_hash
from .dimensions import COORDINATES

#: Mean share of each class's points that one dimension must tell to be told of.
SUSPECT = 0.98
#: Points looked at of each class in each cloud, and the fewest that say anything.
_LOOKED_AT, _FEWEST = 1000, 20
#: What a small tree may tell apart.
_LEAVES = 64
#: Made of coordinates, so that telling much is their merit.
_OF_COORDINATES = ("HeightAbove", "Ground", "Slope")


def telltale(values: Iterable[Labels]) -> dict[str, float]:
    """Dimensions that tell the classes almost alone, and which share of points they tell.

    A small decision tree on each dimension by itself is grown on half of a sample and tried on the other half. Heights
    and what else is made of coordinates are left out: in a plain scene height does tell roofs from ground. Points are
    chosen by a hash of their coordinates: the same ones in any order, and of a cloud in parts.

    Returns
    -------
    dict
        Name to the mean over the classes of the share that was told right, where that is :data:`SUSPECT` or more.
    """
    some: dict[tuple[object, int], _Chosen] = {}
    names: set[str] | None = None
    for part in values:
        there = {
            name: np.asarray(column)
            for name, column in part.dimensions.items()
            if name not in COORDINATES and not name.startswith(_OF_COORDINATES)
        }
        names = set(there) if names is None else names & set(there)  # in every cloud
        for place in np.unique(part.position[part.position >= 0]).tolist():
            rows = np.flatnonzero(part.position == place)
            some.setdefault((part.whole, place), _Chosen()).add(part.xyz, there, rows)
    if not names or not some:
        return {}
    known = np.repeat([place for _, place in some], [len(one) for one in some.values()])
    if len(known) < _FEWEST or len(np.unique(known)) < 2:
        return {}
    half = np.concatenate([np.arange(len(one)) % 2 == 0 for one in some.values()])
    found = {}
    for name in sorted(names):
        share = _told(np.concatenate([one.columns[name] for one in some.values()]), known, half)
        if share >= SUSPECT:
            found[name] = round(share, 4)
    return found


class Labels(NamedTuple):
    """A cloud, or a part of one."""

    whole: object  #: the same for the parts of one cloud
    xyz: npt.NDArray[np.float64]  #: (n, 3)
    dimensions: Mapping[str, npt.ArrayLike]  #: name to (n,) values
    position: npt.NDArray[np.int16]  #: (n,) the place of each point's class, -1 where it is not used


class _Chosen:
    """Values of some points of one class of one cloud: those of the least hashes."""

    def __init__(self) -> None:
        self._hashes = np.zeros(0, np.uint64)
        self.columns: dict[str, npt.NDArray[np.float64]] = {}

    def __len__(self) -> int:
        return len(self._hashes)

    def add(
        self,
        xyz: npt.NDArray[np.float64],
        columns: Mapping[str, npt.NDArray[Any]],
        rows: npt.NDArray[np.int64],
    ) -> None:
        """More points."""
        hashes = coordinate_hash(xyz[rows], 0)
        if len(hashes) > _LOOKED_AT:
            least = np.argpartition(hashes, _LOOKED_AT)[:_LOOKED_AT]
            hashes, rows = hashes[least], rows[least]
        both = np.concatenate([self._hashes, hashes])
        order = np.argsort(both, kind="stable")[:_LOOKED_AT]
        self._hashes = both[order]
        for name, column in columns.items():
            before = self.columns.get(name, np.zeros(0))
            self.columns[name] = np.concatenate([before, column[rows].astype(np.float64)])[order]


def _told(
    column: npt.NDArray[np.float64], known: npt.NDArray[np.int16], half: npt.NDArray[np.bool_]
) -> float:
    from sklearn.tree import DecisionTreeClassifier

    values = np.nan_to_num(column.astype(np.float32))[:, None]
    tree = DecisionTreeClassifier(max_leaf_nodes=_LEAVES, class_weight="balanced", random_state=0)
    right = tree.fit(values[half], known[half]).predict(values[~half]) == known[~half]
    places = np.unique(known[~half])
    return float(np.mean([right[known[~half] == place].mean() for place in places]))
