"""Columns that are looked up when they are asked for hold what arrays would."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.base.lazycolumns import LazyColumn, Taken, as_column
from pdal_stages.classifier.model import _places
from pdal_stages.features.cells import MeanColumn, cell_means, take_means


def columns():
    rng = np.random.default_rng(0)
    values, rows = rng.uniform(0, 9, 50).astype(np.float32), rng.integers(0, 50, 80).astype(np.int32)
    yield Taken(values, rows), values[rows]
    xyz, shares = rng.uniform(0, 9, (80, 3)), rng.integers(0, 65536, (80, 2)).astype(np.uint16)
    cell, means = cell_means(xyz, shares, 2.0)
    whole = np.empty((80, 2), np.float32)
    take_means(cell, means, np.arange(80), whole)
    yield MeanColumn(cell, means, 1), whole[:, 1]


@pytest.mark.parametrize("number", [0, 1])
def test_they_hold_what_arrays_would(number):
    lazy, expected = list(columns())[number]
    assert isinstance(as_column(lazy), LazyColumn) and as_column(lazy) is lazy
    assert lazy.shape == expected.shape and lazy.dtype == expected.dtype and len(lazy) == 80
    assert np.array_equal(np.asarray(lazy), expected)
    assert np.array_equal(np.asarray(lazy, np.float64), expected.astype(np.float64))
    for index in (slice(3, 40, 2), np.array([5, 5, 0, 79]), expected > 4):
        assert np.array_equal(lazy[index], expected[index])


def test_rows_are_found_again_in_another_order():
    order = np.random.default_rng(1).permutation(40)
    rows = np.array([0, 3, 7, 39])
    found = _places(order, rows)
    assert sorted(order[found].tolist()) == rows.tolist() and (np.diff(found) > 0).all()
