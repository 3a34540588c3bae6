"""Features of features: how the points of a neighborhood agree on the surface they lie on.

A point of the cloud gets what its 10 nearest neighbors make of it: the unit normal (eigenvector of l3) and the surface
variation (e3), 20 bytes a point, from the search for its own features where these are asked for. A neighborhood is then
summed up by the mean |n . n'| of its points' normals with the query's own, and by lowest, mean and standard deviation of
their surface variations: a roof's points agree, those of a crown do not, however flat any one of them may look.

A result depends on two steps of neighbors, so it reaches as far as the farthest of the neighbors' neighbors may lie. It
follows from the cloud as a set alone: neighbors come in the order of ``knn.py``, and all moments are taken about the point.
Without three points that do not all coincide there is no normal: it agrees with none, not even its own (0), and the
surface variation is 1/3, as everywhere.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device
from .eigen import covariance_features, normal3
from .moments import COINCIDENT, SX, SXX, SXY, SXZ, SY, SYY, SYZ, SZ, SZZ, N
from .moments import WIDTH as ROW
from .names import SURFACES

#: Columns of the table of surfaces: unit normal, surface variation, distance to the farthest of the 10 (infinite where
#: there are fewer).
NX, NY, NZ, VARIATION, REACH = range(5)
WIDTH = 5

#: What is made of a neighborhood, in the order of ``names.SURFACES``.
MADE = len(SURFACES)

#: A little more than 1, by which distances grow in float32 so that none is too short.
UP = 1.0 + 1e-6


@device(forceinline=True)
def surface(n, x, y, z, xx, xy, xz, yy, yz, zz):
    """Normal (0, 0, 0 for none) and surface variation of sums about the query, as ``moments.finish`` has them."""
    w = 1.0 / (n if n > 0.0 else 1.0)
    mx, my, mz = x * w, y * w, z * w
    ax, ay, az = xx * w, yy * w, zz * w
    cxx, cyy, czz = ax - mx * mx, ay - my * my, az - mz * mz
    cxy, cxz, cyz = xy * w - mx * my, xz * w - mx * mz, yz * w - my * mz
    apart = cxx + cyy + czz > COINCIDENT * (ax + ay + az)
    l1, l2, l3, nx, ny, nz = normal3(cxx, cxy, cxz, cyy, cyz, czz)
    real = (n >= 3.0) & apart
    variation = covariance_features(n if apart else 0.0, l1, l2, l3)[7]
    return (nx if real else 0.0), (ny if real else 0.0), (nz if real else 0.0), variation


@device
def surfaces_of(moments, count):
    """Normals and surface variations of so many columns of moments, (4, ROW) float64."""
    # Made here and of a constant shape: rows known not to overlap let the loop be vectorized.
    made = np.empty((4, ROW))
    for j in range(count):
        f = surface(
            moments[N, j], moments[SX, j], moments[SY, j], moments[SZ, j], moments[SXX, j], moments[SXY, j],
            moments[SXZ, j], moments[SYY, j], moments[SYZ, j], moments[SZZ, j],
        )  # fmt: skip
        made[NX, j] = f[0]
        made[NY, j] = f[1]
        made[NZ, j] = f[2]
        made[VARIATION, j] = f[3]
    return made


@device
def agreement(surfaces, at, d2, count, own, out):
    """The four features of the points ``at[:count]`` around a query of that surface, into ``out[:MADE]``.

    Returns
    -------
    float
        How far from the query points lie on which these depend, meters.
    """
    nx, ny, nz = own[NX], own[NY], own[NZ]
    first = np.float64(surfaces[at[0], VARIATION])
    agree = total = squares = far = 0.0
    low = first
    for i in range(count):
        p = at[i]
        agree += abs(nx * surfaces[p, NX] + ny * surfaces[p, NY] + nz * surfaces[p, NZ])
        v = np.float64(surfaces[p, VARIATION])
        low = min(low, v)
        d = v - first  # of equal ones the deviation is exactly 0
        total += d
        squares += d * d
        far = max(far, math.sqrt(d2[i]) + surfaces[p, REACH])
    w = 1.0 / count
    mean = total * w
    out[0] = min(agree * w, 1.0)
    out[1] = low
    out[2] = first + mean
    out[3] = math.sqrt(max(squares * w - mean * mean, 0.0))
    return far
