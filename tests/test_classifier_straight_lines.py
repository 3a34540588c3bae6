"""Straight lines: what a model calls wires must lie on a line of such points."""

from __future__ import annotations

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import ModelError
from pdal_stages.classifier.interface import Block, PredictRequest
from pdal_stages.classifier.model import assemble
from pdal_stages.classifier.straight_lines import REACH, RULES, keep_to_lines, lie_on_lines

#: Classes of the probabilities below.
CODES = np.array([2, 5, 14])
IS_LINE = CODES == 14
#: Largest gaps and least extents of lines.
KINDS = ((RULES.gap, RULES.length), (RULES.short_gap, RULES.short))


def wire(length, step=1.0, across=0.0, sag=0.02, above=12.0):
    """Return a wire (n, 3) along x that sags by a share of its length."""
    x = np.arange(0.0, length, step)
    z = above - 4.0 * sag * length * (x / length) * (1.0 - x / length)
    return np.column_stack([x, 0.1 * x + across, z])


def extent(places, gap, least):
    """Return how far places reach from 0 without a larger gap, as a share of what a line needs."""
    reached = 0.0
    for side in (1, -1):
        end = 0.0
        for place in np.sort(side * places[side * places > 0]):
            if place - end > gap:
                break
            end = place
        reached += end
    return reached / least


def slow(points, candidates):
    """Walk along the tubes of each point by itself."""
    cubes = {}
    for place in sorted(map(tuple, candidates), key=lambda place: place[::-1]):
        cubes.setdefault(tuple(np.floor(np.array(place) / RULES.cube)), place)
    parts = np.array(list(cubes.values()))
    cell = np.floor(parts[:, :2] / RULES.radius)
    parts = parts[np.lexsort((*parts.T, *cell.T))]
    out = []
    for point in points:
        near = parts - point
        near = near[np.hypot(*near.T[:2]) <= RULES.radius]
        longest = 0.0
        for toward in near[:: max(1, len(near) // RULES.directions)]:
            away = np.hypot(*toward[:2])
            if away < RULES.far:
                continue
            u, v, rise = toward / away
            along, aside = near[:, 0] * u + near[:, 1] * v, near[:, 1] * u - near[:, 0] * v
            places = along[np.hypot(aside, near[:, 2] - along * rise) <= RULES.width]
            longest = max(longest, *(extent(places, *kind) for kind in KINDS))
        out.append(longest >= 1.0)
    return np.array(out)


@pytest.mark.parametrize("seed", range(4))
def test_lines_against_a_walk_along_each_tube(seed):
    rng = np.random.default_rng(seed)
    parts = [wire(rng.uniform(20, 90), rng.uniform(0.5, 8), y) for y in rng.uniform(0, 30, 4)]
    specks = rng.uniform((0, 0, 2), (60, 40, 14), (80, 3))
    points = np.add(np.concatenate([*parts, specks]), (1e5, 6e6, 0.0))
    expected = slow(points, points)
    assert np.array_equal(lie_on_lines(points, points), expected)
    assert 0.2 < expected.mean() < 0.98


def test_wires_sag_run_beside_each_other_and_end_and_specks_are_none():
    rng = np.random.default_rng(0)
    lone = wire(60.0, step=4.0)
    bundle = np.concatenate(
        [wire(90.0, 1.5, 50.0 + across, above=above) for across in (0, 4, 8) for above in (12, 16)]
    )
    crown = rng.uniform((20, 200, 4), (30, 210, 12), (20, 3))
    short = wire(0.8 * RULES.length, 1.5 * RULES.short_gap, 400.0)
    for points, expected in ((lone, True), (bundle, True), (crown, False), (short, False)):
        every = np.concatenate([lone, bundle, crown, short])
        for candidates in (points, every):
            assert (lie_on_lines(points, candidates) == expected).mean() > 0.95
    assert not len(lie_on_lines(lone[:0], lone[:0]))


def test_order_and_what_is_farther_than_the_reach_change_nothing():
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [wire(200.0, 2.0), wire(200.0, 2.0, 5.0), rng.uniform(0, (200, 20, 12), (300, 3))]
    )
    every = lie_on_lines(points, points)
    order = rng.permutation(len(points))
    assert np.array_equal(lie_on_lines(points[order], points), every[order])
    inner = abs(points[:, 0] - 100.0) < 20.0
    seen = abs(points[:, 0] - 100.0) < 20.0 + REACH
    assert np.array_equal(lie_on_lines(points[inner], points[seen]), every[inner])


def probabilities(rows, winner):
    p = np.tile([0.1, 0.2, 0.0], (len(rows), 1))
    p[np.arange(len(rows)), winner[rows]] += 0.7
    return p


def kept(xyz, winner, wanted=None):
    """Return the classes of the wanted points, and how often the passes ran."""
    runs = []

    def predict(request):
        rows = np.arange(len(xyz)) if request.rows is None else request.rows
        runs.append(rows)
        for part in np.array_split(rows, 3):
            yield Block(part, probabilities(part, winner))

    out = np.full(len(xyz), -1)
    for block in keep_to_lines(predict, PredictRequest(xyz, {}, wanted), IS_LINE):
        assert (out[block.rows] == -1).all()
        np.testing.assert_allclose(block.probabilities.sum(axis=1), 1.0)
        out[block.rows] = CODES[block.probabilities.argmax(axis=1)]
    return out if wanted is None else out[wanted], len(runs)


def test_specks_get_the_class_that_is_next_likely_and_tiles_are_as_the_whole():
    rng = np.random.default_rng(2)
    crown = rng.uniform((0, 20, 2), (150, 60, 12), (4000, 3))
    xyz = np.concatenate([wire(150.0, 1.0), crown])
    winner = np.where(rng.random(len(xyz)) < 0.02, 2, 1)
    winner[:150] = 2
    classes, runs = kept(xyz, winner)
    assert runs == 1
    assert (classes[:150] == 14).all()
    assert set(classes[150:]) == {5}
    for west in (0, 50, 100):
        tile = np.flatnonzero((xyz[:, 0] >= west) & (xyz[:, 0] < west + 50))
        part, runs = kept(xyz, winner, tile)
        assert runs == 2
        assert np.array_equal(part, classes[tile])


def test_nothing_runs_twice_where_nothing_is_called_a_line():
    xyz = np.random.default_rng(3).uniform(0, 50, (500, 3))
    winner = np.ones(500, int)
    winner[400:] = 2
    classes, runs = kept(xyz, winner, np.arange(300))
    assert runs == 1
    assert (classes == 5).all()


def test_what_is_almost_surely_a_line_stays():
    xyz, p = np.zeros((3, 3)), np.array([[0.0, 0.0, 1.0], [0.01, 0.03, 0.96], [0.0, 0.1, 0.9]])

    def predict(request):
        yield Block(np.arange(3), p)

    (_, block) = keep_to_lines(predict, PredictRequest(xyz, {}), IS_LINE)
    assert CODES[block.probabilities.argmax(axis=1)].tolist() == [14, 14, 5]


def test_a_model_says_which_classes_lie_on_lines(tmp_path):
    rng = np.random.default_rng(5)
    ground = rng.uniform((0, 0, 0), (60, 60, 0.1), (3000, 3))
    xyz = np.concatenate([ground, wire(60.0, 0.5, 10.0)])
    labels = np.repeat([2, 14], [3000, 120])
    cloud = ps.TrainingCloud(xyz, labels, {"HeightAboveGround": xyz[:, 2]})
    options = {"neighborhoods": "k10", "passes": 1, "trees": 8, "folds": 0, "voxel": 0}
    free, bound = (
        ps.train(cloud, ps.TrainingOptions(**options, lines=lines), progress=False)
        for lines in ((), (14,))
    )
    assert "lines" not in free.info and bound.info["lines"] == [14]
    assert bound.halo_m == free.halo_m + REACH
    bound.save(tmp_path / "lines.model")
    for model in (bound, ps.load_model(tmp_path / "lines.model")):
        assert (model.predict(xyz, cloud.dimensions).classification[3000:] == 14).all()
    manifest = bound.manifest() | {"lines": [15]}
    with pytest.raises(ModelError, match="no such class"):
        assemble(manifest, [each.arrays() for each in bound.passes])
