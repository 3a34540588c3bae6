"""Moments of neighborhoods, summed over candidates within a radius, and features of them.

Functions of eigenvalues are branch-free apart from selections, and inlined where they are called,
so a loop over arrays of moments is vectorized by LLVM; they set no fast-math flag, so a value does
not depend on its place in the array or on the loop it is called from.

Eigenvalues are computed by Jacobi's rotations. Unlike the closed form with arc cosines they keep
full accuracy where two eigenvalues nearly coincide (thin lines and planes, where the closed form
loses half of the digits), they give the eigenvector of the smallest eigenvalue at the cost of a few
products, and square roots and divisions are vector instructions where arc cosines are not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import FAST, device, njit
from .neighborhoods import MIN_RADIUS
from .registry import MOMENT_FEATURES, rows_of

#: The logarithm of 2 in two parts, as fdlibm has it.
LN2_HI = 6.93147180369123816490e-01
LN2_LO = 1.90821492927058770002e-10

#: l2 below this part of l1 counts as a line, whose normal is taken as the steepest perpendicular. A
#: thousand times the error of :func:`eigen3`.
LINE = 1e-12


@device(forceinline=True)
def bits_of(value):
    """Return the 64 bits of a float64 as int64."""
    return np.float64(value).view(np.int64)


@device(forceinline=True)
def from_bits(bits):
    """Return the float64 of 64 bits."""
    return np.int64(bits).view(np.float64)


@device(forceinline=True)
def log_fast(x):
    """Return the logarithm of a positive normal float64 to 1e-15 relative (fdlibm's scheme)."""
    bits = bits_of(x)
    # Mantissa into [sqrt(1/2), sqrt(2)).
    shifted = bits - 0x3FE6A09E667F3BCD
    exponent = shifted >> 52
    m = from_bits(bits - (exponent << 52))
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    t1 = w * (
        3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01)
    )
    t2 = z * (
        6.666666666666735130e-01
        + w
        * (2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01))
    )
    r = t1 + t2
    half = 0.5 * f * f
    k = float(exponent)
    return k * LN2_HI - ((half - (s * (half + r) + k * LN2_LO)) - f)


@device(forceinline=True)
def cbrt_fast(x):
    """Return the cube root of a float64 >= 0 to 1e-15 relative; 0 for anything below 1e-290."""
    big = x > 1e-290
    y = x if big else 1.0
    # Exponent divided by three (as a float: integer division is no vector instruction).
    t = from_bits(int(float(bits_of(y)) * (1.0 / 3.0)) + 0x2A9F789300000000)
    t = t - (t * t * t - y) / (3.0 * t * t)
    t = t - (t * t * t - y) / (3.0 * t * t)
    t = t - (t * t * t - y) / (3.0 * t * t)
    t = t - (t * t * t - y) / (3.0 * t * t)
    return t if big else 0.0


@device(forceinline=True)
def _rotation(app, aqq, apq):
    """Return cosine, sine and tangent of the rotation that makes `apq` zero."""
    d = 0.5 * (aqq - app)
    h = math.sqrt(d * d + apq * apq)
    denominator = abs(d) + h
    # Where apq is 0 there is nothing to rotate; the sum keeps 0 / 0 away without a branch.
    t = apq / (denominator + 1e-300)
    t = t if d >= 0.0 else -t
    c = 1.0 / math.sqrt(1.0 + t * t)
    return c, t * c, t


@device(forceinline=True)
def _turn(c, s, a, b):
    """Return two values turned into each other."""
    return c * a - s * b, s * a + c * b


@device(forceinline=True)
def _sweep(matrix, a, b, c):
    """Return a matrix after a cyclic sweep of Jacobi's rotations, and vectors turned along."""
    xx, xy, xz, yy, yz, zz = matrix
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    cos, sin, t = _rotation(xx, yy, xy)
    xx, yy = xx - t * xy, yy + t * xy
    xy = 0.0
    xz, yz = _turn(cos, sin, xz, yz)
    ax, bx = _turn(cos, sin, ax, bx)
    ay, by = _turn(cos, sin, ay, by)
    az, bz = _turn(cos, sin, az, bz)
    cos, sin, t = _rotation(xx, zz, xz)
    xx, zz = xx - t * xz, zz + t * xz
    xz = 0.0
    xy, yz = _turn(cos, sin, xy, yz)
    ax, cx = _turn(cos, sin, ax, cx)
    ay, cy = _turn(cos, sin, ay, cy)
    az, cz = _turn(cos, sin, az, cz)
    cos, sin, t = _rotation(yy, zz, yz)
    yy, zz = yy - t * yz, zz + t * yz
    yz = 0.0
    xy, xz = _turn(cos, sin, xy, xz)
    bx, cx = _turn(cos, sin, bx, cx)
    by, cy = _turn(cos, sin, by, cy)
    bz, cz = _turn(cos, sin, bz, cz)
    return (xx, xy, xz, yy, yz, zz), (ax, ay, az), (bx, by, bz), (cx, cy, cz)


@device(forceinline=True)
def eigen3(xx, xy, xz, yy, yz, zz):
    """Return the eigenvalues l1 >= l2 >= l3 >= 0 of a covariance matrix and the unit vector of l3.

    Four cyclic Jacobi sweeps; absolute error about 1e-15 of l1, negative rounding leftovers become
    0. The eigenvector is of either sign; of points on a line (l2 below 1e-12 of l1) it is the
    steepest perpendicular, so that a horizontal line has verticality 0 and a vertical one 1: (1,
    0, 0) where the line is vertical.
    """
    # No loop: LLVM leaves one of this length rolled up, and then does not vectorize the loop
    # around it.
    swept = _sweep((xx, xy, xz, yy, yz, zz), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    matrix, a, b, c = _sweep(*_sweep(*_sweep(*swept)))
    xx, _, _, yy, _, zz = matrix
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    xx, yy, zz = max(xx, 0.0), max(yy, 0.0), max(zz, 0.0)
    # Sort downwards, the vectors with their values.
    swap = xx < yy
    xx, yy = (yy if swap else xx), (xx if swap else yy)
    ax, bx = (bx if swap else ax), (ax if swap else bx)
    ay, by = (by if swap else ay), (ay if swap else by)
    az, bz = (bz if swap else az), (az if swap else bz)
    swap = yy < zz
    yy, zz = (zz if swap else yy), (yy if swap else zz)
    bx, cx = (cx if swap else bx), (bx if swap else cx)
    by, cy = (cy if swap else by), (by if swap else cy)
    bz, cz = (cz if swap else bz), (bz if swap else cz)
    swap = xx < yy
    xx, yy = (yy if swap else xx), (xx if swap else yy)
    ax, ay, az = (bx if swap else ax), (by if swap else ay), (bz if swap else az)
    line = yy <= LINE * xx
    level = 1.0 - az * az
    leans = level > LINE
    scale = 1.0 / math.sqrt(level if leans else 1.0)
    cx = (-az * ax * scale if leans else 1.0) if line else cx
    cy = (-az * ay * scale if leans else 0.0) if line else cy
    cz = (level * scale if leans else 0.0) if line else cz
    return xx, yy, zz, cx, cy, cz


@device(forceinline=True)
def entropy_term(e):
    """Return -e ln e, 0 for e = 0 (and below 1e-290)."""
    positive = e > 1e-290
    return -e * log_fast(e if positive else 1.0) if positive else 0.0


@device(forceinline=True)
def eigenentropy(l1, l2, l3):
    """Return the eigenentropy -sum e ln e of e_i = l_i / (l1 + l2 + l3); 0 where all are 0."""
    total = l1 + l2 + l3
    scale = 1.0 / (total if total > 0.0 else 1.0)
    return entropy_term(l1 * scale) + entropy_term(l2 * scale) + entropy_term(l3 * scale)


#: Rows of a table of moments about the queries: the number of points, sums of coordinates and of
#: their products, the lowest and highest z, the radius that was chosen for the query, and the
#: meters to the farthest point that matters to the choice.
M = rows_of(
    *("N", "SX", "SY", "SZ", "SXX", "SXY", "SXZ", "SYY", "SYZ", "SZZ", "LOW", "HIGH"),
    *("RADIUS", "REACH"),
)
#: Rows that are sums and extremes of points.
MOMENTS = M.RADIUS

#: Rows of the features that :func:`finish` computes, and of the unit normal, by name.
ROW = rows_of(*MOMENT_FEATURES, "NormalX", "NormalY", "NormalZ")
FEATURES = len(ROW)

#: Queries finished at a time: small enough for the second-level cache.
BATCH = 256
#: Columns of their scratch: not a power of two, whose rows would compete for the same cache lines.
WIDTH = BATCH + 8

#: Members that a neighborhood needs to have a structure: three points make a plane.
STRUCTURE_MEMBERS = 3

#: A variance below this part of the mean squared distance to the query is rounding (1e-16 for each
#: of some hundred points): the points coincide.
COINCIDENT = 1e-13

_MOST = np.int64(2**63 - 1)

#: Rows of the scratch of :func:`finish`: a covariance matrix, and the number of its points, 0 where
#: they all coincide.
C = rows_of("XX", "YY", "ZZ", "XY", "XZ", "YZ", "COUNT")


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
    out[M.N, j], out[M.SX, j], out[M.SY, j], out[M.SZ, j] = n, sx, sy, sz
    out[M.SXX, j], out[M.SXY, j], out[M.SXZ, j] = sxx, sxy, sxz
    out[M.SYY, j], out[M.SYZ, j], out[M.SZZ, j] = syy, syz, szz
    out[M.LOW, j], out[M.HIGH, j] = height_of(low), height_of(high)


@device(forceinline=True)
def write_eigen_features(values, j, n, l1, l2, l3, nz):
    """Write the features of eigenvalues l1 >= l2 >= l3 of `n` points to column `j` of `values`.

    A new eigen-feature is one line here, ``values[ROW.Name, j] = ...``, and one entry in the
    registry.
    `nz` is the height of the unit eigenvector of l3. With fewer than three points, or points that
    all coincide, features are 0 and the surface variation is 1/3 [H17].
    """
    total = l1 + l2 + l3
    real = (n >= STRUCTURE_MEMBERS) & (total > 0.0)
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
    values[ROW.Verticality, j] = max(1.0 - abs(nz), 0.0) if n >= STRUCTURE_MEMBERS else 0.0


@device(forceinline=True)
def _center(moments, heights, count, m, values):
    """Write covariances about the means to `m`, and the features of heights to `values`."""
    for j in range(count):
        n = moments[M.N, j]
        inverse = 1.0 / (n if n > 0.0 else 1.0)
        mx, my, mz = moments[M.SX, j], moments[M.SY, j], moments[M.SZ, j]
        mx, my, mz = mx * inverse, my * inverse, mz * inverse
        ax, ay, az = moments[M.SXX, j], moments[M.SYY, j], moments[M.SZZ, j]
        ax, ay, az = ax * inverse, ay * inverse, az * inverse
        xx, yy, zz = ax - mx * mx, ay - my * my, az - mz * mz
        apart = xx + yy + zz > COINCIDENT * (ax + ay + az)
        m[C.XX, j], m[C.YY, j], m[C.ZZ, j] = xx, yy, zz
        m[C.XY, j] = moments[M.SXY, j] * inverse - mx * my
        m[C.XZ, j] = moments[M.SXZ, j] * inverse - mx * mz
        m[C.YZ, j] = moments[M.SYZ, j] * inverse - my * mz
        # Later loops read the count from here: LLVM cannot exclude that writing changes `moments`.
        m[C.COUNT, j] = n if apart else 0.0
        values[ROW.HeightRange, j] = moments[M.HIGH, j] - moments[M.LOW, j] if n > 0.0 else 0.0
        values[ROW.HeightStd, j] = math.sqrt(max(zz, 0.0)) if apart else 0.0
        values[ROW.HeightAboveLowest, j] = heights[j] - moments[M.LOW, j] if n > 0.0 else 0.0


@njit
def finish(table, volume, heights, few, copies, columns, out):
    """Write the features made of moments.

    With fewer than three points, or points that all coincide, eigen-features and Verticality are 0
    and SurfaceVariation is 1/3 [H17]; heights are those of the points there are; without any
    point (of queries that are not in the cloud) they are 0.

    Parameters
    ----------
    table : (len(M), m) float64 array
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
    # Of constant shapes: rows known not to overlap let the loops be vectorized. A feature without
    # a line below stays NaN.
    values, m = np.full((FEATURES, WIDTH), np.nan), np.empty((len(C), WIDTH))
    for start in range(0, len(heights), BATCH):
        count = min(BATCH, len(heights) - start)
        moments = table[:, start : start + count]
        _center(moments, heights[start:], count, m, values)
        for j in range(count):
            r = max(moments[M.RADIUS, j], MIN_RADIUS) if volume == 0.0 else 1.0
            values[ROW.Radius, j] = moments[M.RADIUS, j]
            values[ROW.Density, j] = moments[M.N, j] / (
                4.0 / 3.0 * math.pi * r * r * r if volume == 0.0 else volume
            )
        for j in range(count):
            n = m[C.COUNT, j]
            l1, l2, l3, nx, ny, nz = eigen3(
                m[C.XX, j], m[C.XY, j], m[C.XZ, j], m[C.YY, j], m[C.YZ, j], m[C.ZZ, j]
            )
            real = 1.0 if n >= STRUCTURE_MEMBERS else 0.0
            values[ROW.NormalX, j] = real * nx
            values[ROW.NormalY, j] = real * ny
            values[ROW.NormalZ, j] = real * nz
            write_eigen_features(values, j, n, l1, l2, l3, nz)
        for j in range(count):
            if moments[M.N, j] < STRUCTURE_MEMBERS:
                few[0] += copies[start + j]
        for f in range(len(columns)):
            if columns[f] >= 0:
                for j in range(count):
                    out[start + j, columns[f]] = values[f, j]
