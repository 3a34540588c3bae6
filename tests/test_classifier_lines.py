"""Lines: cubes that a pass calls wires, joined over space, as the next pass reads them."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.classifier.context_features import Context
from pdal_stages.classifier.lines import COLUMNS, RULES, describe_lines
from pdal_stages.features.cell_means import WHOLE

CODES = (2, 5, 14)
WIRE = CODES.index(14)


def votes(classes):
    shares = np.zeros((len(classes), len(CODES)), np.uint16)
    shares[np.arange(len(classes)), [CODES.index(code) for code in classes]] = WHOLE
    return shares


def described(xyz, classes, rows=slice(None)):
    context = Context(("lines14",))
    columns = context.cell_means(xyz, votes(classes), codes=CODES).columns(np.arange(len(xyz)))
    return columns[rows]


def slow(xyz, classes):
    """Flood each point's window of 3 x 3 blocks by itself."""
    cell = np.floor(xyz / RULES.cell).astype(int)
    block = np.floor(xyz[:, :2] / RULES.block).astype(int)
    counts = {}
    for key, code in zip(map(tuple, cell), classes, strict=True):
        of, others = counts.get(key, (0, 0))
        counts[key] = (of + (code == 14), others + (code not in (2, 14)))
    won = {key for key, (of, others) in counts.items() if of and of >= others}
    size = round(RULES.block / RULES.cell)
    out = np.full((len(xyz), len(COLUMNS)), -1.0)
    for n, (key, home) in enumerate(zip(map(tuple, cell), block, strict=True)):
        window = {
            k for k in won if max(abs(k[0] // size - home[0]), abs(k[1] // size - home[1])) < 2
        }
        if key not in window:
            continue
        line, edge = {key}, [key]
        while edge:
            i, j, k = edge.pop()
            near = {
                (i + a, j + b, k + c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)
            }
            edge += (new := (near & window) - line)
            line |= new
        sides = np.ptp(np.array(sorted(line)), axis=0) + 1
        of, others = np.sum([counts[k] for k in line], axis=0)
        along = np.hypot(*sides[:2])
        out[n] = (
            RULES.cell * along,
            len(line) / along,
            RULES.cell * sides[2],
            others / (of + others),
            1.0,
        )
    return out


@pytest.mark.parametrize("seed", range(4))
def test_lines_against_floods_of_each_window(seed):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-60, 1e6, 0), (60, 1e6 + 60, 30), (400, 3))
    classes = rng.choice(CODES, len(xyz), p=(0.3, 0.1, 0.6))
    np.testing.assert_allclose(described(xyz, classes), slow(xyz, classes), rtol=1e-6)


def test_a_wire_is_long_and_specks_in_a_crown_are_none():
    rng = np.random.default_rng(0)
    along = np.arange(0.0, 100.0, 1.5)
    wire = np.column_stack([along, 0.3 * along, 12.0 + 0 * along])
    crown = rng.uniform((40, 60, 2), (60, 80, 12), (3000, 3))
    xyz = np.concatenate([wire, crown])
    classes = np.r_[np.full(len(wire), 14), np.where(rng.random(len(crown)) < 0.02, 14, 5)]
    columns = dict(zip(COLUMNS, described(xyz, classes).T, strict=True))
    middle = (along > 40) & (along < 60)
    assert (columns["LineLength"][: len(wire)][middle] > 40).all()
    assert (columns["LineCells"][: len(wire)] < 2).all()
    assert (columns["LineLength"][len(wire) :] == -1).all()


def test_order_and_what_is_farther_than_two_blocks_change_nothing():
    rng = np.random.default_rng(1)
    xyz = rng.uniform((0, 0, 0), (200, 200, 20), (3000, 3))
    classes = rng.choice(CODES, len(xyz), p=(0.3, 0.1, 0.6))
    every = described(xyz, classes)
    order = rng.permutation(len(xyz))
    assert np.array_equal(described(xyz[order], classes[order]), every[order])
    block = np.floor(xyz[:, :2] / RULES.block)
    inner = (np.abs(block - 5) <= 0).all(axis=1)
    seen = (np.abs(block - 5) <= 2).all(axis=1)
    assert np.array_equal(described(xyz[seen], classes[seen])[inner[seen]], every[inner])
    assert Context(("lines14",)).reach == 2 * RULES.block


def test_without_votes_nothing_is_described():
    xyz = np.random.default_rng(0).uniform(0, 10, (50, 3))
    context = describe_lines(xyz, votes(np.full(50, 5)), WIRE, 0)
    assert (context.columns(np.arange(50)) == -1).all()
