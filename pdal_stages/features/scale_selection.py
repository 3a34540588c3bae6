"""The best of nested neighborhoods: that of lowest eigenentropy [B16 eq. 1-2] or dimensionality.

The lowest eigenentropy is found in two steps. A vectorized closed form estimates all entropies to
1e-7; those within ``MARGIN`` of the lowest are computed again by the exact method of the features.
Entropies that then lie within ``TIE`` of each other count as equal, and the smallest neighborhood
wins: in a perfect plane or line rounding noise would decide otherwise. Entropies of dimensionality
are all computed by the exact method.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import FAST, device
from .moments import COINCIDENT, MOMENTS, M, eigen3, eigenentropy, log_fast

#: Estimated entropies are off by less than half of this.
MARGIN = 2e-6

#: Entropies closer than this are equal.
TIE = 1e-9

#: Entropy of what is not a candidate: more than ln 3, which no matrix exceeds.
NEVER = 9.0

#: Smaller parts of the trace count as this, whose logarithm is finite.
LEAST_PART = 1e-16


@device
def add_up(near, point, ends, first, last, s):
    """Write moments s[:MOMENTS, j] of the first ends[j] neighbors, for j from `first` to `last`.

    Moments are about the point; the ends ascend.
    """
    qx, qy, qz = point
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    low, high = np.inf, -np.inf
    i = 0
    for j in range(first, last):
        while i < ends[j]:
            p = near.pos[i]
            height = near.z[p]
            a, b, c = near.x[p] - qx, near.y[p] - qy, height - qz
            sx += a
            sy += b
            sz += c
            sxx += a * a
            sxy += a * b
            sxz += a * c
            syy += b * b
            syz += b * c
            szz += c * c
            low = height if height < low else low
            high = height if height > high else high
            i += 1
        s[M.N, j], s[M.SX, j], s[M.SY, j], s[M.SZ, j] = i, sx, sy, sz
        s[M.SXX, j], s[M.SXY, j], s[M.SXZ, j] = sxx, sxy, sxz
        s[M.SYY, j], s[M.SYZ, j], s[M.SZZ, j] = syy, syz, szz
        s[M.LOW, j], s[M.HIGH, j] = low, high


@device
def write_moments(s, j, table, column):
    """Write the sums `j` to a column of a table of moments."""
    for m in range(MOMENTS):
        table[m, column] = s[m, j]


@device(fastmath=set(FAST), forceinline=True)
def estimate_entropy(xx, xy, xz, yy, yz, zz, noise):
    """Return the eigenentropy of a covariance matrix to 1e-7, in closed form without a branch.

    The result is ``NEVER`` where the trace is not above `noise`.

    With unit trace, the eigenvalues are 1/3 + 2 p cos(phi + 2 pi i / 3), cos(3 phi) = r. For r >=
    0 the squared sine of phi is (1 - r) times a smooth function g of r, here a polynomial of degree
    8 (error 7e-10); r < 0 is its mirror image. ``Chebyshev.fit(r, g(r), 8, domain=[0, 1])`` of
    numpy.polynomial, g(r) = sin(arccos(r) / 3)^2 / (1 - r) at 20 or more Chebyshev nodes of 0..1,
    gives the coefficients to 1e-11.
    """
    trace = xx + yy + zz
    real = trace > noise
    scale = 1.0 / (trace if real else 1.0)
    third = 1.0 / 3.0
    a, b, c = xx * scale - third, yy * scale - third, zz * scale - third
    d, e, f = xy * scale, xz * scale, yz * scale
    pp = (a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) * (1.0 / 6.0)
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    p = math.sqrt(pp)
    round_ = pp > 1e-24
    r = 0.5 * det / (pp * p if round_ else 1.0)
    sign = 1.0 if r >= 0.0 else -1.0
    r = abs(r)
    r = r if r < 1.0 else 1.0
    g = r * 0.0001390659792811512 - 0.0008013499216350227
    g = g * r + 0.0022057097588815584
    g = g * r - 0.004110695181066391
    g = g * r + 0.0063985863615792496
    g = g * r - 0.00981107968361836
    g = g * r + 0.01687699899962807
    g = g * r - 0.038675012833058346
    g = g * r + 0.2499999992783597
    ss = (1.0 - r) * g
    cosine = sign * p * math.sqrt(1.0 - ss)
    sine = 1.7320508075688772 * p * math.sqrt(ss)
    e1 = third + 2.0 * cosine
    e2 = third - cosine + sine
    e3 = third - cosine - sine
    e1 = e1 if e1 > LEAST_PART else LEAST_PART
    e2 = e2 if e2 > LEAST_PART else LEAST_PART
    e3 = e3 if e3 > LEAST_PART else LEAST_PART
    entropy = -(e1 * log_fast(e1) + e2 * log_fast(e2) + e3 * log_fast(e3))
    return entropy if real else NEVER


@device
def eigenvalues_of(s, j):
    """Return eigenvalues of the covariance of the sums `j`, and their mean squared distance."""
    w = 1.0 / s[M.N, j]
    x, y, z = s[M.SX, j] * w, s[M.SY, j] * w, s[M.SZ, j] * w
    xx, yy, zz = s[M.SXX, j] * w, s[M.SYY, j] * w, s[M.SZZ, j] * w
    xy, xz, yz = s[M.SXY, j] * w, s[M.SXZ, j] * w, s[M.SYZ, j] * w
    l1, l2, l3, _, _, _ = eigen3(
        xx - x * x, xy - x * y, xz - x * z, yy - y * y, yz - y * z, zz - z * z
    )
    return l1, l2, l3, xx + yy + zz


@device
def estimate_entropies(s, entropy, first, last, least):
    """Estimate the eigenentropies of the candidates first..last - 1 of at least `least` members."""
    n, x, y, z = s[M.N], s[M.SX], s[M.SY], s[M.SZ]
    xx, xy, xz, yy, yz, zz = s[M.SXX], s[M.SXY], s[M.SXZ], s[M.SYY], s[M.SYZ], s[M.SZZ]
    for j in range(first, last):
        w = 1.0 / n[j]
        a, b, c = x[j] * w, y[j] * w, z[j] * w
        value = estimate_entropy(
            xx[j] * w - a * a, xy[j] * w - a * b, xz[j] * w - a * c,
            yy[j] * w - b * b, yz[j] * w - b * c, zz[j] * w - c * c,
            COINCIDENT * w * (xx[j] + yy[j] + zz[j]),
        )  # fmt: skip
        entropy[j] = value if n[j] >= least else NEVER


@device
def lowest_entropy(s, first, last, least_members):
    """Return the candidate of first..last - 1 with the lowest eigenentropy, else last - 1.

    Parameters
    ----------
    s : (MOMENTS + 1, candidates) float64 array
        Moments of the candidates about the query, in ascending size; n > 0. The last row is
        scratch.
    least_members : int
        Members a candidate needs.
    """
    if last - first <= 1:
        return last - 1
    entropy = s[MOMENTS]
    estimate_entropies(s, entropy, first, last, least_members)
    least = NEVER
    for j in range(first, last):
        least = min(least, entropy[j])
    if least >= NEVER:
        return last - 1
    limit = least + MARGIN
    count, only = 0, first
    for j in range(first, last):
        if entropy[j] <= limit:
            count += 1
            only = j
    if count == 1:
        return only
    least = NEVER
    for j in range(first, last):
        if entropy[j] > limit:
            entropy[j] = NEVER
            continue
        l1, l2, l3, _ = eigenvalues_of(s, j)
        entropy[j] = eigenentropy(l1, l2, l3)
        least = min(least, entropy[j])
    for j in range(first, last):
        if entropy[j] <= least + TIE:
            return j
    return last - 1


@device
def lowest_dimensionality(s, first, last, least_members):
    """Return the candidate with the lowest entropy of dimensionality; see :func:`lowest_entropy`.

    That is the entropy of (s1 - s2, s2 - s3, s3) / s1, where s are the roots of the eigenvalues
    (Demantke et al. 2011): it is lowest where a neighborhood is clearly a line, a plane or a
    volume.
    """
    best, least = last - 1, NEVER
    for j in range(first, last):
        if s[M.N, j] < least_members:
            continue
        l1, l2, l3, spread = eigenvalues_of(s, j)
        if l1 + l2 + l3 <= COINCIDENT * spread:
            continue
        s1, s2, s3 = math.sqrt(l1), math.sqrt(l2), math.sqrt(l3)
        entropy = eigenentropy(s1 - s2, s2 - s3, s3)
        if entropy < least - TIE:
            best, least = j, entropy
    return best
