"""Parts of the training ground that are held out in turn: whole surveys where there are several, else strips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

#: Fewer surveys than this are cut into strips instead: too little would be left to train on.
SURVEYS = 3


def point_folds(
    clouds: Sequence[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]], surveys: Sequence[str], folds: int
) -> tuple[list[npt.NDArray[np.int16]], int]:
    """The fold of every point, and how many folds there are.

    Parameters
    ----------
    clouds : sequence of ((n, 3) float64 coordinates in metres, (n,) class positions)
        A position of -1 is not trained on.
    surveys : sequence of str
        The survey of each cloud.
    folds : int
        How many are wanted; there are fewer where there are fewer surveys.

    Notes
    -----
    Neither the order of points nor that of clouds matters.
    """
    names = sorted(set(surveys))
    if len(names) < SURVEYS:
        return [strips(xyz, position, folds) for xyz, position in clouds], folds
    folds = min(folds, len(names))
    labelled = dict.fromkeys(names, 0)
    for (_, position), name in zip(clouds, surveys, strict=True):
        labelled[name] += int(np.count_nonzero(position >= 0))
    load = [0] * folds
    fold_of = {}
    for name in sorted(names, key=lambda one: (-labelled[one], one)):
        fold_of[name] = load.index(min(load))
        load[fold_of[name]] += max(labelled[name], 1)
    made = [
        np.full(len(xyz), fold_of[name], np.int16) for (xyz, _), name in zip(clouds, surveys, strict=True)
    ]
    return made, folds


def strips(xyz: npt.NDArray[np.float64], position: npt.NDArray[Any], folds: int) -> npt.NDArray[np.int16]:
    """Strips across the longer side of the labelled ground, each with as many labelled points."""
    labelled = np.flatnonzero(position >= 0)
    if not len(labelled):
        return np.zeros(len(xyz), np.int16)
    axis = int(np.argmax(np.ptp(xyz[labelled, :2], axis=0)))
    along = np.sort(xyz[labelled, axis])
    edges = along[[len(along) * k // folds for k in range(1, folds)]]
    return np.searchsorted(edges, xyz[:, axis], side="right").astype(np.int16)
