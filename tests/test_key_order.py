"""The order of points by the keys of their cells."""

import numpy as np
import pytest

from pdal_stages.base.key_order import order_by_key


@pytest.mark.parametrize("largest", [0, 1, 2**11 - 1, 2**11, 50_000, 2**40, 2**62])
@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_keys_ascend_and_equal_ones_stay_in_order(largest, count):
    rng = np.random.default_rng(count)
    for least in (0, -largest, largest // 2):
        keys = rng.integers(least, largest + 1, count)
        order = order_by_key(keys)
        assert order.dtype == np.int32
        np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


def test_the_widest_keys():
    keys = np.array([2**63 - 1, 0, -(2**63), 0, -1])
    np.testing.assert_array_equal(order_by_key(keys), [2, 4, 1, 3, 0])
