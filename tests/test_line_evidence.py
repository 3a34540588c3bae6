"""Evidence of lines: wires lie on a line of candidates, in two steps, and alone there."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.classifier.line_evidence import REACH, RULES, find_lines

#: Coordinates are multiples of this: sums and differences of them are exact.
STEP = 2.0**-10


def wire(length, step=1.0, across=0.0, sag=0.02, above=12.0):
    """Return a wire (n, 3) along x that sags by a share of its length."""
    x = np.arange(0.0, length, step)
    z = above - 4.0 * sag * length * (x / length) * (1.0 - x / length)
    return np.column_stack([x, 0.1 * x + across, z])


def scene(seed):
    """Return wires and specks around them (m, 3) and their probabilities (m,)."""
    rng = np.random.default_rng(seed)
    wires = [wire(rng.uniform(20, 90), rng.uniform(0.5, 6), y) for y in rng.uniform(0, 40, 4)]
    specks = rng.uniform((-20, -20, 2), (110, 60, 14), (150, 3))
    crown = rng.normal((30, 10, 11), 1.5, (100, 3))
    xyz = np.round(np.concatenate([*wires, specks, crown]) / STEP) * STEP
    line = np.arange(len(xyz)) < sum(map(len, wires))
    p = np.where(line, rng.uniform(0.2, 1.0, len(xyz)), rng.uniform(0.05, 0.5, len(xyz)))
    return np.add(xyz, (1e5, 6e6, 0.0)), p.astype(np.float32)


def end(places, gap):
    """Return how far ascending places beyond 0 reach from it without a larger gap."""
    reached = 0.0
    for place in places[places > 0]:
        if place - reached > gap:
            break
        reached = place
    return reached


def lies_on_line(point, p_point, parts, p, guides, p_guides):
    """Tell whether a point lies on a line of parts (m, 3) toward a guide (g, 3), by definition."""

    def beside(others, toward):
        u = toward / np.hypot(*toward[:2])
        along = others[:, :2] @ u[:2]
        return along, np.linalg.norm(others - along[:, None] * u, axis=1)

    def near(others):
        return np.hypot(*(others - point).T[:2]) <= RULES.radius

    p, p_guides = p[near(parts)].astype(float), p_guides[near(guides)].astype(float)
    parts, guides = parts[near(parts)] - point, guides[near(guides)] - point
    most = RULES.guides
    side = 0.0 if p_point >= RULES.likely else RULES.side
    for toward in guides[:: max(1, len(guides) ** 2 // RULES.looks)]:
        if np.hypot(*toward[:2]) < RULES.far:
            continue
        _, away = beside(guides, toward)
        of_guides = (p_guides * np.maximum(0, 1 - (away / RULES.width) ** 2)).sum()
        if of_guides < most:
            continue
        most = of_guides
        along, away = beside(parts, toward)
        tube, ring = away <= RULES.width, away <= RULES.ring
        places = np.sort(along[tube])
        gap = RULES.usual_gaps * sorted(np.diff(places))[(len(places) - 2) // 2]
        low, high = (sign * end(np.sort(sign * places), min(RULES.gap, gap)) for sign in (-1, 1))
        worth = np.where(tube, 1 - (away / RULES.width) ** 2, -RULES.against * (1 - p_point) * ring)
        between = (along >= low) & (along <= high)
        enough = (p * worth)[between].sum() >= RULES.evidence
        sides = [(p * worth)[between & tube & (sign * along > 0)].sum() for sign in (-1, 1)]
        if high - low >= RULES.length and enough and min(sides) >= side:
            return True
    return False


def slow(xyz, p):
    """Return which candidates (m,) lie on lines, point by point."""
    cubes = {}
    for row in sorted(range(len(xyz)), key=lambda row: (-p[row], *xyz[row])):
        cubes.setdefault(tuple(np.floor(xyz[row] / RULES.cube)), row)
    parts = np.array(list(cubes.values()), int)
    cube, cell = np.floor(xyz[parts] / RULES.cube), np.floor(xyz[parts, :2] / RULES.radius)
    parts = parts[np.lexsort((*cube.T[[2, 0, 1]], *cell.T))]
    guides = parts[p[parts] >= RULES.likely]
    for step in (guides, np.arange(len(xyz))):
        given = xyz[parts], p[parts], xyz[guides], p[guides]
        result = np.array([lies_on_line(xyz[row], p[row], *given) for row in step], bool)
        guides = guides[result] if step is guides else guides
    return result


@pytest.mark.parametrize("seed", range(4))
def test_lines_against_their_definition(seed):
    xyz, p = scene(seed)
    expected = slow(xyz, p)
    assert np.array_equal(find_lines(xyz, p), expected)
    assert 0.05 < expected.mean() < 0.8


def test_lines_of_many_guides_are_tried_in_part():
    rng = np.random.default_rng(5)
    sheet = rng.uniform((0, 0, 5), (30, 30, 6), (600, 3))
    xyz = np.round(np.concatenate([sheet, wire(40.0, 0.5, 3.0)]) / STEP) * STEP
    p = np.where(np.arange(len(xyz)) < 600, rng.uniform(0.35, 0.5, len(xyz)), 1.0)
    p = p.astype(np.float32)
    expected = slow(xyz, p)
    assert np.array_equal(find_lines(xyz, p), expected)
    assert expected[600:].all()
    assert expected[:600].mean() < 0.05


def test_a_wire_is_long_and_alone_and_needs_likely_points():
    def share(xyz, p):
        return find_lines(xyz, np.full(len(xyz), p, np.float32)).mean()

    assert share(wire(60.0), 0.6) == 1.0
    assert share(wire(60.0, 1.0), 0.34) == 0.0
    assert share(wire(9.0, 0.6), 1.0) == 0.0
    assert share(wire(60.0, 18.0), 1.0) == 0.0
    four = np.concatenate([wire(60.0, across=y, above=z) for y in (0, 0.7) for z in (10, 10.7)])
    assert share(four, 0.9) == 1.0
    assert share(four, 0.4) == 0.0


def test_all_candidates_look_toward_guides_that_lie_on_lines():
    xyz = wire(60.0)
    p = np.where(np.arange(len(xyz)) % 3, 0.06, 1.0).astype(np.float32)
    assert find_lines(xyz, p)[:-2].all()


def test_what_is_no_guide_lies_between_parts_of_its_line():
    xyz = wire(60.0)
    p = np.where(np.abs(xyz[:, 0] - 30.0) < 20.0, 0.9, 0.2).astype(np.float32)
    ends = np.flatnonzero(~find_lines(xyz, p))  # beyond them less than 0.5 of evidence
    assert ends.tolist() == [0, 1, 2, 57, 58, 59]
    assert find_lines(xyz, np.full(60, 0.9, np.float32)).all()


def test_gaps_of_a_line_are_of_the_kind_of_its_usual_ones():
    away = np.array((9.0, 0.9, 0.0))
    dense = wire(18.0, 0.6, sag=0.0)
    apart = np.concatenate([dense[:14], dense[14:] + away])
    sparse = wire(60.0, 3.0, sag=0.0)
    thinned = np.concatenate([sparse[:8], sparse[8:] + away])
    assert not find_lines(apart, np.ones(len(apart), np.float32)).any()
    assert find_lines(thinned, np.ones(len(thinned), np.float32)).all()


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.zeros((500, 3)),
        np.column_stack([np.zeros(500), np.zeros(500), np.arange(500.0)]),
        np.repeat(wire(6.0), 50, axis=0),
    ],
    ids=["none", "one", "one place", "vertical", "short, many times"],
)
def test_degenerate_candidates_lie_on_no_line(xyz):
    assert not find_lines(xyz, np.ones(len(xyz), np.float32)).any()


@pytest.mark.parametrize("seed", range(3))
def test_neither_order_nor_threads_nor_whole_cells_matter(seed):
    xyz, p = scene(seed)
    xyz, p = np.concatenate([xyz, xyz[::3], xyz[::3]]), np.concatenate([p, p[::3], p[1::3], p[:2]])
    p = np.round(p, 1)[: len(xyz)] + np.float32(0.05)  # many are equally likely
    xyz = xyz[: len(p)]
    first = find_lines(xyz, p)
    order = np.random.default_rng(seed).permutation(len(xyz))
    assert np.array_equal(find_lines(xyz[order], p[order], threads=3), first[order])
    moved = np.add(xyz, (-40 * RULES.radius, 7 * RULES.radius, 3 * RULES.cube))
    assert np.array_equal(find_lines(moved, p), first)
    assert first.any()


def test_what_lies_farther_than_its_reach_does_not_matter():
    xyz, p = scene(1)
    first = find_lines(xyz, p)
    center = xyz[first][0]
    away = np.hypot(*(xyz - center).T[:2])
    for seed in range(3):
        rng = np.random.default_rng(seed)
        kept = (away <= REACH) | (rng.random(len(xyz)) < 0.5)
        changed = np.where(away <= REACH, p, rng.uniform(0.05, 1.0, len(p))).astype(np.float32)
        result = find_lines(xyz[kept], changed[kept])
        at_center = away[kept] == 0
        assert np.array_equal(result[at_center], first[away == 0])


@pytest.mark.parametrize("side", [25.0, 40.0])
def test_tiles_with_their_surroundings_find_what_the_whole_finds(side):
    xyz, p = scene(2)
    whole = find_lines(xyz, p)
    tile = np.floor(xyz[:, :2] / side)
    for own in np.unique(tile, axis=0):
        low, high = own * side - REACH, (own + 1) * side + REACH
        seen = ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)
        inside = (tile == own).all(axis=1)
        assert np.array_equal(find_lines(xyz[seen], p[seen])[inside[seen]], whole[inside])
