"""Lines of wires that cross, bend, or run side by side."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.objects import Cells, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.lines import parted

CELL = 0.5


def line_of(start, end, z=8.0, every=0.15):
    """Points along a straight line (n, 3)."""
    t = np.linspace(0, 1, max(2, int(np.hypot(*np.subtract(end, start)) / every)))[:, None]
    xy = np.array(start) + t * np.subtract(end, start)
    return np.column_stack([xy, np.full(len(xy), z)])


def turned(middle, length, degrees, aside=0.0):
    """A line through a place, moved aside."""
    way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    middle = np.array(middle) + aside * np.array([-way[1], way[0]])
    return line_of(middle - way * length / 2, middle + way * length / 2)


def cells_of(points):
    """Rows and columns of cells, row by row."""
    cells = np.unique(np.floor(points[:, [1, 0]] / CELL).astype(np.int64), axis=0)
    return cells[:, 0], cells[:, 1]


def labels(*lines_, gap=2.0):
    points = np.concatenate(lines_)
    row, column = cells_of(points)
    got = parted(row, column, CELL, gap)
    here = {(r, c): n for r, c, n in zip(row, column, got, strict=True)}
    return got, [np.array([here[int(y // CELL), int(x // CELL)] for x, y in one[:, :2]]) for one in lines_]


@pytest.mark.parametrize("turn", [0, 17, 45, 90, 133])
@pytest.mark.parametrize("between", [25, 40, 60, 90, 140])
def test_two_lines_that_cross_are_two(turn, between):
    got, (one, other) = labels(
        turned((1003.2, 2001.7), 40, turn), turned((1005.0, 2003.0), 30, turn + between)
    )
    assert got.max() == 1
    # All but where they cross: each is of one line, and they are different ones.
    assert (one == np.bincount(one).argmax()).mean() > 0.85
    assert (other == np.bincount(other).argmax()).mean() > 0.75
    assert np.bincount(one).argmax() != np.bincount(other).argmax()


@pytest.mark.parametrize("turn", [0, 30, 90])
def test_a_line_that_ends_at_another_is_another(turn):
    way = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    along = turned((50.0, 50.0), 60, turn)
    drop = line_of((50.0, 50.0), np.array([50.0, 50.0]) + 18 * np.array([-way[1], way[0]]))
    assert labels(along, drop)[0].max() == 1


def test_a_bend_parts_and_a_slight_one_does_not():
    for degrees, many in ((30, 2), (60, 2), (4, 1), (0, 1)):
        way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        got, _ = labels(line_of((0, 0), (30, 0)), line_of((30, 0), np.array([30.0, 0]) + 30 * way))
        assert got.max() == many - 1, degrees


@pytest.mark.parametrize("turn", [0, 12, 45, 77])
@pytest.mark.parametrize("apart", [0.6, 1.0, 2.0])
def test_conductors_side_by_side_are_one_span(turn, apart):
    bundle = [turned((30, 30), 40, turn, aside) for aside in (-apart, 0.0, apart)]
    assert labels(*bundle)[0].max() == 0
    # Also where such a span is crossed.
    got, (*mine, other) = labels(*bundle, turned((31, 31), 40, turn + 80))
    assert got.max() == 1
    kept = [np.bincount(one).argmax() for one in mine]
    assert len(set(kept)) == 1 and kept[0] != np.bincount(other).argmax()


def test_what_is_no_line_stays_together():
    rng = np.random.default_rng(4)
    blob = np.column_stack([rng.uniform(0, 12, (4000, 2)), np.zeros(4000)])
    assert labels(blob)[0].max() == 0
    assert labels(line_of((0, 0), (5, 0)), line_of((2, 0), (2, 5)))[0].max() == 0


def test_lines_do_not_hang_on_where_they_lie():
    lines_ = [turned((20, 20), 38, 20), turned((22, 20), 44, 75), turned((30, 24), 20, 140)]
    row, column = cells_of(np.concatenate(lines_))
    here = parted(row, column, CELL, 2.0)
    for by in ((0, 40_000), (7_001, -13)):
        np.testing.assert_array_equal(parted(row + by[0], column + by[1], CELL, 2.0), here)


@pytest.mark.parametrize("block", [32, 64, 2048])
def test_spans_that_cross_are_the_same_in_any_blocks(block):
    wires = np.concatenate([turned((40, 40), 70, 10), turned((42, 41), 60, 70), turned((80, 30), 40, 95)])
    ground = np.column_stack([*(v.ravel() for v in np.meshgrid(np.arange(0, 110.0), np.arange(0, 90.0))),
                              np.zeros(9900)])  # fmt: skip
    codes = np.r_[np.full(len(wires), 14), np.full(len(ground), 2)].astype(np.uint8)
    cells = Cells.of(*np.concatenate([wires, ground]).T, codes, CELL)
    one, other = find_objects(cells), find_objects(cells, block=block)
    table = one.tables[Kind.SPAN]
    assert len(table) >= 3 and not any("not straight" in reason for reason in table.columns["reason"])
    np.testing.assert_array_equal(table.ids, other.tables[Kind.SPAN].ids)
    np.testing.assert_array_equal(one.owner, other.owner)
    for a, b in zip(table.paths, other.tables[Kind.SPAN].paths, strict=True):
        np.testing.assert_array_equal(a, b)
    lengths = np.sort(table.columns["length"])[::-1][:3]
    np.testing.assert_allclose(lengths, [70, 60, 40], atol=1.0)


@pytest.mark.parametrize("cell", [0.1, 0.5, 1.0, 3.0, 20.0])
def test_any_size_of_cells(cell):
    points = np.concatenate([turned((300, 300), 400, 10), turned((310, 300), 300, 80)])
    row, column = np.unique(np.floor(points[:, [1, 0]] / cell).astype(np.int64), axis=0).T
    got = parted(row, column, cell, 2.0)
    assert got.max() == 1 and 0.5 < (got == np.bincount(got).argmax()).mean() < 0.65


def test_what_hangs_together_farther_stays_one():
    points = np.concatenate([line_of((0, 0), (1400, 10)), line_of((700, -200), (710, 200))])
    assert parted(*cells_of(points), CELL, 2.0).max() == 0
