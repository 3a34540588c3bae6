"""Every registered feature, in every kind of neighborhood that has it, against its slow reference."""

import math

import numpy as np
import oracle
import pytest

from pdal_stages.features import FeatureEngine, FeaturePlan
from pdal_stages.features.neighborhoods import ADAPTIVE, parse_neighborhoods
from pdal_stages.features.registry import FEATURES, SHAPES
from pdal_stages.features.shape_distributions import METRIC_NAMES

#: One neighborhood of each kind; the adaptive ones follow from the fixed ones that they choose.
TOKENS = ("c1.5", "s1.5", "k8", "kopt(4,12)", "ropt(0.5,1.5,0.25)", "rdim(0.5,1.5,0.25)", "copt")
QUERIES = np.arange(0, 400, 20)


@pytest.fixture(scope="module")
def engine():
    """A thick sheet, dense enough for shapes in every neighborhood."""
    rng = np.random.default_rng(8)
    xyz = np.column_stack([rng.uniform(0, 8, (400, 2)), rng.normal(0, 0.4, 400)])
    relative = [f.name for f in FEATURES if f.group == "relative"]  # no word of a feature set
    groups = [*{f.group for f in FEATURES} - {"relative"}, *relative]
    return FeatureEngine(xyz, FeaturePlan.parse(TOKENS, groups), threads=1).fit()


@pytest.fixture(scope="module")
def table(engine):
    return engine.table(QUERIES)


@pytest.fixture(scope="module")
def pulls(engine):
    """The metrics (queries, metrics, pulls) of all pulls, by token, comparable."""
    return engine.shape_values(QUERIES, engine.copt_threshold)


def members_of(token: str, xyz, q, table, row: int):
    """Return the members, and what Density divides by."""
    kind, suffix = token[0], parse_neighborhoods(token)[0].suffix
    if token in ("c1.5", "s1.5"):
        members = (oracle.cylinder if kind == "c" else oracle.sphere)(xyz, q, 1.5)
        return members, math.pi * 1.5**2 if kind == "c" else oracle.ball_volume(1.5)
    if token == "k8":
        members, radius = oracle.nearest(xyz, q, 8)
        return members, oracle.ball_volume(radius)
    # which radius is chosen is compared in test_features_adaptive.py; here what is made of it
    radius = float(table[f"Radius_{suffix}"][row])
    return oracle.sphere(xyz, q, radius * (1 + 1e-7)), oracle.ball_volume(radius)


def reference(feature, token: str, engine, pulls, table, row: int) -> float:
    """Return the value of a feature, straight from its definition; KeyError where it has none."""
    xyz, q = engine.cloud, engine.cloud[QUERIES[row]]
    metric, _, number = feature.name.partition("_")
    if metric in SHAPES:
        place = METRIC_NAMES.index(metric)
        bins = engine.bins.comparable(token)[place]
        return oracle.shape_counts(pulls[token][row, place], bins)[int(number)]
    if feature.name in oracle.SURFACES:
        return oracle.surfaces(xyz, q, 8)[0][feature.name]
    members, volume = members_of(token, xyz, q, table, row)
    if feature.name == "Radius":
        return float(np.sqrt(oracle.squared_distance(members, q).max()))
    return float(oracle.features(members, volume, q)[feature.name])


@pytest.mark.parametrize("feature", FEATURES, ids=lambda feature: feature.name)
def test_a_registered_feature_is_what_its_reference_says(feature, engine, pulls, table):
    for token in TOKENS:
        (neighborhood,) = parse_neighborhoods(token)
        if feature.kinds and neighborhood.kind not in feature.kinds:
            continue
        values = table[f"{feature.name}_{neighborhood.suffix}"]
        assert not np.isnan(values).any(), f"{feature.name}: no kernel writes it"
        rows = range(len(QUERIES))
        expected = np.array([reference(feature, token, engine, pulls, table, n) for n in rows])
        if feature.name == "Radius" and neighborhood.kind != "kopt":  # in steps of 0.25 m
            assert ((values - expected > -1e-6) & (values - expected < 0.25)).all(), token
        else:
            rel = 2e-3 if neighborhood.kind in ADAPTIVE else 2e-4
            assert values == pytest.approx(expected, rel=rel, abs=1e-5), token


#: Features that are not shares of eigenvalues, which alone are 0 of fewer than three points.
OF_FEW = {
    "SurfaceVariation", "Density", "HeightRange", "HeightStd", "HeightAboveLowest", "Radius",
    *oracle.SURFACES,
}  # fmt: skip


def test_of_fewer_than_three_points_eigen_features_are_zero():
    """One, two and three points within 1.5 m; those of the third have values."""
    xyz = np.array(
        [[0, 0, 0], [50, 0, 0], [50.5, 0, 0.2], [100, 0, 0], [101, 0, 0.3], [100, 1, 0.5]]
    )
    names = [f.name for f in FEATURES if f.group != "shapes" and f.name not in SHAPES]
    names = [name for name in names if name.partition("_")[0] not in SHAPES]
    zero = [name for name in names if name not in OF_FEW]
    engine = FeatureEngine(xyz, FeaturePlan.parse(("c1.5", "s1.5"), names), threads=1).fit()
    few, three = engine.table(np.array([0, 1, 2])), engine.table(np.array([3]))
    assert zero and "Linearity" in zero
    for name in zero:
        for suffix in ("c1_5", "s1_5"):
            assert not few[f"{name}_{suffix}"].any(), name
    assert any(three[f"{name}_s1_5"].any() for name in zero)
