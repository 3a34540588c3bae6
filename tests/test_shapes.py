"""Shape distributions: pulls against theory, counts against the oracle, thresholds that fill evenly."""

import json
import math

import numpy as np
import oracle
import pytest

from pdal_stages.base.errors import OptionError
from pdal_stages.features import compute_features
from pdal_stages.features.engine import FeatureEngine
from pdal_stages.features.plan import FeaturePlan
from pdal_stages.features.shape_distributions import (
    METRIC_NAMES,
    PULLS,
    ROOM,
    ShapeBins,
    draw,
    make_work,
    point_seeds,
    shape_counts,
    shape_values,
)

f32 = np.float32


def seeds_of(count, seed=0):
    rng = np.random.default_rng(99)
    return point_seeds(*rng.uniform(0, 100, (3, count)), seed, "c1")


def as_record(members):
    members = np.asarray(members, float)
    record = np.full(
        (len(members) + 1, 4), np.nan, f32
    )  # neither the spare row nor the fourth column counts
    record[:-1, :3] = members
    return record, tuple(f32(v) for v in members.mean(axis=0))


def pulls(members, repeats=400, seed=0):
    """Metrics of many neighborhoods' pulls in radians and meters: {"A3": (repeats * 255,), ...}."""
    record, center = as_record(members)
    out, work = np.zeros((5, PULLS), f32), make_work()
    rows = []
    for s in seeds_of(repeats, seed):
        shape_values(record, len(members), center, s, work, out)
        rows.append(out.astype(float))
    a3, d1, d2, d3, d4 = np.concatenate(rows, axis=1)
    angle = np.arccos(np.clip(-np.sign(a3) * np.sqrt(abs(a3)), -1, 1))
    return dict(
        zip(
            METRIC_NAMES,
            (angle, np.sqrt(d1), np.sqrt(d2), (d3 / 4) ** 0.25, np.cbrt(d4 / 6)),
            strict=True,
        )
    )


def ball(n, seed=0, radius=2.0):
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1)[:, None] * radius * rng.uniform(0, 1, (n, 1)) ** (1 / 3)


def close(values, expected, sigma=6):
    """The mean is the expected one, within `sigma` standard errors and what the finite cloud is off."""
    assert values.mean() == pytest.approx(
        expected, abs=sigma * values.std() / math.sqrt(len(values)), rel=0.004
    )


# ---- theory ------------------------------------------------------------------------------------------------


def test_ball():
    v = pulls(ball(60_000), repeats=400)
    close(v["D1"], 3 / 4 * 2)
    close(v["D2"], 36 / 35 * 2)
    close(v["A3"], math.pi / 3)
    close(v["D4"] ** 3, 12 * math.pi / 715 * 2**3)  # mean volume of a random tetrahedron
    d = v["D2"] / 2  # cumulative distribution of the distance in a unit ball
    for t in (0.3, 0.8, 1.0, 1.5):
        assert np.mean(d <= t) == pytest.approx(t**3 - 9 / 16 * t**4 + t**6 / 32, abs=0.006)
    for t in (0.2, 0.5, 0.8):
        assert np.mean(v["D1"] / 2 <= t) == pytest.approx(t**3, abs=0.006)


def test_equilateral_triangle_and_regular_tetrahedron():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0.5, math.sqrt(0.75), 0]])
    v = pulls(triangle, 3)
    assert v["A3"] == pytest.approx(math.pi / 3, abs=1e-3) and v["D2"] == pytest.approx(1, abs=1e-6)
    assert v["D1"] == pytest.approx(1 / math.sqrt(3), abs=1e-6)
    assert v["D3"] == pytest.approx(math.sqrt(math.sqrt(3) / 4), abs=1e-6) and (v["D4"] == 0).all()
    tetrahedron = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(8)
    v = pulls(tetrahedron, 3)
    assert v["D4"] == pytest.approx(
        math.cbrt(1 / (6 * math.sqrt(2))) if hasattr(math, "cbrt") else 0.4903, abs=1e-3
    )
    assert v["A3"] == pytest.approx(math.pi / 3, abs=1e-3) and v["D2"] == pytest.approx(1, abs=1e-6)


# ---- draws -------------------------------------------------------------------------------------------------


def drawn(n, repeats=40):
    work = make_work()
    result = []
    for s in seeds_of(repeats):
        draw(s, n, work.draws)
        result.append(work.draws.reshape(4, ROOM)[:, :PULLS].copy())
    return np.concatenate(result, axis=1)


@pytest.mark.parametrize("n", [4, 5, 50, 70_000, 2**31 - 1])
def test_draws_are_four_different_members(n):
    at = drawn(n).astype(np.int64)
    assert at.min() >= 0 and at.max() < n
    for i in range(4):
        for j in range(i):
            assert (at[i] != at[j]).all()


@pytest.mark.parametrize("n", [4, 7])
def test_every_ordered_choice_is_equally_likely(n):
    at = drawn(n, 2000)
    for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
        pairs = np.bincount(at[i].astype(int) * n + at[j], minlength=n * n).reshape(n, n)
        assert (np.diag(pairs) == 0).all()
        expected = at.shape[1] / (n * (n - 1))
        off = pairs[~np.eye(n, dtype=bool)]
        chi2 = ((off - expected) ** 2 / expected).sum()
        freedom = len(off) - 1
        assert abs(chi2 - freedom) < 6 * math.sqrt(2 * freedom)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_too_few_members(n):
    at = drawn(n)
    assert at.max() < n
    a, b, c, d = at
    if n == 1:
        assert (at == 0).all()
    if n == 2:
        assert (a != b).all() and (c == a).all() and (d == b).all()
    if n == 3:
        assert (a != b).all() and (a != c).all() and (b != c).all() and (d == a).all()
    members = np.random.default_rng(n).uniform(-1, 1, (n, 3))
    v = pulls(members, 3)
    assert (v["D4"] == 0).all()
    if n < 3:
        assert (v["D3"] == 0).all() and (v["A3"] == 0).all()
    if n == 1:
        assert (v["D2"] == 0).all() and (v["D1"] == 0).all()


def test_seeds():
    x, y, z = np.array([[1.0, 2.0], [5e5, 5e5], [-0.0, 0.0]])
    a = point_seeds(x, y, z, 1, "c1")
    assert len(set(a)) == 2
    assert np.array_equal(a, point_seeds(x, y, np.zeros(2), 1, "c1"))  # -0.0 is 0.0
    assert not (a == point_seeds(x, y, z, 2, "c1")).any()
    assert not (a == point_seeds(x, y, z, 1, "c2")).any()
    assert not (a == point_seeds(y, x, z, 1, "c1")).any()
    many = point_seeds(
        *np.random.default_rng(0).integers(0, 1000, (3, 100_000)).astype(float), 0, "s1"
    )
    assert len(np.unique(many)) > 99_900  # as many as there are different points


# ---- counts ------------------------------------------------------------------------------------------------


def counts_and_values(members, bins, seed=0):
    record, center = as_record(members)
    work, counts, values = make_work(), np.zeros(50, f32), np.zeros((5, PULLS), f32)
    s = seeds_of(1, seed)[0]
    shape_counts(record, len(members), center, s, bins.comparable("c1"), work, counts)
    shape_values(record, len(members), center, s, work, values)
    draw(s, len(members), work.draws)
    return counts.reshape(5, 10), values, work.draws.reshape(4, ROOM)[:, :PULLS].copy()


@pytest.mark.parametrize("shape", ["ball", "three", "two", "one", "copies", "line"])
def test_counts_are_the_oracle_s(shape):
    members = {
        "ball": ball(200),
        "three": ball(3),
        "two": ball(2),
        "one": ball(1),
        "copies": np.tile([0.5, 0.25, 1.0], (20, 1)),
        "line": np.outer(np.arange(30.0), [0.125, 0.25, 0]),
    }[shape]
    rows = np.vstack([np.linspace(0.3, 2.8, 9), *[np.linspace(0.1, 3.1, 9)] * 4])
    bins = ShapeBins({"c1": rows})
    counts, _, at = counts_and_values(members, bins)
    assert counts.sum(axis=1) == pytest.approx(1, abs=1e-6)
    assert np.array_equal(np.round(counts * PULLS).sum(axis=1), [PULLS] * 5)
    center = members.mean(axis=0)
    metrics = [oracle.shape_metrics(*members[pull], center) for pull in at.T]
    for m, name in enumerate(METRIC_NAMES):
        expected = np.array([metric[name] for metric in metrics])
        # Values within rounding of a threshold may fall to either side.
        near = (abs(expected[:, None] - rows[m]) < 1e-3).any(axis=1).sum()
        difference = np.abs(
            np.cumsum(counts[m] * PULLS - oracle.shape_counts(expected, rows[m]) * PULLS)
        )
        assert difference.max() <= near + 1e-3, name


def test_a_bin_includes_its_upper_threshold():
    members = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])  # distances 1 and sqrt(2)
    bins = ShapeBins({"c1": np.tile([0.5, 1, 1.2, 1.3, 1.4, 1.5, 2, 2.5, 3], (5, 1))})
    counts, values, _ = counts_and_values(members, bins)
    assert counts[2, 1] == f32(np.mean(values[2] == 1)) > 0.5 and counts[2, 0] == 0
    assert counts[2, 5] == pytest.approx(1 - counts[2, 1], abs=1e-6)


# ---- thresholds --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(8)
    xyz = np.round(rng.uniform(0, 1, (4000, 3)) * (30, 30, 2), 3)
    plan = FeaturePlan.parse("c1,c3,s2,k20,kopt", "shapes")
    engine = FeatureEngine(xyz, plan, seed=2).fit()
    return xyz, engine


def test_bins_fill_evenly_on_the_sample_neighborhoods(fitted):
    xyz, engine = fitted
    hashes = point_seeds(*xyz.T, 2, "samples")
    sample = np.argsort(hashes)[:500]
    table = engine.table(sample)
    shares = table.values.astype(float).mean(axis=0).reshape(5, 5, 10)  # neighborhood, metric, bin
    assert shares[1:] == pytest.approx(0.1, abs=1e-3)
    # c1 holds three or four points: where members run out volumes and areas of 0 make a full first bin.
    assert shares[0, :3] == pytest.approx(0.1, abs=0.03)
    assert shares.sum(axis=2) == pytest.approx(1, abs=1e-6)


def test_values_that_repeat_leave_bins_empty_and_nothing_else():
    values = np.zeros((10, 5, 255), f32)
    values[:5] = np.linspace(1, 2, 5 * 5 * 255).reshape(5, 5, 255)
    values[:, 0] = -1  # angles of 0
    bins = ShapeBins.fit({"c1": values})
    for m, rows in enumerate(bins.thresholds("c1")):
        assert (rows[:5] == 0).all()
        assert (np.diff(rows[4:]) > 0).all() or m == 0
    empty = ShapeBins.fit({"c1": np.full((3, 5, 255), np.nan, f32)})
    assert (empty.thresholds("c1") == 0).all()


def test_thresholds_survive_json(fitted):
    bins = fitted[1].bins
    again = ShapeBins.from_dict(json.loads(json.dumps(bins.to_dict())))
    assert again == bins and list(bins.to_dict()) == ["c1", "c3", "s2", "k20", "kopt"]
    assert bins != ShapeBins({}) and bins != 3
    a3 = bins.thresholds("c3")[0]
    assert 0 <= a3[0] < a3[-1] <= math.pi


GOOD = {name: list(np.linspace(0.1, 3.0, 9)) for name in METRIC_NAMES}


@pytest.mark.parametrize(
    "bad",
    [
        [1, 2],
        {"c1": [1, 2]},
        {"c1": {k: v for k, v in GOOD.items() if k != "D1"}},
        {"c1": {**GOOD, "D1": "abcdefghi"}},
        {"c1": {**GOOD, "D1": [float("nan")] * 9}},
        {"c1": {**GOOD, "D2": GOOD["D2"][::-1]}},
        {"c1": {**GOOD, "A3": [*GOOD["A3"][:8], 3.2]}},
    ],
)
def test_bad_thresholds_are_refused(bad):
    with pytest.raises(OptionError):
        ShapeBins.from_dict(bad)


def test_missing_thresholds_are_named():
    bins = ShapeBins.from_dict({"c1": GOOD})
    with pytest.raises(OptionError, match=r"'c2'.*found c1"):
        bins.comparable("c2")
    xyz = np.zeros((3, 3))
    with pytest.raises(OptionError, match="'s1'"):
        compute_features(xyz, neighborhoods="s1", feature_set="A3", bins=bins, threads=1)
