"""Features of features: how the points of a neighborhood agree on the surface they lie on.

A point of the cloud gets what its 10 nearest neighbors make of it: the unit normal (eigenvector of
l3) and the surface variation (e3), 20 bytes a point. A neighborhood is then summed up by the mean
|n . n'| of its points' normals with the query's own, and by lowest, mean and standard deviation of
their surface variations: a roof's points agree, those of a crown do not, however flat any one of
them may look. So a result reaches as far as the neighbors' neighbors may lie. Without three points
that do not all coincide there is no normal: it agrees with none, not even its own (0), and the
surface variation is 1/3, as everywhere.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device
from .moments import FEATURES
from .moments import ROW as MOMENT_ROW
from .registry import SURFACE_FEATURES, rows_of

#: Columns of the table of surfaces, float32: the unit normal, the surface variation, and the meters
#: to the farthest of the 10 neighbors, infinite where there are fewer.
S = rows_of("NX", "NY", "NZ", "VARIATION", "FAR")

#: Where :func:`moments.finish` writes what the 10 nearest make, all but the reach.
COLUMNS = np.full(FEATURES, -1)
COLUMNS[MOMENT_ROW.SurfaceVariation] = S.VARIATION
COLUMNS[[MOMENT_ROW.NormalX, MOMENT_ROW.NormalY, MOMENT_ROW.NormalZ]] = S.NX, S.NY, S.NZ

#: Rows of the features that :func:`agreement` computes.
ROW = rows_of(*SURFACE_FEATURES)

#: A little more than 1, by which distances grow in float32 so that none is too short.
UP = 1.0 + 1e-6


@device(forceinline=True)
def _write(out, column, value):
    """Write a value to its column, if it is wanted."""
    if column >= 0:
        out[column] = value


@device(forceinline=True)
def agreement(surfaces, near, count, columns, out):
    """Write features of the first `count` neighbors of a query, a point of the cloud.

    `columns` has the column of `out` for each of :data:`ROW`; -1: not wanted. Returns the distance
    in meters from the query to the farthest point that the features depend on.
    """
    wanted = False
    for row in range(len(columns)):
        wanted |= columns[row] >= 0
    if not wanted:
        return 0.0
    query = near.at[near.pos[0]]
    nx, ny = np.float64(surfaces[query, S.NX]), np.float64(surfaces[query, S.NY])
    nz = np.float64(surfaces[query, S.NZ])
    first = np.float64(surfaces[query, S.VARIATION])
    agree = total = squares = far = 0.0
    low = first
    for i in range(count):
        p = near.at[near.pos[i]]
        agree += abs(nx * surfaces[p, S.NX] + ny * surfaces[p, S.NY] + nz * surfaces[p, S.NZ])
        v = np.float64(surfaces[p, S.VARIATION])
        low = min(low, v)
        d = v - first  # of equal ones the deviation is exactly 0
        total += d
        squares += d * d
        far = max(far, math.sqrt(near.sorted[i]) + surfaces[p, S.FAR])
    w = 1.0 / count
    mean = total * w
    deviation = math.sqrt(max(squares * w - mean * mean, 0.0))
    _write(out, columns[ROW.NormalAgreement], min(agree * w, 1.0))
    _write(out, columns[ROW.SurfaceVariationMin], low)
    _write(out, columns[ROW.SurfaceVariationMean], first + mean)
    _write(out, columns[ROW.SurfaceVariationStd], deviation)
    return max(far, np.float64(surfaces[query, S.FAR]))
