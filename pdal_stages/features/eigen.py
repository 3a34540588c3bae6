"""Eigenvalues of 3x3 covariance matrices, for scalar and vectorized use.

Every function here is branch-free apart from selections, and is inlined where it is called, so a
loop over arrays of moments is vectorized by LLVM; no fast-math flag is set, so a value does not
depend on its place in the array or on the loop it is called from.

The method is Jacobi's: unlike the closed form with arc cosines it keeps full accuracy where two
eigenvalues nearly coincide (thin lines and planes, where the closed form loses half of the
digits), it gives the eigenvector of the smallest eigenvalue at the cost of a few products, and
square roots and divisions are vector instructions where arc cosines are not.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device

#: The logarithm of 2 in two parts, as fdlibm has it.
LN2_HI = 6.93147180369123816490e-01
LN2_LO = 1.90821492927058770002e-10

#: l2 below this part of l1 counts as a line, whose normal is taken as the steepest perpendicular.
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
