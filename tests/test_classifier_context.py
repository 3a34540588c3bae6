"""Context features against a slow reference, and what must hold of them: order, threads, tiles, `where`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.context import CELLS, OWN, Context, around
from pdal_stages.classifier.smoothing import WHOLE, count_shares
from pdal_stages.classifier.sweep import Passed, Sweep

TOKENS = ("own", "box0.5", "box1", "column2", "columnvotes4", "boxvotes1", "column0.125")


def reference(xyz, shares, rows, context):
    """Loops over all pairs of points."""
    columns = []
    for token in context.tokens:
        if token == OWN:
            columns.append(shares[rows] / WHOLE)
            continue
        scale = next(s for s in context.scales if s.token == token)
        cell = np.floor(xyz[:, : scale.kind.axes] / scale.side)
        what = shares.astype(float)
        if scale.kind.votes:
            what = np.eye(shares.shape[1])[shares.argmax(axis=1)] * WHOLE
        near = (np.abs(cell[rows][:, None] - cell[None]) <= 1).all(axis=2)
        means = [what[one].sum(axis=0) / (one.sum() * WHOLE) for one in near]
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
        xyz[:2] = [[1e11, -1e11, 1e11], [-1e11, 1e11, -1e11]][: len(xyz[:2])]
    shares = count_shares(random.dirichlet([0.4, 0.4, 0.4], n))
    return xyz, shares


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from([1, 2, 7, 300]),
    st.sampled_from(["even", "copies", "corners", "far"]),
)
def test_equals_the_reference(seed, n, kind):
    xyz, shares = cloud(seed, n, kind)
    context = Context(TOKENS)
    rows = np.flatnonzero(np.random.default_rng(seed).random(n) < 0.5)
    out = np.full((len(rows), len(TOKENS) * 3), np.nan, np.float32)
    context.tables(xyz, shares, 2).fill(rows, out)
    assert np.array_equal(out, reference(xyz, shares, rows, context))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from(["even", "copies", "far"]),
    st.booleans(),
    st.sampled_from([0.0, 3000.0, 1e9]),
    st.integers(1, 60),
)
def test_strip_by_strip_is_the_same(seed, kind, asc, room, size):
    """Whatever blocks come in whatever order, however much is kept: every wanted point once, same bits."""
    xyz, shares = cloud(seed, 300, kind)
    random = np.random.default_rng(seed)
    context = Context(("own", "box0.5", "columnvotes2", "column4"))
    wanted = None if seed % 3 == 0 else np.flatnonzero(random.random(300) < 0.3)
    coming = around(xyz, wanted, context)
    all_coming = np.arange(300) if coming is None else coming
    features = random.random((300, 4)).astype(np.float32)
    order = all_coming[np.argsort(xyz[all_coming, 1])] if asc else random.permutation(all_coming)
    blocks = [
        Passed(part, shares[part], features[part])
        for part in (order[k : k + size] for k in range(0, len(order), size))
    ]

    def again(rows, apply):
        assert (np.diff(rows) > 0).all()
        for part in np.array_split(rows, 3):
            yield part, apply(features[part], part)

    sweep = Sweep(xyz, coming, wanted, context, 3, threads=2, keep_bytes=room, again=again)
    got = np.full((300, 16), np.nan, np.float32)
    seen = np.zeros(300, int)
    for rows, (values, columns) in sweep.run(blocks, lambda values, rows, columns: (values, columns)):
        seen[rows] += 1
        got[rows] = np.hstack([values, columns])
    rows = np.arange(300) if wanted is None else wanted
    assert (seen[rows] == 1).all() and seen.sum() == len(rows)
    assert np.array_equal(got[rows], np.hstack([features[rows], reference(xyz, shares, rows, context)]))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["even", "corners", "far"]))
def test_what_is_around_is_all_that_matters(seed, kind):
    xyz, shares = cloud(seed, 400, kind)
    context = Context(("box1", "column2"))
    rows = np.random.default_rng(seed).permutation(400)[:5]
    rows.sort()
    near = around(xyz, rows, context)
    near = np.arange(400) if near is None else near
    out = np.empty((5, 6), np.float32)
    context.tables(xyz[near], shares[near]).fill(np.searchsorted(near, rows), out)
    assert np.array_equal(out, reference(xyz, shares, rows, context))
    far = np.abs(xyz[:, None, :2] - xyz[None, rows, :2]).max(axis=2).min(axis=1) >= context.reach
    alone = np.flatnonzero(~far)  # a tile with that halo
    context.tables(xyz[alone], shares[alone]).fill(np.searchsorted(alone, rows), out)
    assert np.array_equal(out, reference(xyz, shares, rows, context))


def test_around_of_nothing_and_of_all():
    xyz, _ = cloud(0, 50)
    context = Context(("column8",))
    assert around(xyz, None, context) is None
    assert len(around(xyz, np.zeros(0, np.int64), context)) == 0
    assert around(xyz, np.arange(50), context) is None
    some = np.array([3, 7])
    assert around(xyz, some, Context((OWN,))) is some


def test_names_and_reach():
    context = Context.parse("own, box0.5,columnvotes8, own")
    assert context.tokens == ("own", "box0.5", "columnvotes8") and context.reach == 16.0
    assert context.names((2, 6)) == (
        "Probability_2_own", "Probability_6_own", "Probability_2_box0_5", "Probability_6_box0_5",
        "Probability_2_columnvotes8", "Probability_6_columnvotes8",
    )  # fmt: skip
    assert all(kind.text for kind in CELLS.values())


@pytest.mark.parametrize(
    "token", ["box", "box0.7", "box1000", "sphere1", "own2", "column-2", "box1e0", "OWN"]
)
def test_tokens_that_are_not_known(token):
    with pytest.raises(OptionError, match="power of two"):
        Context.parse([token])
