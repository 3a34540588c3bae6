"""The grid of cells: numbers, keys, windows and neighbors."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.grid import (
    GridWindow,
    cell_keys,
    cell_numbers,
    compact_keys,
    group_by_key,
    split_keys,
)


def test_a_cell_holds_its_lower_edge_and_not_its_upper_one():
    assert cell_numbers(np.array([-0.5, 0.0, 1.99, 2.0, -2.0]), 2.0).tolist() == [-1, 0, 0, 1, -1]


@pytest.mark.parametrize("coordinate", [np.nan, np.inf, 1e300])
def test_coordinates_that_no_survey_has_are_refused(coordinate):
    with pytest.raises(StageError, match="too large for the grid"):
        cell_numbers(np.array([0.0, coordinate]), 1.0)


def test_keys_ascend_by_layer_row_and_column_and_can_be_split():
    rng = np.random.default_rng(0)
    column, row = rng.integers(-(2**31) + 2, 2**31 - 2, 500), rng.integers(-(2**26), 2**26, 500)
    layer = rng.integers(0, 7, 500)
    keys = cell_keys(column, row, layer)
    assert (np.argsort(keys) == np.lexsort((column, row, layer))).all()
    assert all((a == b).all() for a, b in zip(split_keys(keys), (column, row, layer), strict=True))


@pytest.mark.parametrize("row, layer", [(2**31, 0), (2**26 + 1, 1)])
def test_cells_that_keys_cannot_hold_are_refused(row, layer):
    with pytest.raises(StageError, match="too large for the grid"):
        cell_keys(np.array([0]), np.array([-row]), layer)


def test_groups_ascend_by_key_and_keep_the_order_of_their_members():
    groups = group_by_key(np.array([5, 1, 5, -3]))
    assert [group.tolist() for group in groups] == [[3], [1], [0, 2]]


def test_windows():
    window = GridWindow.enclosing(np.array([3, 7]), np.array([-2, 1]))
    assert (window, window.shape) == ((3, -2, 5, 4), (4, 5))
    assert window.padded(2) == (1, -4, 9, 8)
    assert window.contains(np.array([3, 8]), np.array([1, 1])).tolist() == [True, False]
    raster = np.arange(20).reshape(window.shape)
    assert raster.ravel()[window.flat_index(np.array([4]), np.array([0]))] == raster[2, 1]
    other = GridWindow(6, 0, 10, 10)
    assert window.intersect(other) == (6, 0, 2, 2)
    assert raster[window.intersect(other).slices_in(window)].tolist() == [[13, 14], [18, 19]]
    assert window.intersect(GridWindow(90, 90, 2, 2)).shape == (0, 0)


@pytest.mark.parametrize("axes", [2, 3])
def test_offsets_of_compact_keys_lead_to_the_neighbors(axes):
    xyz = np.random.default_rng(1).uniform(-4, 4, (200, 3))
    keys, offsets = compact_keys(xyz[:, :axes], 0.5)
    cells = np.floor(xyz[:, :axes] / 0.5)
    beside = (np.abs(cells[:, None] - cells) <= 1).all(axis=2)
    near = np.add.outer(offsets, [-1, 0, 1]).ravel()
    assert (np.isin(keys[:, None] - keys, near) == beside).all()
    with pytest.raises(StageError, match="too large for the grid"):
        compact_keys(np.concatenate([xyz, [[1e12, -1e12, 1e12]]])[:, :axes], 0.5)
