"""Context features against a slow reference, and what must hold of them: order, threads, tiles, `where`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.context_features import OWN, WHOLE, Context, count_shares, rows_needed

KINDS = ["even", "copies", "corners", "far"]
TOKENS = ("own", "box0.5", "box1", "column2", "columnvotes4", "boxvotes1", "column0.125")


def reference(xyz, shares, rows, context):
    """Loops over all pairs of points."""
    columns = []
    for token in context.tokens:
        if token == OWN:
            columns.append(shares[rows] / WHOLE)
            continue
        side, axes, votes = context.scales[token]
        cell = np.floor(xyz[:, :axes] / side)
        what = shares.astype(float)
        if votes:
            what = np.eye(shares.shape[1])[shares.argmax(axis=1)] * WHOLE
        near = (np.abs(cell[rows][:, None] - cell[None]) <= 1).all(axis=2)
        means = [what[entry].sum(axis=0) / (entry.sum() * WHOLE) for entry in near]
        columns.append(np.array(means).reshape(shares[rows].shape))
    return np.hstack(columns).astype(np.float32)


def cloud(seed, n, kind="even"):
    random = np.random.default_rng(seed)
    xyz = random.uniform(-9, 9, (n, 3)) * (1, 3, 0.4)
    if kind == "copies":
        xyz = np.round(xyz)
    if kind == "corners":  # exactly on the cells' corners
        xyz = np.round(xyz * 2) / 2
    if kind == "far":
        xyz[: n // 2] += (631_000.0, 6_270_000.0, 40.0)
    shares = count_shares(random.dirichlet([0.4, 0.4, 0.4], n))
    return xyz, shares


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 7, 200]), st.sampled_from(KINDS))
def test_equals_the_reference(seed, n, kind):
    xyz, shares = cloud(seed, n, kind)
    context = Context(TOKENS)
    rows = np.flatnonzero(np.random.default_rng(seed).random(n) < 0.5)
    assert np.array_equal(
        context.cell_means(xyz, shares, 2).columns(rows), reference(xyz, shares, rows, context)
    )


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["even", "corners", "far"]))
def test_what_is_around_is_all_that_matters(seed, kind):
    xyz, shares = cloud(seed, 400, kind)
    context = Context(("box1", "column2"))
    rows = np.random.default_rng(seed).permutation(400)[:5]
    rows.sort()
    near = rows_needed(xyz, rows, context)
    near = np.arange(400) if near is None else near
    expected = reference(xyz, shares, rows, context)
    assert np.array_equal(
        context.cell_means(xyz[near], shares[near]).columns(np.searchsorted(near, rows)), expected
    )
    far = np.abs(xyz[:, None, :2] - xyz[None, rows, :2]).max(axis=2).min(axis=1) >= context.reach
    alone = np.flatnonzero(~far)  # a tile with that halo
    assert np.array_equal(
        context.cell_means(xyz[alone], shares[alone]).columns(np.searchsorted(alone, rows)),
        expected,
    )


def test_names_and_reach():
    context = Context.parse("own, box0.5,columnvotes8, own")
    assert context.tokens == ("own", "box0.5", "columnvotes8") and context.reach == 16.0
    assert context.names((2, 6)) == (
        "Probability_2_own", "Probability_6_own", "Probability_2_box0_5", "Probability_6_box0_5",
        "Probability_2_columnvotes8", "Probability_6_columnvotes8",
    )  # fmt: skip


@pytest.mark.parametrize(
    "token", ["box", "box0.7", "box1000", "sphere1", "own2", "column-2", "box1e0", "OWN"]
)
def test_tokens_that_are_not_known(token):
    with pytest.raises(OptionError, match="power of two"):
        Context.parse([token])
