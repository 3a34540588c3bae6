"""Moments of neighborhoods, summed over candidates within a radius, and features of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import FAST, device, njit
from .eigen import bits_of, cbrt_fast, eigen3, entropy_term, from_bits
from .neighborhoods import LEAST_RADIUS
from .registry import MOMENT_FEATURES, rows_of

# Rows of a table of moments about the queries.
N = 0  #: number of points
SX = 1  #: sum of x, and so on
SY = 2
SZ = 3
SXX = 4  #: sum of the products x x, and so on
SXY = 5
SXZ = 6
SYY = 7
SYZ = 8
SZZ = 9
LOW = 10  #: lowest z
HIGH = 11  #: highest z
RADIUS = 12  #: radius that was chosen for the query, meters
REACH = 13  #: meters to the farthest point that matters to the choice
#: Rows that are sums and extremes of points.
MOMENTS = RADIUS
ROWS = 14

#: Rows of the features that :func:`finish` computes, and of the unit normal, by name.
ROW = rows_of(*MOMENT_FEATURES, "NormalX", "NormalY", "NormalZ")
FEATURES = len(ROW)

#: Queries finished at a time: small enough for the second-level cache.
BATCH = 256
#: Columns of their scratch: not a power of two, whose rows would compete for the same cache lines.
WIDTH = BATCH + 8

#: Members that a neighborhood needs to have a structure.
LEAST_MEMBERS = 3

#: A variance below this part of the mean squared distance to the query is rounding: the points
#: coincide.
COINCIDENT = 1e-13

_MOST = np.int64(2**63 - 1)

# Rows of the scratch of :func:`finish`: a covariance matrix, and the number of its points, 0 where
# they all coincide.
XX = 0
YY = 1
ZZ = 2
XY = 3
XZ = 4
YZ = 5
COUNT = 6


class Candidates(NamedTuple):
    """Points that may be members of a neighborhood."""

    x: np.ndarray  # float64, meters
    y: np.ndarray
    z: np.ndarray
    keys: np.ndarray  # int64: :func:`height_key` of z


@device(forceinline=True)
def height_key(z):
    """Return an int64 that orders like the float64: minima of integers are vectorized."""
    bits = bits_of(z)
    return bits ^ ((bits >> 63) & _MOST)


@device(forceinline=True)
def height_of(key):
    """Return the float64 that :func:`height_key` made the key of."""
    return from_bits(key ^ ((key >> 63) & _MOST))


@device(forceinline=True)
def distance2(dx, dy, dz, spherical):
    """Return the squared distance, in the plane where `spherical` is 0, rounded as by NumPy."""
    return dx * dx + dy * dy + spherical * (dz * dz)


@device(fastmath=set(FAST))
def sums_within(candidates, count, point, spherical, r2, out, j):
    """Write moments about a point of the first `count` candidates within sqrt(r2) of it.

    They go to ``out[:, j]``. `spherical` is 1 for a sphere and 0 for a cylinder. The order of the
    sums follows from `count` alone.
    """
    px, py, pz, keys = candidates
    qx, qy, qz = point
    n = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    low, high = _MOST, -_MOST
    for i in range(count):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        inside = distance2(dx, dy, dz, spherical) <= r2
        dx, dy, dz = (dx if inside else 0.0), (dy if inside else 0.0), (dz if inside else 0.0)
        n += 1.0 if inside else 0.0
        sx += dx
        sy += dy
        sz += dz
        sxx += dx * dx
        sxy += dx * dy
        sxz += dx * dz
        syy += dy * dy
        syz += dy * dz
        szz += dz * dz
        key = keys[i]
        low = min(low, key if inside else _MOST)
        high = max(high, key if inside else -_MOST)
    out[N, j], out[SX, j], out[SY, j], out[SZ, j] = n, sx, sy, sz
    out[SXX, j], out[SXY, j], out[SXZ, j] = sxx, sxy, sxz
    out[SYY, j], out[SYZ, j], out[SZZ, j] = syy, syz, szz
    out[LOW, j], out[HIGH, j] = height_of(low), height_of(high)


@device(forceinline=True)
def write_eigen_features(values, j, n, l1, l2, l3, nz):
    """Write the features of eigenvalues l1 >= l2 >= l3 of `n` points to column `j` of `values`.

    A new eigen-feature is one line here, ``values[ROW.Name, j] = ...``, and one entry in the
    registry.
    `nz` is the height of the unit eigenvector of l3. With fewer than three points, or points that
    all coincide, features are 0 and the surface variation is 1/3 [H17].
    """
    total = l1 + l2 + l3
    real = (n >= LEAST_MEMBERS) & (total > 0.0)
    scale = 1.0 / (total if real else 1.0)
    e1, e2, e3 = l1 * scale, l2 * scale, l3 * scale
    inverse = 1.0 / (l1 if real else 1.0)
    omnivariance = cbrt_fast(e1 * e2 * e3)
    entropy = entropy_term(e1) + entropy_term(e2) + entropy_term(e3)
    values[ROW.Linearity, j] = (l1 - l2) * inverse if real else 0.0
    values[ROW.Planarity, j] = (l2 - l3) * inverse if real else 0.0
    values[ROW.Scattering, j] = l3 * inverse if real else 0.0
    values[ROW.Omnivariance, j] = omnivariance if real else 0.0
    values[ROW.Anisotropy, j] = (l1 - l3) * inverse if real else 0.0
    values[ROW.Eigenentropy, j] = entropy if real else 0.0
    values[ROW.EigenvalueSum, j] = total if real else 0.0
    values[ROW.SurfaceVariation, j] = e3 if real else 1.0 / 3.0
    values[ROW.Verticality, j] = max(1.0 - abs(nz), 0.0) if n >= LEAST_MEMBERS else 0.0


@device(forceinline=True)
def _center(moments, heights, count, m, values):
    """Write covariances about the means to `m`, and the features of heights to `values`."""
    for j in range(count):
        n = moments[N, j]
        inverse = 1.0 / (n if n > 0.0 else 1.0)
        mx, my, mz = moments[SX, j], moments[SY, j], moments[SZ, j]
        mx, my, mz = mx * inverse, my * inverse, mz * inverse
        ax, ay, az = moments[SXX, j], moments[SYY, j], moments[SZZ, j]
        ax, ay, az = ax * inverse, ay * inverse, az * inverse
        xx, yy, zz = ax - mx * mx, ay - my * my, az - mz * mz
        apart = xx + yy + zz > COINCIDENT * (ax + ay + az)
        m[XX, j], m[YY, j], m[ZZ, j] = xx, yy, zz
        m[XY, j] = moments[SXY, j] * inverse - mx * my
        m[XZ, j] = moments[SXZ, j] * inverse - mx * mz
        m[YZ, j] = moments[SYZ, j] * inverse - my * mz
        # Not read from the moments again, which LLVM must fear to overlap with what is written.
        m[COUNT, j] = n if apart else 0.0
        values[ROW.HeightRange, j] = moments[HIGH, j] - moments[LOW, j] if n > 0.0 else 0.0
        values[ROW.HeightStd, j] = math.sqrt(max(zz, 0.0)) if apart else 0.0
        values[ROW.HeightAboveLowest, j] = heights[j] - moments[LOW, j] if n > 0.0 else 0.0


@njit
def finish(table, volume, heights, few, copies, columns, out):
    """Write the features made of moments.

    With fewer than three points, or points that all coincide, eigen-features and Verticality are 0
    and SurfaceVariation is 1/3 [H17]; heights are those of the points there are; without any
    point (of queries that are not in the cloud) they are 0.

    Parameters
    ----------
    table : (ROWS, m) float64 array
    volume : float
        Area of the cylinder's base or volume of the sphere: what Density divides by; 0 where the
        table holds the radii.
    heights : (m,) float64 array
        z of the queries.
    few : (1,) int64 array
        Raised by the number of queries whose neighborhood has fewer than three points.
    copies : (m,) int64 array
        How many queries each column stands for.
    columns : (up to FEATURES,) int64 array
        Column of `out` (m, F) float32 for each row of :data:`ROW`; -1: not wanted. The normal is
        (0, 0, 0) where there is none.
    """
    # Of constant shapes: rows known not to overlap let the loops be vectorized.
    values, m = np.empty((FEATURES, WIDTH)), np.empty((COUNT + 1, WIDTH))
    for start in range(0, len(heights), BATCH):
        count = min(BATCH, len(heights) - start)
        moments = table[:, start : start + count]
        _center(moments, heights[start:], count, m, values)
        for j in range(count):
            r = max(moments[RADIUS, j], LEAST_RADIUS) if volume == 0.0 else 1.0
            values[ROW.Radius, j] = moments[RADIUS, j]
            values[ROW.Density, j] = moments[N, j] / (
                4.0 / 3.0 * math.pi * r * r * r if volume == 0.0 else volume
            )
        for j in range(count):
            n = m[COUNT, j]
            l1, l2, l3, nx, ny, nz = eigen3(
                m[XX, j], m[XY, j], m[XZ, j], m[YY, j], m[YZ, j], m[ZZ, j]
            )
            real = 1.0 if n >= LEAST_MEMBERS else 0.0
            values[ROW.NormalX, j] = real * nx
            values[ROW.NormalY, j] = real * ny
            values[ROW.NormalZ, j] = real * nz
            write_eigen_features(values, j, n, l1, l2, l3, nz)
        for j in range(count):
            if moments[N, j] < LEAST_MEMBERS:
                few[0] += copies[start + j]
        for f in range(len(columns)):
            if columns[f] >= 0:
                for j in range(count):
                    out[start + j, columns[f]] = values[f, j]
