"""The k nearest neighbors, exact and in one well-defined order, for groups of nearby queries.

The neighbors of a query are the first `need` points of the cloud in the order of (squared distance, x, y, z),
where the squared distance is computed from float64 differences x_j - x_q. A query that is a point of the
cloud is its own first neighbor. So the answer is a function of the cloud as a set: neither the order of the
points, nor the tile, nor the grouping changes it. Points with equal coordinates are interchangeable.

A block of queries is halved along its longest side until at most ``GROUP`` lie together. For a
group, all candidates within a reach (guessed from the group before) are gathered once; for each query
squared distances and their bins are computed with vector instructions, and a counting sort by bins (in the
plane the squared distance is uniformly distributed, so bins fill evenly) followed by an insertion sort gives
the order. A query with too few candidates inside the reach is repeated with a reach that certainly suffices.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device
from ..base.lending import lent
from .abreast import CODES, make_networks, sort_abreast
from .kdtree import STACK, bounding_box, farthest2, gather, halve
from .lanes import LANES

#: Queries that share one set of candidates.
GROUP = LANES

#: The most neighbors that are looked for abreast: of more, too many candidates lie within reach for a network.
ABREAST = 72

#: Bins of squared distance; the first half of them lies within the reach.
BINS = 256
HALF = BINS // 2

#: First guess of the reach, meters; each group starts from what the one before needed.
FIRST_REACH = 1.0

#: The next group's first reach, in squared distance, as a multiple of what this one needed.
SPARE = 1.2

#: A group that would collect more candidates than CROWD * need + ROOM is split or its reach shrunk.
CROWD = 4
ROOM = 256

#: Squared meters too small to divide by.
TINY = 1e-200

#: Factor that outweighs the rounding of a product or quotient.
MORE = 1.0 + 1e-12

#: From this many points in one bin a heapsort takes the place of the insertion sort.
HEAP = 48


@device
def make_groups(qx, qy, qz):
    """Order of a block's queries and where its groups of at most GROUP nearby queries start.

    Queries that coincide form one group however many they are.

    Returns
    -------
    order : ndarray of uint32, shape (m,)
    starts : ndarray of int64, shape (groups + 1,)
    """
    m = len(qx)
    order = np.empty(m, np.uint32)
    for i in range(m):
        order[i] = i
    keys = np.empty(m)
    starts = np.empty(m + 1, np.int64)
    count = 0
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, m
    top = 1 if m > 0 else 0
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        box = bounding_box(qx, qy, qz, order, lo, hi)
        one = box[0] == box[3] and box[1] == box[4] and box[2] == box[5]
        if hi - lo <= GROUP or one:
            starts[count] = lo
            count += 1
            continue
        mid = halve(qx, qy, qz, order, keys, lo, hi, box)
        stack[top, 0], stack[top, 1] = mid, hi
        top += 1
        stack[top, 0], stack[top, 1] = lo, mid
        top += 1
    starts[count] = m
    return order, starts[: count + 1]


@device(forceinline=True)
def _before(d, a, e, b, cx, cy, cz):
    """Whether candidate a at squared distance d comes before candidate b at e."""
    if d != e:
        return d < e
    if cx[a] != cx[b]:
        return cx[a] < cx[b]
    if cy[a] != cy[b]:
        return cy[a] < cy[b]
    return cz[a] < cz[b]


@device
def _insertion_sort(d, pos, lo, hi, cx, cy, cz):
    for i in range(lo + 1, hi):
        key, item = d[i], pos[i]
        j = i
        while j > lo and d[j - 1] >= key:
            if d[j - 1] == key and not _before(key, item, key, pos[j - 1], cx, cy, cz):
                break
            d[j] = d[j - 1]
            pos[j] = pos[j - 1]
            j -= 1
        d[j] = key
        pos[j] = item


@device
def _heap_sort(d, pos, lo, hi, cx, cy, cz):
    n = hi - lo
    start, end = n // 2, n
    while end > 1:
        if start > 0:
            start -= 1
        else:
            end -= 1
            d[lo + end], d[lo] = d[lo], d[lo + end]
            pos[lo + end], pos[lo] = pos[lo], pos[lo + end]
        root = start
        while 2 * root + 1 < end:
            child = 2 * root + 1
            a = lo + child
            if child + 1 < end and _before(d[a], pos[a], d[a + 1], pos[a + 1], cx, cy, cz):
                child += 1
                a += 1
            r = lo + root
            if not _before(d[r], pos[r], d[a], pos[a], cx, cy, cz):
                break
            d[a], d[r] = d[r], d[a]
            pos[a], pos[r] = pos[r], pos[a]
            root = child


@device
def _distances(qx, qy, qz, cx, cy, cz, count, scale, d2, bins):
    for i in range(count):
        dx, dy, dz = cx[i] - qx, cy[i] - qy, cz[i] - qz
        d = dx * dx + dy * dy + dz * dz
        d2[i] = d
        b = d * scale
        b = b if b < BINS - 1 else BINS - 1.0
        bins[i] = np.uint32(np.int32(b))


@device
def _bin_distances(d2, count, scale, bins):
    for i in range(count):
        b = d2[i] * scale
        b = b if b < BINS - 1 else BINS - 1.0
        bins[i] = np.uint32(np.int32(b))


@device
def nearest_sorted(qx, qy, qz, need, reach2, final, work, cx, cy, cz, count):
    """Sort the `need` nearest of `count` candidates of one query to the front of `work`'s d and pos.

    Parameters
    ----------
    need : int
        At most as many as the cloud has points.
    reach2 : float
        All points of the cloud within this squared distance are among the candidates.
    final : bool
        Whether candidates beyond `reach2` do not matter, so that fewer than `need` is an answer.

    Returns
    -------
    found : int
        How many neighbors are in front; -1 where the reach does not suffice.
    bound : float
        Where it does not: a squared reach that does, or at least a larger one.
    """
    d2, bins, d, pos, hist = work.d2, work.bins, work.d, work.pos, work.hist
    # A tiny bit more than HALF bins, so that rounding puts no candidate beyond the reach below HALF.
    scale = HALF * MORE / reach2 if reach2 > TINY else HALF / TINY
    _distances(qx, qy, qz, cx, cy, cz, count, scale, d2, bins)
    last = _count_bins(bins, count, need, hist)
    if not final:
        if last >= HALF:
            return -1, 4.0 * reach2 if last >= BINS - 1 else (last + 1) * MORE / scale
        while hist[last] > HEAP and last < HALF // 8 and scale < 1.0 / TINY:
            # Most bins are wasted on candidates that are too far: look closer.
            scale = scale * HALF / (last + 1) / MORE
            _bin_distances(d2, count, scale, bins)
            last = _count_bins(bins, count, need, hist)
    start = 0
    crowded = False
    for b in range(BINS):
        size = hist[b]
        crowded = crowded or (size > HEAP and b <= last)
        hist[b] = start
        start += size
    for i in range(count):
        b = bins[i]
        p = hist[b]
        hist[b] = p + 1
        d[p] = d2[i]
        pos[p] = i
    # hist[b] is now where bin b ends; only bins up to `last` matter.
    end = hist[last] if last < BINS else count
    begin = np.int64(0)  # not a literal, for which sorts would be compiled once more
    if crowded:
        for b in range(min(last + 1, BINS)):
            if hist[b] - begin > HEAP:
                _heap_sort(d, pos, begin, hist[b], cx, cy, cz)
            else:
                _insertion_sort(d, pos, begin, hist[b], cx, cy, cz)
            begin = hist[b]
    else:
        _insertion_sort(d, pos, begin, end, cx, cy, cz)
    found = min(need, count)
    if final:
        while found > 0 and d[found - 1] > reach2:
            found -= 1
    return found, reach2


@device(forceinline=True)
def _count_bins(bins, count, need, hist):
    """Fill the histogram; the bin in which the `need`-th candidate lies, BINS where there are fewer."""
    hist[:] = 0
    for i in range(count):
        hist[bins[i]] += 1
    total = 0
    for b in range(BINS):
        total += hist[b]
        if total >= need:
            return b
    return BINS


@device
def _write_row(qx, qy, qz, r, found, scratch, rows):
    """One query's neighbors, from the front of `scratch`'s d and pos."""
    for i in range(found):
        p = scratch.pos[i]
        rows.d2[i, r] = scratch.d[i]
        rows.at[i, r] = scratch.ci[p]
    if len(rows.x) == 0:
        return
    for i in range(found):
        p = scratch.pos[i]
        rows.x[i, r] = scratch.cx[p] - qx
        rows.y[i, r] = scratch.cy[p] - qy
        rows.z[i, r] = scratch.cz[p] - qz
        rows.height[i, r] = scratch.cz[p]
    for i in range(found, len(rows.d2)):
        rows.x[i, r] = rows.y[i, r] = rows.z[i, r] = 0.0
        rows.height[i, r] = rows.height[0, r]


class Scratch(NamedTuple):
    """Room for the candidates of one group and for sorting them."""

    cx: np.ndarray
    cy: np.ndarray
    cz: np.ndarray
    ci: np.ndarray
    d2: np.ndarray
    bins: np.ndarray
    d: np.ndarray
    pos: np.ndarray
    hist: np.ndarray
    stack: np.ndarray


class Rows(NamedTuple):
    """The sorted neighbors of the queries of one group, a column a query, and room to sort them abreast."""

    found: np.ndarray  # (GROUP,) int64: how many
    d2: np.ndarray  # (need, GROUP) float64: squared distances
    at: np.ndarray  # (need, GROUP) uint32: positions in the cloud
    x: np.ndarray  # (need, GROUP) float64: offsets from the query; 0 behind the last
    y: np.ndarray
    z: np.ndarray
    height: np.ndarray  # (need, GROUP) float64: z; behind the last that of the first
    keys: np.ndarray  # ((CODES + 1) * GROUP,) float64
    codes: np.ndarray  # (CODES,) int64
    query: np.ndarray  # (3, GROUP) float64
    length: np.ndarray  # (GROUP,) int64
    ok: np.ndarray  # (GROUP,) bool
    tied: np.ndarray  # (GROUP,) bool
    low: np.ndarray  # networks, see abreast.make_networks
    high: np.ndarray
    starts: np.ndarray


class Search(NamedTuple):
    """A search over a block of queries on its way; `state` holds its place and its current reach."""

    qx: np.ndarray
    qy: np.ndarray
    qz: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    state: np.ndarray  # float64: group, first query of it still to do, squared reach


@device
def make_scratch(room):
    f, u = np.float64, np.uint32
    return Scratch(
        np.empty(room, f),
        np.empty(room, f),
        np.empty(room, f),
        np.empty(room, u),
        np.empty(room, f),
        np.empty(room, u),
        np.empty(room, f),
        np.empty(room, u),
        np.empty(BINS, np.int64),
        np.empty((STACK, 4), np.int64),
    )


@device
def make_rows(need, offsets=True):
    """Rows for `need` neighbors; without `offsets` (and heights) where nobody reads them and no network needs them."""
    low, high, starts = make_networks(need)
    room = need if offsets or need <= ABREAST else 0
    return Rows(
        np.zeros(GROUP, np.int64), np.empty((need, GROUP)), np.empty((need, GROUP), np.uint32),
        np.empty((room, GROUP)), np.empty((room, GROUP)), np.empty((room, GROUP)), np.empty((room, GROUP)),
        np.empty((CODES + 1) * GROUP), np.empty(CODES, np.int64), np.zeros((3, GROUP)), np.zeros(GROUP, np.int64),
        np.zeros(GROUP, np.bool_), np.zeros(GROUP, np.bool_), low, high, starts,
    )  # fmt: skip


@device
def start_search(qx, qy, qz):
    """A search over the queries; go on with :func:`next_rows`."""
    order, starts = make_groups(qx, qy, qz)
    return Search(qx, qy, qz, order, starts, np.array([0.0, 0.0, FIRST_REACH * FIRST_REACH]))


@device
def next_rows(tree, search, need, cap2, scratch, rows):
    """Find the neighbors of the next few queries.

    Parameters
    ----------
    need : int
        How many neighbors, the query's own point included; fewer where the cloud has fewer.
    cap2 : float
        Neighbors lie within this squared distance; infinity for no bound.

    Returns
    -------
    lo, hi : int
        The queries are search.order[lo:hi]; lo = -1 when there are none left.
    count : int
        Rows filled: hi - lo, or 1 where all the queries coincide.
    scratch : Scratch
        To be passed next time (it grows where it must).
    """
    group = int(search.state[0])
    if group >= len(search.starts) - 1:
        return -1, -1, 0, scratch
    first, end = search.starts[group], search.starts[group + 1]
    lo, hi = max(first, int(search.state[1])), end
    if lo > first:
        hi = lo + 1
    done, reach2 = 0, search.state[2]
    while True:
        done, reach2, scratch = _search_group(tree, search, lo, hi, need, cap2, reach2, scratch, rows)
        if done:
            break
        hi = lo + 1  # too crowded or too far apart to go together
    search.state[1] = hi
    if hi >= end:
        search.state[0] = group + 1
    search.state[2] = reach2
    return lo, hi, done, scratch


@device
def _search_group(tree, search, lo, hi, need, cap2, reach2, scratch, rows):
    """Rows filled (0: the group must be split), the reach to start the next group with, the scratch."""
    need = min(need, len(tree.perm))
    owned, scratch = scratch, lent(scratch)
    order = search.order
    box = bounding_box(search.qx, search.qy, search.qz, order, lo, hi)
    one = box[0] == box[3] and box[1] == box[4] and box[2] == box[5]
    count = 1 if one else hi - lo
    most2 = min(farthest2(tree, box) * MORE, cap2)
    limit = min(len(scratch.d), CROWD * need + ROOM)
    low, high, flips, pending = 0.0, np.inf, 0, count
    rows.found[:count] = -1
    kth2 = 0.0
    while pending > 0:
        reach2 = min(reach2, most2)
        final = reach2 >= most2
        cx, cy, cz = scratch.cx, scratch.cy, scratch.cz
        c = gather(tree, box, reach2, need, limit, scratch.stack, cx, cy, cz, scratch.ci)
        if c < 0:
            if count > 1:
                return 0, reach2 if pending < count else 0.25 * reach2, owned
            flips += 1 if low > 0.0 else 0
            if flips > 6 or reach2 < TINY:  # many at the same distance: they must all be looked at
                limit *= 4
                high = np.inf
                if limit > len(scratch.d):
                    owned = make_scratch(limit)
                    scratch = lent(owned)
            else:
                high = reach2
                reach2 = math.sqrt(low * high) if low > 0.0 else 0.25 * reach2
            continue
        if c < need and not final:
            flips += 1 if high < np.inf else 0
            low = reach2
            reach2 = math.sqrt(low * high) if high < np.inf else 4.0 * max(reach2, TINY)
            continue
        more2 = 0.0
        if pending == count and count > 1 and c <= CODES and need == len(rows.d2) <= ABREAST:
            sort_abreast(order, lo, count, search.qx, search.qy, search.qz, need, reach2, scratch, c, rows)
            for r in range(count):
                pending -= 1 if rows.found[r] >= 0 else 0
            for r in range(count):
                if rows.found[r] >= 0:
                    kth2 = max(kth2, rows.d2[need - 1, r])
        for r in range(count):
            if rows.found[r] >= 0:
                continue
            q = order[lo + r]
            found, bound = nearest_sorted(
                search.qx[q], search.qy[q], search.qz[q], need, reach2, final, scratch,
                scratch.cx, scratch.cy, scratch.cz, c,
            )  # fmt: skip
            if found < 0:
                more2 = max(more2, bound)
                continue
            rows.found[r] = found
            pending -= 1
            _write_row(search.qx[q], search.qy[q], search.qz[q], r, found, scratch, rows)
            if found > 0:
                kth2 = max(kth2, scratch.d[found - 1])
        if pending > 0:
            low, high = reach2, np.inf
            reach2 = more2
    return count, max(SPARE * kth2, TINY), owned
