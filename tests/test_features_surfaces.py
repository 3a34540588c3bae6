"""Neighbors' surfaces against the oracle; the same bits in any order, block and tile; two steps of reach."""

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_features_adaptive import CLOUDS, town

from pdal_stages import TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.base.errors import OptionError
from pdal_stages.features import FeatureEngine, FeaturePlan, compute_features
from pdal_stages.features.moments import eigen3
from pdal_stages.features.registry import SURFACE_FEATURES

TOKENS = "k3,k20"


@pytest.mark.parametrize("cloud", CLOUDS)
def test_surfaces_are_the_oracle_s(cloud):
    xyz = CLOUDS[cloud]
    rows = np.unique(np.linspace(0, len(xyz) - 1, 15).astype(int))
    queries = xyz[rows]
    got = compute_features(xyz, rows, TOKENS, "surfaces")
    assert np.isfinite(got.values).all()
    for i, q in enumerate(queries):
        for k in (3, 20):
            expected, gap = oracle.surfaces(xyz, q, k)
            for name, value in expected.items():
                if name == "NormalAgreement" and gap < 1e-5:
                    continue  # some normal is any perpendicular of a line, or anything at all
                assert got[f"{name}_k{k}"][i] == pytest.approx(value, rel=1e-4, abs=2e-5), (
                    name,
                    k,
                    i,
                )


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=40),
    st.integers(1, 25),
    st.sampled_from([1.0, 0.1, 1e4]),
)
def test_variations_with_many_ties(points, k, scale):
    xyz = np.array(points, float) * scale
    got = compute_features(xyz, None, f"k{k}", "surfaces", threads=1)
    for i, q in enumerate(xyz[:8]):
        expected, gap = oracle.surfaces(xyz, q, k)
        assert got.values[i, 1:] == pytest.approx(list(expected.values())[1:], rel=1e-4, abs=2e-5)
        if gap > 1e-3:
            assert got.values[i, 0] == pytest.approx(
                expected["NormalAgreement"], rel=1e-4, abs=2e-5
            )


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 10_000),
    st.sampled_from([(0, 1, 2), (1, 0, 2), (2, 0, 1)]),
    st.integers(-4000, 4000),
)
def test_rigid_motions(seed, axes, shift):
    """Surfaces know neither north nor up."""
    rng = np.random.default_rng(seed)
    xyz = np.round(rng.uniform(0, 6, (int(rng.integers(12, 80)), 3)) * 1024) / 1024
    single = compute_features(xyz, None, "k4,k12", "surfaces", threads=1).values
    other = compute_features(
        xyz[:, axes] * [1, -1, 1] + shift, None, "k4,k12", "surfaces", threads=1
    ).values
    np.testing.assert_allclose(single, other, rtol=1e-4, atol=3e-4)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_the_normal_is_the_eigenvector(values):
    a = np.array(values).reshape(3, 3)
    c = a @ a.T
    l1, l2, l3, *normal = eigen3(c[0, 0], c[0, 1], c[0, 2], c[1, 1], c[1, 2], c[2, 2])
    expected = np.linalg.eigvalsh(c)[::-1]
    assert np.allclose((l1, l2, l3), np.maximum(expected, 0), atol=1e-13)
    if l2 > 1e-9 and l2 - l3 > 1e-6 * l1:
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-12)
        assert np.allclose(c @ normal, l3 * np.array(normal), atol=1e-10)


# ---- the same bits -----------------------------------------------------------------------------------------


def test_any_order_threads_blocks_and_queries():
    xyz = np.vstack([town(6000), town(6000)[:50]])  # copies of points too
    whole = compute_features(xyz, None, TOKENS, "surfaces,Linearity", threads=1)
    order = np.random.default_rng(0).permutation(len(xyz))
    other = compute_features(
        xyz[order], None, TOKENS, "surfaces,Linearity", threads=3, memory_mb=16
    )
    assert other.values.tobytes() == whole.values[order].tobytes()
    rows = order[:300]
    part = compute_features(xyz, rows, TOKENS, "surfaces,Linearity")
    assert np.array_equal(part.values, whole.values[rows])


def test_beside_other_features():
    xyz = town(1500)
    alone = compute_features(xyz, None, "k8", "surfaces")
    beside = compute_features(
        xyz, None, "c1,k3,k8,k30,kopt(5,20)", "all,HeightAboveLowest,surfaces"
    )
    plain = compute_features(xyz, None, "k8,k30", "covariance,geometric")
    for table in (alone, plain):
        for name in table.names:
            assert np.array_equal(beside[name], table[name])


def test_in_a_tile_as_in_the_whole():
    """Where no query's two steps lead out of the halo; and those that do are counted."""
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(0, 90, (8000, 2)), rng.normal(0, 0.5, 8000)])
    whole = FeatureEngine(xyz, FeaturePlan.parse("k20", "surfaces"))
    values, halo = whole.table().values, whole.plan.halo_m
    assert not whole.report.beyond_halo
    inside = ((xyz[:, :2] >= 40) & (xyz[:, :2] < 50)).all(axis=1)
    near = ((xyz[:, :2] >= 40 - halo) & (xyz[:, :2] < 50 + halo)).all(axis=1)
    assert 50 < inside.sum() < near.sum() < 0.5 * len(xyz)
    part = compute_features(xyz[near], np.flatnonzero(inside[near]), "k20", "surfaces")
    assert np.array_equal(part.values, values[inside])


def test_the_second_step_is_counted():
    """Three neighbors lie close by; the ten nearest of these do not."""
    rng = np.random.default_rng(2)
    clumps = [rng.uniform(0, 1, (5, 3)) + np.array([40.0 * i, 0, 0]) for i in range(6)]
    lone, plain = (
        compute_features(np.vstack(clumps), None, "k3", words)
        for words in ("surfaces", "Linearity")
    )
    assert lone.report.beyond_halo == {"k3": 30} and not plain.report.beyond_halo
    assert 30 < lone.report.reach < 90 and plain.report.reach < 2
    dense = compute_features(
        np.vstack([np.vstack([c, c + 0.3, c + 0.7]) for c in clumps]), None, "k3", "surfaces"
    )
    assert not dense.report.beyond_halo


# ---- plans -------------------------------------------------------------------------------------------------


def test_plans():
    plan = FeaturePlan.parse("s1,k10,k20,kopt", "Linearity,surfaces")
    assert [name for name in plan.names if "Linearity" not in name] == [
        f"{name}_{token}" for token in ("k10", "k20") for name in SURFACE_FEATURES
    ]
    assert FeaturePlan.parse("k10,k20", "surfacevariationstd_K20").names == (
        "SurfaceVariationStd_k20",
    )
    assert not {*SURFACE_FEATURES} & {name.split("_")[0] for name in FeaturePlan.parse("k10").names}
    assert FeaturePlan.from_dict(plan.to_dict()) == plan
    for spec in ("s1", "kopt", "ropt"):
        with pytest.raises(OptionError, match="knn only"):
            FeaturePlan.parse(spec, "NormalAgreement")
    with pytest.raises(OptionError, match="none of the neighborhoods"):
        FeaturePlan.parse("k10", "NormalAgreement_k20")


def test_the_halo_grows_where_neighbors_lie_far():
    assert FeaturePlan.parse("k20,k50", "Linearity,NormalAgreement_k20").halo_m == 16.0
    many = FeaturePlan.parse("k100", "NormalAgreement").halo_m
    assert many == pytest.approx(16.0 + 15.0 * 10**0.5 / 10)


def test_a_model_reads_them(tmp_path):
    xyz = town(3000)
    label = np.where(xyz[:, 2] > 1.5, 6, 2).astype(np.uint8)
    options = TrainingOptions(
        neighborhoods="k10,k20",
        feature_set="covariance,surfaces",
        dimensions=(),
        count=300,
        trees=4,
        folds=0,
        voxel=0.0,
    )
    model = train([TrainingCloud(xyz, label, {})], options)
    model.save(tmp_path / "m.model")
    again = load_model(tmp_path / "m.model")
    assert "SurfaceVariationStd_k20" in again.passes[0].plan.names
    prediction = again.predict(xyz, {})
    assert np.array_equal(
        prediction.classification, model.predict(xyz[::-1], {}).classification[::-1]
    )
    assert (prediction.classification == label).mean() > 0.9
