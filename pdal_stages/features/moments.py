"""Moments of cylinders and spheres as flat vectorized loops, and the features made of moments.

A neighborhood is one masked sum over the candidates its cell shares (``candidates.py``). A squared distance is
``(x - qx)**2 + (y - qy)**2`` rounded exactly as NumPy rounds it (nothing contracted): the members are the points
where it is ``<= r * r``. Only the sums may be reordered, by the vector loop, in an order that follows from the
number of candidates alone. Cylinders and spheres have a loop each, also where both are asked for with one radius,
so that neither depends on the other.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device
from .eigen import covariance_features, rotate_columns, steepness
from .lanes import (
    HIGH,
    LOW,
    MOMENTS,
    SX,
    SXX,
    SXY,
    SXZ,
    SY,
    SYY,
    SYZ,
    SZ,
    SZZ,
    N,
    sums_in_cylinder,
    sums_in_sphere,
)

#: Features made of them.
FEATURES = 13

#: Queries whose moments are held at a time: small enough for the second-level cache.
BATCH = 256

#: Columns of a moment table: not a power of two, whose rows would compete for the same cache lines.
WIDTH = BATCH + 8


#: A variance below this part of the mean squared distance to the query is rounding: the points coincide. Where moments were
#: taken about another point than the query first, the squared distance to that counts as well.
COINCIDENT = 1e-13


@device(forceinline=True)
def cylinder_sums(px, py, pz, qx, qy, qz, r2, out, j):
    """Moments about (qx, qy, qz) of the candidates within sqrt(r2) of it in x and y, into ``out[:, j]``.

    As many candidates as whole vectors of LANES, as ``candidates.gather`` leaves them.
    """
    sums = sums_in_cylinder(px, py, pz, qx, qy, qz, r2)
    for row in range(MOMENTS):
        out[row, j] = sums[row]


@device(forceinline=True)
def sphere_sums(px, py, pz, qx, qy, qz, r2, out, j):
    """Moments about (qx, qy, qz) of the candidates within sqrt(r2) of it, into ``out[:, j]``, as :func:`cylinder_sums`."""
    sums = sums_in_sphere(px, py, pz, qx, qy, qz, r2)
    for row in range(MOMENTS):
        out[row, j] = sums[row]


@device(forceinline=True)
def add_shared(inner, dx, dy, dz, out, j):
    """Add the moments ``inner[:, 0]``, taken about a point at (dx, dy, dz) from the query, to ``out[:, j]``."""
    n, sx, sy, sz = inner[N, 0], inner[SX, 0], inner[SY, 0], inner[SZ, 0]
    out[N, j] += n
    out[SX, j] += sx + n * dx
    out[SY, j] += sy + n * dy
    out[SZ, j] += sz + n * dz
    out[SXX, j] += inner[SXX, 0] + dx * (2.0 * sx + n * dx)
    out[SXY, j] += inner[SXY, 0] + dx * sy + dy * sx + n * dx * dy
    out[SXZ, j] += inner[SXZ, 0] + dx * sz + dz * sx + n * dx * dz
    out[SYY, j] += inner[SYY, 0] + dy * (2.0 * sy + n * dy)
    out[SYZ, j] += inner[SYZ, 0] + dy * sz + dz * sy + n * dy * dz
    out[SZZ, j] += inner[SZZ, 0] + dz * (2.0 * sz + n * dz)
    out[LOW, j] = min(out[LOW, j], inner[LOW, 0])
    out[HIGH, j] = max(out[HIGH, j], inner[HIGH, 0])


@device
def finish(moments, count, volumes, moved, heights, few, copies):
    """The thirteen features made of moments, of `count` neighborhoods, from their moments.

    Parameters
    ----------
    moments : (12, m) float64 array
        Moments about the queries, in the first columns.
    count : int
        How many: at most BATCH.
    volumes : (count,) float64 array
        Area of the cylinder's base or volume of the sphere: what Density divides by.
    moved : float
        How far, squared, moments may have been moved by :func:`add_shared`; 0 where none were.
    heights : (count,) float64 array
        z of the queries.
    few : (1,) int64 array
        Raised by the number of queries whose neighborhood has fewer than three points.
    copies : (count,) int64 array
        How many queries each column stands for.

    Returns
    -------
    (13, BATCH) float64 array, of which `count` columns are filled
        Linearity, Planarity, Scattering, Omnivariance, Anisotropy, Eigenentropy, EigenvalueSum,
        SurfaceVariation, Density, Verticality, HeightRange, HeightStd, HeightAboveLowest.

    Notes
    -----
    With fewer than three points, or points that all coincide, eigen-features and Verticality are 0 and
    SurfaceVariation is 1/3 [H17]; the heights are what the points there are have; with none
    (queries that are not points of the cloud) they are 0.
    """
    # Made here and of constant shapes: rows known not to overlap let the loops be vectorized.
    out, m = np.empty((FEATURES, WIDTH)), np.empty((9, WIDTH))
    for j in range(count):
        n = moments[N, j]
        inverse = 1.0 / (n if n > 0.0 else 1.0)
        mx, my, mz = moments[SX, j] * inverse, moments[SY, j] * inverse, moments[SZ, j] * inverse
        ax, ay, az = moments[SXX, j] * inverse, moments[SYY, j] * inverse, moments[SZZ, j] * inverse
        xx, yy, zz = ax - mx * mx, ay - my * my, az - mz * mz
        apart = xx + yy + zz > COINCIDENT * (ax + ay + az + moved)
        m[0, j], m[1, j], m[2, j] = xx, yy, zz
        m[3, j] = moments[SXY, j] * inverse - mx * my
        m[4, j] = moments[SXZ, j] * inverse - mx * mz
        m[5, j] = moments[SYZ, j] * inverse - my * mz
        m[6, j], m[7, j], m[8, j] = 0.0, 0.0, 1.0
        out[8, j] = n / volumes[j]
        out[9, j] = 1.0 if apart else 0.0
        out[10, j] = moments[HIGH, j] - moments[LOW, j] if n > 0.0 else 0.0
        out[11, j] = math.sqrt(max(zz, 0.0)) if apart else 0.0
        out[12, j] = heights[j] - moments[LOW, j] if n > 0.0 else 0.0
    rotate_columns(m, count)
    for j in range(count):
        n = moments[N, j] * out[9, j]  # 0 where the points coincide
        l1, l2, l3, nz = steepness(m[0, j], m[1, j], m[2, j], m[6, j], m[7, j], m[8, j])
        f = covariance_features(n, l1, l2, l3)
        out[0, j] = f[0]
        out[1, j] = f[1]
        out[2, j] = f[2]
        out[3, j] = f[3]
        out[4, j] = f[4]
        out[5, j] = f[5]
        out[6, j] = f[6]
        out[7, j] = f[7]
        out[9, j] = 1.0 - nz if n >= 3.0 else 0.0
    for j in range(count):
        if moments[N, j] < 3.0:
            few[0] += copies[j]
    return out
