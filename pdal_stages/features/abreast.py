"""Eight queries side by side, a vector lane each: their candidates put in order, and moments added, all at once.

A query's candidates within reach become keys: the bits of the squared distance, whose last ones give way to the
candidate's number. Eight columns of keys go through a sorting network, in which every step compares two rows of
eight, so nothing depends on what the keys are and no branch is ever mispredicted. Where two keys differ in nothing but their
numbers the distances may be equal or not: such a query, or one with too many or too few candidates, is left to ``knn.py``'s
exact order. So the result is the same, whoever finds it.

Networks are Batcher's merge exchange (Knuth, The Art of Computer Programming 3, 5.2.2, algorithm M), without what the first
`need` rows do not depend on.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device
from .eigen import bits_of, from_bits
from .lanes import LANES, exchange

#: The longest columns that are sorted here; there is a network for every multiple of STEP.
MOST = 128
STEP = 8

#: Candidates that a key can number, and the bits of their numbers.
CODES = 512
CODE = CODES - 1

#: Added to the bits of a squared distance: no key is a subnormal number, on which processors may be slow.
NORMAL = 1 << 52
#: Of no candidate, behind all others (infinity; its number is 0).
NONE = 0x7FF0000000000000


@device
def make_networks(need):
    """Comparators low, high (uint8) of all networks, and where that of ``STEP * i`` rows starts and ends.

    None where `need` rows are too many.
    """
    starts = np.zeros((MOST // STEP + 1, 2), np.int64)
    low, high = np.empty(16_000, np.uint8), np.empty(16_000, np.uint8)
    alive = np.empty(MOST, np.bool_)
    end = np.int64(0)
    for i in range(1, MOST // STEP + 1):
        size = STEP * i
        if size < need:
            continue
        first = end
        t = 1
        while t < size:
            t *= 2
        p = t // 2
        while p > 0:
            q, r, d = t // 2, 0, p
            while True:
                for j in range(size - d):
                    if j & p == r:
                        low[end], high[end] = j, j + d
                        end += 1
                if q == p:
                    break
                d, q, r = q - p, q // 2, p
            p //= 2
        # From the end: what the first need + 1 rows (the last of them tells a tie) do not depend on goes.
        for j in range(MOST):
            alive[j] = j <= need
        kept = end
        for c in range(end - 1, first - 1, -1):
            a, b = low[c], high[c]
            if alive[a] or alive[b]:
                alive[a] = alive[b] = True
                kept -= 1
                low[kept], high[kept] = a, b
        starts[i, 0], starts[i, 1] = kept, end
    return low, high, starts


@device(forceinline=True)
def key_of(d2, number):
    return ((bits_of(d2) + NORMAL) & ~CODE) | number


@device
def number_candidates(qx, qy, qz, cx, cy, cz, count, codes):
    """The keys of all candidates of one query."""
    for i in range(count):
        dx, dy, dz = cx[i] - qx, cy[i] - qy, cz[i] - qz
        codes[i] = key_of(dx * dx + dy * dy + dz * dz, i)


@device
def take_near(codes, count, limit, keys, lane):
    """Copy the keys below `limit` into a lane; how many they are."""
    at = np.uint64(lane)
    for i in range(count):
        key = codes[i]
        keys[at] = from_bits(key)
        at += np.uint64(LANES) if key < limit else np.uint64(0)
    return np.int64(at) // LANES


@device
def sort_abreast(order, lo, count, qx, qy, qz, need, reach2, scratch, candidates, rows):
    """Fill the rows of those of up to eight queries that can be put in order here.

    `reach2` is the squared distance within which no point of the cloud is missing among the candidates. Of the queries
    done, ``rows.found`` becomes `need`.
    """
    keys, codes = rows.keys, rows.codes
    cx, cy, cz = scratch.cx, scratch.cy, scratch.cz
    limit = key_of(reach2, 0)
    length = 0
    ok = rows.ok
    for r in range(LANES):
        n = 0
        if r < count:
            q = order[lo + r]
            rows.query[0, r], rows.query[1, r], rows.query[2, r] = qx[q], qy[q], qz[q]
            number_candidates(qx[q], qy[q], qz[q], cx, cy, cz, candidates, codes)
            n = take_near(codes, candidates, limit, keys, r)
        ok[r] = need <= n <= MOST
        rows.length[r] = n if ok[r] else 0
        length = max(length, rows.length[r])
    if length == 0:
        return
    size = (length + STEP - 1) // STEP
    none = from_bits(np.int64(NONE))
    for r in range(LANES):
        for i in range(rows.length[r], size * STEP):
            keys[i * LANES + r] = none
    low, high = rows.low, rows.high
    for c in range(rows.starts[size, 0], rows.starts[size, 1]):
        exchange(keys, np.int64(low[c]) * LANES, np.int64(high[c]) * LANES)
    for i in range(1, min(need + 1, size * STEP)):
        for r in range(LANES):
            same = bits_of(keys[i * LANES + r]) ^ bits_of(keys[i * LANES + r - LANES])
            rows.tied[r] = rows.tied[r] | (same <= CODE)
    for r in range(count):
        if ok[r] and not rows.tied[r]:
            rows.found[r] = need
        rows.tied[r] = False
    _write(need, scratch, rows)


@device
def _write(need, scratch, rows):
    """The sorted neighbors; columns of queries that are not done mean nothing yet."""
    keys, query, at = rows.keys, rows.query, rows.at
    cx, cy, cz, ci = scratch.cx, scratch.cy, scratch.cz, scratch.ci
    x, y, z, height, d2 = rows.x, rows.y, rows.z, rows.height, rows.d2
    for i in range(need):
        for r in range(LANES):
            p = np.uint64(bits_of(keys[i * LANES + r]) & CODE)
            h = cz[p]
            x[i, r] = cx[p] - query[0, r]
            y[i, r] = cy[p] - query[1, r]
            z[i, r] = h - query[2, r]
            height[i, r] = h
            at[i, r] = ci[p]
    for i in range(need):
        for r in range(LANES):
            d2[i, r] = x[i, r] * x[i, r] + y[i, r] * y[i, r] + z[i, r] * z[i, r]
