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

from ..base.jit import device, intrinsic
from .candidates import from_order_bits, order_bits
from .eigen import covariance_features, eigen3

#: Rows of a moment table: count, sums, products, lowest and highest height (as ordered integers).
N, SX, SY, SZ, SXX, SXY, SXZ, SYY, SYZ, SZZ, LOW, HIGH = range(12)
MOMENTS = 12

#: Features made of them.
FEATURES = 13

#: Queries whose moments are held at a time: small enough for the second-level cache.
BATCH = 256

#: Columns of a moment table: not a power of two, whose rows would compete for the same cache lines.
WIDTH = BATCH + 8

#: Ordered bits of +infinity and -infinity: the extremes of no point at all.
TOP = np.int64(0x7FF0000000000000)
BOTTOM = np.int64(-0x7FF0000000000001)

#: A variance below this part of the mean squared distance to the query is rounding: the points coincide. Where moments were
#: taken about another point than the query first, the squared distance to that counts as well.
COINCIDENT = 1e-13


@intrinsic
def _add(types, a, b):
    """a + b that may be reordered in a sum and contracted with a product: what lets LLVM vectorize it."""

    def codegen(context, builder, signature, args):
        return builder.fadd(args[0], args[1], flags=("reassoc", "contract", "nsz"))

    return types.float64(types.float64, types.float64), codegen


@intrinsic
def _mul(types, a, b):
    """a * b that may be contracted with the sum it goes into."""

    def codegen(context, builder, signature, args):
        return builder.fmul(args[0], args[1], flags=("contract",))

    return types.float64(types.float64, types.float64), codegen


@device(forceinline=True)
def cylinder_sums(px, py, pz, qx, qy, qz, r2, out, j):
    """Moments about (qx, qy, qz) of the candidates within sqrt(r2) of it in x and y, into ``out[:, j]``."""
    n = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    low, high = TOP, BOTTOM
    for i in range(len(px)):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        inside = dx * dx + dy * dy <= r2
        mx = dx if inside else 0.0
        my = dy if inside else 0.0
        mz = dz if inside else 0.0
        n = _add(n, 1.0 if inside else 0.0)
        sx, sy, sz = _add(sx, mx), _add(sy, my), _add(sz, mz)
        sxx, sxy, sxz = _add(sxx, _mul(mx, dx)), _add(sxy, _mul(mx, dy)), _add(sxz, _mul(mx, dz))
        syy, syz, szz = _add(syy, _mul(my, dy)), _add(syz, _mul(my, dz)), _add(szz, _mul(mz, dz))
        key = order_bits(pz[i])
        low = min(low, key if inside else TOP)
        high = max(high, key if inside else BOTTOM)
    out[N, j], out[SX, j], out[SY, j], out[SZ, j] = n, sx, sy, sz
    out[SXX, j], out[SXY, j], out[SXZ, j] = sxx, sxy, sxz
    out[SYY, j], out[SYZ, j], out[SZZ, j] = syy, syz, szz
    out[LOW, j], out[HIGH, j] = from_order_bits(low), from_order_bits(high)


@device(forceinline=True)
def sphere_sums(px, py, pz, qx, qy, qz, r2, out, j):
    """Moments about (qx, qy, qz) of the candidates within sqrt(r2) of it, into ``out[:, j]``."""
    n = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    low, high = TOP, BOTTOM
    for i in range(len(px)):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        inside = dx * dx + dy * dy + dz * dz <= r2
        mx = dx if inside else 0.0
        my = dy if inside else 0.0
        mz = dz if inside else 0.0
        n = _add(n, 1.0 if inside else 0.0)
        sx, sy, sz = _add(sx, mx), _add(sy, my), _add(sz, mz)
        sxx, sxy, sxz = _add(sxx, _mul(mx, dx)), _add(sxy, _mul(mx, dy)), _add(sxz, _mul(mx, dz))
        syy, syz, szz = _add(syy, _mul(my, dy)), _add(syz, _mul(my, dz)), _add(szz, _mul(mz, dz))
        key = order_bits(pz[i])
        low = min(low, key if inside else TOP)
        high = max(high, key if inside else BOTTOM)
    out[N, j], out[SX, j], out[SY, j], out[SZ, j] = n, sx, sy, sz
    out[SXX, j], out[SXY, j], out[SXZ, j] = sxx, sxy, sxz
    out[SYY, j], out[SYZ, j], out[SZZ, j] = syy, syz, szz
    out[LOW, j], out[HIGH, j] = from_order_bits(low), from_order_bits(high)


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
    # Made here and of a constant shape: rows known not to overlap let the loop be vectorized.
    out = np.empty((FEATURES, WIDTH))
    for j in range(count):
        n = moments[N, j]
        inverse = 1.0 / (n if n > 0.0 else 1.0)
        mx, my, mz = moments[SX, j] * inverse, moments[SY, j] * inverse, moments[SZ, j] * inverse
        ax, ay, az = moments[SXX, j] * inverse, moments[SYY, j] * inverse, moments[SZZ, j] * inverse
        xx, yy, zz = ax - mx * mx, ay - my * my, az - mz * mz
        xy = moments[SXY, j] * inverse - mx * my
        xz = moments[SXZ, j] * inverse - mx * mz
        yz = moments[SYZ, j] * inverse - my * mz
        apart = xx + yy + zz > COINCIDENT * (ax + ay + az + moved)
        l1, l2, l3, nz = eigen3(xx, xy, xz, yy, yz, zz)
        real = (n >= 3.0) & apart
        f = covariance_features(n if apart else 0.0, l1, l2, l3)
        out[0, j] = f[0]
        out[1, j] = f[1]
        out[2, j] = f[2]
        out[3, j] = f[3]
        out[4, j] = f[4]
        out[5, j] = f[5]
        out[6, j] = f[6]
        out[7, j] = f[7]
        out[8, j] = n / volumes[j]
        out[9, j] = 1.0 - nz if real else 0.0
        out[10, j] = moments[HIGH, j] - moments[LOW, j] if n > 0.0 else 0.0
        out[11, j] = math.sqrt(max(zz, 0.0)) if apart else 0.0
        out[12, j] = heights[j] - moments[LOW, j] if n > 0.0 else 0.0
    for j in range(count):
        if moments[N, j] < 3.0:
            few[0] += copies[j]
    return out
