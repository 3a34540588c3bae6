"""Dimensions that say the class by themselves: a copy of the labels among what a model is trained on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from .dimensions import COORDINATES

#: Mean share of each class's points that one dimension must tell to be told of.
SUSPECT = 0.98
#: Points looked at of each class in each cloud, and the fewest that say anything.
_LOOKED_AT, _FEWEST = 1000, 20
#: What a small tree may tell apart.
_LEAVES = 64
#: Made of coordinates, so that telling much is their merit.
_OF_COORDINATES = ("HeightAbove", "Ground", "Slope")


def telltale(
    values: Iterable[tuple[dict[str, npt.NDArray[Any]], npt.NDArray[np.int16]]], seed: int = 0
) -> dict[str, float]:
    """Dimensions that tell the classes almost alone, and which share of points they tell.

    A small decision tree on each dimension by itself is grown on half of a sample and tried on the other half. Heights
    and what else is made of coordinates are left out: in a plain scene height does tell roofs from ground.

    Parameters
    ----------
    values : iterable of (mapping, (n,) int)
        Of each cloud its dimensions, and the place of each point's class, -1 where it is not used.

    Returns
    -------
    dict
        Name to the mean over the classes of the share that was told right, where that is :data:`SUSPECT` or more.
    """
    rng = np.random.default_rng(seed)
    columns: dict[str, list[npt.NDArray[np.float64]]] = {}
    classes: list[npt.NDArray[np.int16]] = []
    for dimensions, position in values:
        rows = _some_of_each(position, rng)
        classes.append(position[rows])
        for name, column in dimensions.items():
            if name not in COORDINATES and not name.startswith(_OF_COORDINATES):
                columns.setdefault(name, []).append(np.asarray(column)[rows].astype(np.float64))
    if not columns or not classes:
        return {}
    known = np.concatenate(classes)
    if len(known) < _FEWEST or len(np.unique(known)) < 2:
        return {}
    half = rng.permutation(len(known)) % 2 == 0
    found = {}
    for name, parts in columns.items():
        if len(parts) != len(classes):  # not in every cloud
            continue
        share = _told(np.concatenate(parts), known, half)
        if share >= SUSPECT:
            found[name] = round(share, 4)
    return found


def _some_of_each(position: npt.NDArray[np.int16], rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Rows of some points of each class."""
    rows = []
    for place in np.unique(position[position >= 0]):
        there = np.flatnonzero(position == place)
        rows.append(there if len(there) <= _LOOKED_AT else rng.choice(there, _LOOKED_AT, replace=False))
    return np.sort(np.concatenate(rows)) if rows else np.empty(0, np.int64)


def _told(
    column: npt.NDArray[np.float64], known: npt.NDArray[np.int16], half: npt.NDArray[np.bool_]
) -> float:
    from sklearn.tree import DecisionTreeClassifier

    values = np.nan_to_num(column.astype(np.float32))[:, None]
    tree = DecisionTreeClassifier(max_leaf_nodes=_LEAVES, class_weight="balanced", random_state=0)
    right = tree.fit(values[half], known[half]).predict(values[~half]) == known[~half]
    places = np.unique(known[~half])
    return float(np.mean([right[known[~half] == place].mean() for place in places]))
