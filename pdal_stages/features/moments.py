"""Moments of neighborhoods, summed over candidates within a radius, and the features made of them."""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import FAST, device, njit
from .eigen import bits_of, cbrt_fast, eigen3, entropy_term, from_bits
from .neighborhoods import LEAST_RADIUS
from .registry import MOMENT_FEATURES, rows_of

#: Rows of a table of moments about the queries: count, sums, products, lowest and highest height;
#: and, where it is chosen query by query, the radius (meters) and how far away points matter to
#: the choice.
N, SX, SY, SZ, SXX, SXY, SXZ, SYY, SYZ, SZZ, LOW, HIGH, RADIUS, REACH = range(14)
MOMENTS, ROWS = 12, 14

#: Rows of the features that :func:`finish` computes, and of the unit normal.
ROW = rows_of(*MOMENT_FEATURES, "NormalX", "NormalY", "NormalZ")
FEATURES = len(ROW)

#: Queries finished at a time: small enough for the second-level cache. And columns of their
#: scratch: not a power of two, whose rows would compete for the same cache lines.
BATCH = 256
WIDTH = BATCH + 8

#: A variance below this part of the mean squared distance to the query is rounding: the points
#: coincide.
COINCIDENT = 1e-13

_MOST = np.int64(2**63 - 1)


@device(forceinline=True)
def height_key(z):
    """An int64 that orders like the float64 (minima of integers are vectorized, of floats they are not)."""
    bits = bits_of(z)
    return bits ^ ((bits >> 63) & _MOST)


@device(forceinline=True)
def height_of(key):
    return from_bits(key ^ ((key >> 63) & _MOST))


@device(forceinline=True)
def distance2(dx, dy, dz, spherical):
    """Squared distance, in the plane where `spherical` is 0, rounded as NumPy rounds it: nothing here is contracted."""
    return dx * dx + dy * dy + spherical * (dz * dz)


@device(fastmath=set(FAST))
def sums_within(px, py, pz, keys, count, qx, qy, qz, spherical, r2, out, j):
    """Moments about (qx, qy, qz) of the first `count` candidates within sqrt(r2) of it, into ``out[:, j]``.

    `spherical` is 1 for a sphere and 0 for a cylinder. The order of the sums follows from `count`
    alone.
    """
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
def write_eigen_features(made, j, n, l1, l2, l3, nz):
    """Write the features of eigenvalues l1 >= l2 >= l3 of `n` points to column `j` of `made`, rows as of :data:`ROW`.

    `nz` is the height of the unit eigenvector of l3. With fewer than three points, or points that
    all coincide, features are 0 and the surface variation is 1/3 [H17].
    """
    total = l1 + l2 + l3
    real = (n >= 3) & (total > 0.0)
    scale = 1.0 / (total if real else 1.0)
    e1, e2, e3 = l1 * scale, l2 * scale, l3 * scale
    inverse = 1.0 / (l1 if real else 1.0)
    omnivariance = cbrt_fast(e1 * e2 * e3)
    entropy = entropy_term(e1) + entropy_term(e2) + entropy_term(e3)
    made[ROW.Linearity, j] = (l1 - l2) * inverse if real else 0.0
    made[ROW.Planarity, j] = (l2 - l3) * inverse if real else 0.0
    made[ROW.Scattering, j] = l3 * inverse if real else 0.0
    made[ROW.Omnivariance, j] = omnivariance if real else 0.0
    made[ROW.Anisotropy, j] = (l1 - l3) * inverse if real else 0.0
    made[ROW.Eigenentropy, j] = entropy if real else 0.0
    made[ROW.EigenvalueSum, j] = total if real else 0.0
    made[ROW.SurfaceVariation, j] = e3 if real else 1.0 / 3.0
    made[ROW.Verticality, j] = max(1.0 - abs(nz), 0.0) if n >= 3.0 else 0.0


@njit
def finish(table, volume, heights, few, copies, columns, out):
    """Write the features made of moments.

    With fewer than three points, or points that all coincide, eigen-features and Verticality are 0
    and SurfaceVariation is 1/3 [H17]; heights are those of the points there are; with none
    (queries that are not points of the cloud) 0.

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
    made, m = np.empty((FEATURES, WIDTH)), np.empty((7, WIDTH))
    for start in range(0, len(heights), BATCH):
        count = min(BATCH, len(heights) - start)
        moments = table[:, start : start + count]
        for j in range(count):
            n = moments[N, j]
            inverse = 1.0 / (n if n > 0.0 else 1.0)
            mx, my, mz = (
                moments[SX, j] * inverse,
                moments[SY, j] * inverse,
                moments[SZ, j] * inverse,
            )
            ax, ay, az = (
                moments[SXX, j] * inverse,
                moments[SYY, j] * inverse,
                moments[SZZ, j] * inverse,
            )
            xx, yy, zz = ax - mx * mx, ay - my * my, az - mz * mz
            apart = xx + yy + zz > COINCIDENT * (ax + ay + az)
            m[0, j], m[1, j], m[2, j] = xx, yy, zz
            m[3, j] = moments[SXY, j] * inverse - mx * my
            m[4, j] = moments[SXZ, j] * inverse - mx * mz
            m[5, j] = moments[SYZ, j] * inverse - my * mz
            # Not read from the moments again, which LLVM must fear to overlap with what is written.
            m[6, j] = n if apart else 0.0
            made[ROW.HeightRange, j] = moments[HIGH, j] - moments[LOW, j] if n > 0.0 else 0.0
            made[ROW.HeightStd, j] = math.sqrt(max(zz, 0.0)) if apart else 0.0
            made[ROW.HeightAboveLowest, j] = (
                heights[start + j] - moments[LOW, j] if n > 0.0 else 0.0
            )
        for j in range(count):
            r = max(moments[RADIUS, j], LEAST_RADIUS) if volume == 0.0 else 1.0
            made[ROW.Radius, j] = moments[RADIUS, j]
            made[ROW.Density, j] = moments[N, j] / (
                4.0 / 3.0 * math.pi * r * r * r if volume == 0.0 else volume
            )
        for j in range(count):
            n = m[6, j]
            l1, l2, l3, nx, ny, nz = eigen3(m[0, j], m[3, j], m[4, j], m[1, j], m[5, j], m[2, j])
            some = 1.0 if n >= 3.0 else 0.0
            made[ROW.NormalX, j], made[ROW.NormalY, j], made[ROW.NormalZ, j] = (
                some * nx,
                some * ny,
                some * nz,
            )
            write_eigen_features(made, j, n, l1, l2, l3, nz)
        for j in range(count):
            if moments[N, j] < 3.0:
                few[0] += copies[start + j]
        for f in range(len(columns)):
            if columns[f] >= 0:
                for j in range(count):
                    out[start + j, columns[f]] = made[f, j]
