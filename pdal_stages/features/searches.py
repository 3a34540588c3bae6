"""What is searched for adaptive neighborhoods: radii and numbers of neighbors to choose from.

[H17] He, Chen, Wang, Liu 2017, ISPRS Archives XLII-2/W7: ``copt`` looks at the curvature (surface
variation) of the sphere of 1 m first: where it is at least c_t the point is *scattered* and takes
the best k of 10..50 within 3 m, otherwise it is *regular* and takes the best radius of 0.5..2 m.
The threshold c_t follows from the curvatures of the whole cloud.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .moments import STRUCTURE_MEMBERS
from .neighborhoods import COPT_REACH, RADIUS_MEMBERS, Neighborhood
from .registry import rows_of

#: Radius of the sphere whose curvature is looked at, meters [H17]. One of the radii of COPT_RADII:
#: :func:`_curvature` takes it from among them.
CURVATURE_RADIUS = 1.0
#: Curvature of a point with too few neighbors [H17].
SCATTERED = 1.0 / 3.0

#: ``copt``: first and last radius and step of regular points, meters [H17].
COPT_RADII = (0.5, 2.0, 0.05)
#: ``copt``: fewest and most neighbors of scattered points [H17].
COPT_K = (10, 50)

#: Columns of :attr:`Search.choices`: the first candidate among radii and ks, the one behind the
#: last, and the members that a candidate needs.
CHOICE = rows_of("first", "end", "members")


def radii_of(first: float, last: float, step: float) -> np.ndarray:
    """Return the radii first, first + step, ... up to `last`, rounded to nanometers.

    >>> radii_of(0.25, 0.4, 0.05).tolist()
    [0.25, 0.3, 0.35, 0.4]
    """
    count = math.floor((last - first) / step + 1e-9) + 1
    return np.round(first + step * np.arange(count), 9)


def curvature_threshold(curvatures: np.ndarray) -> float:
    """Return the curvature from which on a point is scattered [H17 eq. 1-3].

    ValueError where `curvatures` (n,) are not all finite, or n is 0.

    Two means, started at the smallest and the largest value, give the centers cur1 and cur2 of two
    groups of n1 and n2 = n - n1 values; c_t = cur1 + (cur2 - cur1) n2 / n. Where all values are
    equal that is the value, and all points are scattered, which needs no radius to hold enough
    points.
    """
    values = np.sort(np.asarray(curvatures, dtype=np.float64).ravel())
    n = len(values)
    if not n or not np.isfinite(values[-1]) or not np.isfinite(values[0]):
        raise ValueError("curvatures must be finite numbers, at least one")
    sums = np.concatenate(([0.0], np.cumsum(values)))
    low, high = values[0], values[-1]
    split = -1
    while low < high:
        before, split = split, int(np.searchsorted(values, 0.5 * (low + high), side="right"))
        split = min(max(split, 1), n - 1)
        if split == before:
            break
        low, high = sums[split] / split, (sums[n] - sums[split]) / (n - split)
    return float(low + (high - low) * (n - split) / n) if low < high else float(low)


class Search(NamedTuple):
    """Neighborhoods that one search serves, as kernels take them."""

    numbers: np.ndarray  # (n,) int64: which of a plan's
    radii: np.ndarray  # (r,) float64, ascending, meters
    ks: np.ndarray  # (k,) int64: neighbors besides the point itself, ascending
    within2: float  # all points within this squared distance are wanted
    cap2: float  # and of those within this one as many as the last of `ks` says
    choices: np.ndarray  # (n, 3) int64: columns as in CHOICE
    curved: bool = False  # copt: radii where the point is regular, ks where it is scattered
    threshold: float = math.nan  # curvature from which on a point is scattered
    by_dimensionality: bool = False  # rdim: the lowest entropy of dimensionality is taken


def search_of_numbers(ranges: Mapping[int, tuple[int, int]]) -> Search:
    """Return one search for ranges of numbers of neighbors, by the neighborhood's number."""
    all_ks = {k for first, last in ranges.values() for k in range(first, last + 1)}
    ks = np.array(sorted(all_ks), np.int64)
    choices = [
        [np.searchsorted(ks, first), np.searchsorted(ks, last) + 1, STRUCTURE_MEMBERS]
        for first, last in ranges.values()
    ]
    numbers = np.array(list(ranges), np.int64)
    return Search(numbers, np.zeros(0), ks, 0.0, math.inf, np.array(choices, np.int64))


def search_of_curvature() -> Search:
    """Return the search for the curvature of points alone."""
    none, radius = np.zeros(0, np.int64), np.array([CURVATURE_RADIUS])
    within2 = CURVATURE_RADIUS * CURVATURE_RADIUS
    return Search(none, radius, none, within2, within2, np.zeros((0, 3), np.int64), True)


def searches_for(neighborhoods: Sequence[Neighborhood]) -> list[Search]:
    """Return the searches for adaptive neighborhoods: one for all numbers of neighbors first."""
    ranges, searches = {}, []
    for number, neighborhood in enumerate(neighborhoods):
        if neighborhood.reach is None:
            ranges[number] = int(neighborhood.parameters[0]), int(neighborhood.parameters[-1])
            continue
        radii = radii_of(*(neighborhood.parameters or COPT_RADII))
        within2 = float(radii[-1] * radii[-1])
        choices = np.array([[0, len(radii), RADIUS_MEMBERS]], np.int64)
        ks, numbers = np.zeros(0, np.int64), np.array([number], np.int64)
        search = Search(numbers, radii, ks, within2, within2, choices)
        if neighborhood.kind == "copt":
            ks = np.arange(COPT_K[0], COPT_K[1] + 1)
            search = search._replace(ks=ks, cap2=COPT_REACH * COPT_REACH, curved=True)
        elif neighborhood.kind == "rdim":
            search = search._replace(by_dimensionality=True)
        searches.append(search)
    return ([search_of_numbers(ranges)] if ranges else []) + searches
