"""The order of points by whole numbers, as keys of cells are.

Keys of cells take few bits, so that sorting by digits is several times as fast as by comparison.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .jit import njit

#: Bits of a digit at most: the counts of all its values stay in a core's first cache.
DIGIT = 11


def order_by_key(keys: npt.NDArray[np.int64]) -> npt.NDArray:
    """Return the order (n,) in which keys (n,) ascend, equal ones as they came; int32 if it fits.

    >>> order_by_key(np.array([7, -2, 7, 0])).tolist()
    [1, 3, 0, 2]
    """
    n = len(keys)
    if n >= 2**31:
        return np.argsort(keys, kind="stable")
    order = np.arange(n, dtype=np.int32)
    if not n:
        return order
    first = int(keys.min())
    bits = (int(keys.max()) - first).bit_length()
    passes = -(-bits // DIGIT)
    other = np.empty_like(order)
    for number in range(passes):
        digit = -(-bits // passes)
        sort_by_digit(keys, first, number * digit, digit, order, other)
        order, other = other, order
    return order


@njit
def sort_by_digit(keys, first, shift, digit, order, out):
    """Write an order (n,) to `out`, sorted by `digit` bits from `shift` on of keys less `first`."""
    mask = (1 << digit) - 1
    place = np.zeros(mask + 2, np.int64)
    for i in range(len(keys)):
        place[(((keys[i] - first) >> shift) & mask) + 1] += 1
    for value in range(mask):
        place[value + 1] += place[value]
    for i in range(len(order)):
        value = ((keys[order[i]] - first) >> shift) & mask
        out[place[value]] = order[i]
        place[value] += 1
