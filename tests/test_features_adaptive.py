"""k nearest, kopt, ropt and copt against the oracle: members exactly, choices up to real ties."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.features import compute_features
from pdal_stages.features.engine import FeatureEngine
from pdal_stages.features.moments import M
from pdal_stages.features.plan import FeaturePlan
from pdal_stages.features.searches import curvature_threshold, radii_of

CHECKED = [*oracle.COVARIANCE, *oracle.GEOMETRIC]


def scattered(n, seed, size=(12.0, 12.0, 3.0), origin=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (n, 3)) * size + origin


def town(n=3000, seed=3, origin=(0.0, 0.0, 0.0)):
    """Ground, a roof, a wall and a tree, in millimeters."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(0, 1, (n, 3)) * (20, 20, 0.05)
    roof = (abs(xyz[:, 0] - 5) < 3) & (abs(xyz[:, 1] - 6) < 4)
    xyz[roof, 2] += 7 - 0.6 * abs(xyz[roof, 0] - 5)
    wall = (abs(xyz[:, 0] - 12) < 0.6) & (xyz[:, 1] < 12)
    xyz[wall, 0], xyz[wall, 2] = 12.0, rng.uniform(0, 9, wall.sum())
    tree = np.hypot(xyz[:, 0] - 16, xyz[:, 1] - 15) < 3
    xyz[tree, 2] = rng.uniform(2, 9, tree.sum())
    return np.round(xyz, 3) + origin


def cospherical(n=400):
    """A point, and many at exactly the same squared distance from it (permutations and signs of 3, 4, 12)."""
    rng = np.random.default_rng(0)
    base = np.array([rng.permutation([3.0, 4.0, 12.0]) for _ in range(n)]) * rng.choice(
        [-1.0, 1.0], (n, 3)
    )
    return np.vstack([[0.0, 0.0, 0.0], base])


LATTICE = np.array([(x, y, z) for x in range(9) for y in range(9) for z in range(4)], float)
CLOUDS = {
    "scattered": scattered(1500, 1),
    "town": town(),
    "utm": town(1500, 4, (500_000.0, 6_000_000.0, 120.0)),
    "negative": -town(1200, 5),
    "lattice": LATTICE,
    "plane": np.c_[LATTICE[:, :2], np.zeros(len(LATTICE))] * 0.5,
    "line": np.outer(np.arange(300), [0.1, 0.2, 0.05]),
    "one column": np.c_[np.full((800, 2), 3.25), np.random.default_rng(2).uniform(0, 30, 800)],
    "copies": np.vstack([np.tile([5.0, 5.0, 1.0], (700, 1)), scattered(300, 6)]),
    "all copies": np.tile([1.0, 2.0, 3.0], (500, 1)),
    "stray": np.vstack([scattered(500, 7), [1e9, 0.0, 0.0], [-1e9, 1e9, 0.0]]),
    "two clusters": np.vstack([scattered(300, 8, (1e-3, 1e-3, 1e-3)), scattered(90, 9) + 1e4]),
    "cospherical": cospherical(),
    "one": np.array([[1.0, 2.0, 3.0]]),
    "two": np.array([[1.0, 2.0, 3.0], [1.5, 2.0, 3.0]]),
    "five": scattered(5, 10),
    "thirty": scattered(30, 11),
}


def some(xyz, most=60):
    return xyz[np.unique(np.linspace(0, len(xyz) - 1, most).astype(int))]


def columns(points):
    return tuple(np.ascontiguousarray(points[:, i]) for i in range(3))


def choose(xyz, queries, token, cap=math.inf):
    """Moments and radii of a neighborhood of queries: (ROWS, m)."""
    adaptive = FeatureEngine(xyz, FeaturePlan.parse(token, "Density")).neighborhoods()[1]
    (search,) = adaptive.searches
    if cap < math.inf:
        search = search._replace(cap2=cap * cap)
    return adaptive.choose(search, columns(queries))[0]


def check_nearest(xyz, queries, need, cap=math.inf):
    """Number, distance, sums and last square tell the members, all within `cap`."""
    table = choose(xyz, queries, f"k{need - 1}", cap=cap)
    for i, q in enumerate(queries):
        points, distance = oracle.by_distance(xyz, q)
        n = min(need, int(np.count_nonzero(oracle.squared_distance(points, q) <= cap * cap)))
        offsets = points[:n] - q
        sums = np.zeros(3)
        for row in offsets:
            sums += row  # one after the other, as they come
        assert (table[M.N, i], table[M.RADIUS, i]) == (n, distance[n - 1] if n else 0.0), (
            f"query {i}"
        )
        assert np.array_equal(table[M.SX : M.SZ + 1, i], sums)


# ---- the nearest -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cloud", CLOUDS)
def test_nearest_are_those_of_brute_force(cloud):
    for need, cap in ((2, math.inf), (17, math.inf), (101, math.inf), (51, 2.0)):
        check_nearest(CLOUDS[cloud], some(CLOUDS[cloud], 30), need, cap)


def test_queries_that_are_no_points_of_the_cloud():
    rng = np.random.default_rng(3)
    queries = np.vstack([rng.uniform(-5, 25, (40, 3)), [[1e6, 1e6, 1e6]], [[5.0, 5.0, 1.0]] * 9])
    check_nearest(CLOUDS["town"], queries, 33)
    far = np.vstack(
        [CLOUDS["thirty"] + offset for offset in ([0, 0, 0], [5e5, 0, 0], [0, 3e6, 50])]
    )
    check_nearest(far, far[::7], 17)
    check_nearest(CLOUDS["town"], queries, 33, cap=1.0)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=60),
    st.integers(2, 20),
    st.sampled_from([1.0, 0.1, 1e5]),
)
def test_nearest_with_many_ties(points, need, scale):
    xyz = np.array(points, float) * scale
    check_nearest(xyz, xyz[:10], need)


@pytest.mark.timeout(60)
def test_copies_a_dense_facade_and_a_dense_ball_are_not_quadratic():
    rng = np.random.default_rng(14)
    facade = np.c_[np.full(30_000, 3.0), rng.uniform(0, 0.5, 30_000), rng.uniform(0, 30, 30_000)]
    ball = rng.normal(50, 1e-4, (30_000, 3))
    xyz = np.vstack([facade, ball, np.tile([100.0, 200.0, 5.0], (200_000, 1))])
    radius = choose(xyz, xyz[:60_001], "k20")[M.RADIUS]
    assert radius[-1] == 0
    for i in range(0, 60_000, 7001):
        assert radius[i] == pytest.approx(oracle.by_distance(xyz, xyz[i])[1][20], rel=1e-12)


# ---- kopt and k --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cloud", CLOUDS)
def test_kopt_is_the_oracle_s(cloud):
    xyz = CLOUDS[cloud]
    queries = some(xyz, 50)
    table = choose(xyz, queries, "kopt")
    for i, q in enumerate(queries):
        members, r, entropies = oracle.kopt(xyz, q)
        n = int(table[M.N, i])
        least = min(11, len(xyz))
        got = entropies[n - least]
        if math.isinf(got):  # no candidate at all: the largest is taken
            assert n == len(members)
        # The same, unless the two differ by rounding only.
        assert n == len(members) or abs(got - entropies[len(members) - least]) < 2e-9, f"query {i}"
        if n == len(members):
            assert table[M.RADIUS, i] == r


def test_other_ranges_and_a_cap():
    xyz = CLOUDS["town"]
    queries = some(xyz, 30)
    for k_min, k_max, cap in ((2, 2, math.inf), (2, 30, math.inf), (10, 50, 1.0)):
        table = choose(xyz, queries, f"kopt({k_min},{k_max})", cap=cap)
        for i, q in enumerate(queries):
            members, r, _ = oracle.kopt(xyz, q, k_min, k_max, cap)
            assert (table[M.N, i], table[M.RADIUS, i]) == (len(members), r)


def test_features_of_kopt_and_k():
    for xyz in (CLOUDS["town"][::2], CLOUDS["utm"]):
        at = np.arange(0, len(xyz), 60)
        got = compute_features(xyz, at, "kopt,k50", ["covariance", *oracle.GEOMETRIC, "Radius"])
        for i, q in enumerate(xyz[at]):
            for token, (members, r) in (
                ("kopt", oracle.kopt(xyz, q)[:2]),
                ("k50", oracle.nearest(xyz, q, 50)),
            ):
                expected = oracle.features(members, oracle.ball_volume(r), q)
                for name in CHECKED:
                    if name == "Verticality" and oracle.normal_gap(members) < 1e-7:
                        continue
                    value = float(got[f"{name}_{token}"][i])
                    assert value == pytest.approx(expected[name], rel=1e-5, abs=1e-7), (
                        token,
                        name,
                        i,
                    )
            assert got["Radius_kopt"][i] == np.float32(oracle.kopt(xyz, q)[1])


@pytest.mark.parametrize("cloud", CLOUDS)
def test_features_are_finite_and_those_of_each_neighborhood_alone(cloud):
    xyz = CLOUDS[cloud][:800]
    tokens = ["k3", "k20", "kopt", "ropt", "rdim", "copt"]
    together = compute_features(xyz, None, tokens, "all,HeightAboveLowest")
    assert np.isfinite(together.values).all() and (together["Density_kopt"] > 0).all()
    for token in tokens:
        alone = compute_features(
            xyz,
            None,
            token,
            "all,HeightAboveLowest",
            bins=together.bins,
            copt_threshold=together.copt_threshold,
        )
        columns = [together.names.index(name) for name in alone.names]
        assert np.array_equal(together.values[:, columns], alone.values)
    if cloud == "all copies":
        assert (
            together["SurfaceVariation_kopt"][0] == np.float32(1 / 3)
            and together["Linearity_kopt"][0] == 0
        )
        assert together["Density_kopt"][0] == pytest.approx(101 / oracle.ball_volume(0.001))


# ---- ropt --------------------------------------------------------------------------------------------------


def oracle_ropt(xyz, q, radii):
    spheres = [oracle.sphere(xyz, q, r) for r in radii]
    entropies = [oracle.entropy(members) if len(members) >= 10 else np.inf for members in spheres]
    return radii[oracle._first_lowest(entropies)], entropies


@pytest.mark.parametrize("cloud", CLOUDS)
def test_ropt_is_the_oracle_s(cloud):
    xyz = CLOUDS[cloud]
    queries = some(xyz, 25)
    default, single = radii_of(0.25, 2.0, 0.05), np.array([1.5])
    for token, radii in (("ropt", default), ("ropt(1.5,1.5,1)", single)):
        table = choose(xyz, queries, token)
        for i, q in enumerate(queries):
            r, entropies = oracle_ropt(xyz, q, radii)
            assert table[M.N, i] == len(oracle.sphere(xyz, q, table[M.RADIUS, i]))
            inside = entropies[list(radii).index(table[M.RADIUS, i])]
            assert table[M.RADIUS, i] == r or abs(inside - min(entropies)) < 2e-9, f"query {i}"


def dimensionality(members):
    """Demantke et al. 2011: the entropy of (s1 - s2, s2 - s3, s3) / s1."""
    values = np.linalg.eigvalsh(np.cov(members.T, bias=True))[::-1]
    s1, s2, s3 = np.sqrt(np.maximum(values, 0))
    shares = np.array([s1 - s2, s2 - s3, s3]) / s1
    return -sum(share * np.log(share) for share in shares if share > 0)


def test_rdim_has_the_lowest_entropy_of_dimensionality():
    radii = radii_of(0.25, 2.0, 0.05)
    other = 0
    for xyz in CLOUDS.values():
        queries = some(xyz, 25)
        table, by_eigenentropy = choose(xyz, queries, "rdim"), choose(xyz, queries, "ropt")
        other += np.count_nonzero(table[M.RADIUS] != by_eigenentropy[M.RADIUS])
        for i, q in enumerate(queries):
            spheres = [oracle.sphere(xyz, q, radius) for radius in radii]
            entropies = [
                dimensionality(entry)
                if len(entry) >= 10 and np.ptp(entry, axis=0).max() > 0
                else np.inf
                for entry in spheres
            ]
            chosen = list(radii).index(table[M.RADIUS, i])
            if np.isinf(entropies).all():
                assert chosen == len(radii) - 1
            else:
                assert entropies[chosen] < min(entropies) + 1e-6, f"query {i}"
    assert other > 20  # it is another neighborhood


# ---- copt --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cloud", CLOUDS)
def test_curvature(cloud):
    xyz = CLOUDS[cloud]
    at = np.unique(np.linspace(0, len(xyz) - 1, 20).astype(int))
    got = FeatureEngine(xyz, FeaturePlan.parse("copt", "Density")).curvatures()[at]
    wanted = [oracle.curvature(xyz, q) for q in xyz[at]]
    assert got == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_curvature_threshold_is_the_oracle_s():
    values = np.random.default_rng(0).beta(0.5, 4, 300) / 3
    assert curvature_threshold(values) == pytest.approx(oracle.copt_threshold(values), rel=1e-9)


def test_curvature_threshold_of_two_clear_groups():
    values = np.r_[np.full(30, 0.01), np.full(10, 0.25)]
    assert curvature_threshold(values) == pytest.approx(0.01 + 0.24 * 10 / 40)
    assert curvature_threshold(np.full(5, 0.125)) == 0.125
    for bad in ([], [0.1, np.nan], [np.inf]):
        with pytest.raises(ValueError):
            curvature_threshold(np.array(bad))


def test_copt_is_the_oracle_s():
    xyz = town(1200)
    engine = FeatureEngine(
        xyz, FeaturePlan.parse("copt", ["Density", "Radius", "Eigenentropy"])
    ).fit()
    curvatures = np.array([oracle.curvature(xyz, q) for q in xyz])
    threshold = engine.copt_threshold
    assert threshold == pytest.approx(oracle.copt_threshold(curvatures), rel=1e-9)
    at = np.arange(0, len(xyz), 40)
    got = engine.table(at)
    kinds = set()
    for i, q in zip(range(len(at)), xyz[at], strict=True):
        if curvatures[at[i]] >= threshold:
            members, r, _ = oracle.kopt(xyz, q, 10, 50, cap=3.0)
        else:
            r = oracle_ropt(xyz, q, radii_of(0.5, 2.0, 0.05))[0]
            members = oracle.sphere(xyz, q, r)
        kinds.add(curvatures[at[i]] >= threshold)
        assert got["Radius_copt"][i] == np.float32(r)
        assert got["Density_copt"][i] == pytest.approx(
            len(members) / oracle.ball_volume(r), rel=1e-6
        )
    assert kinds == {True, False}


# ---- what is reported, and real clouds -----------------------------------------------------------------------


def test_a_different_seed_changes_shapes_only():
    xyz = CLOUDS["utm"][:400]
    single = compute_features(xyz, None, "k7,kopt", "all", seed=4)
    other = compute_features(xyz, None, "k7,kopt", "all", seed=5, bins=single.bins)
    shape = np.array([name[:2] in oracle.METRICS for name in single.names])
    same = (single.values == other.values).all(axis=0)
    assert same[~shape].all() and not same[shape].all()


@pytest.mark.data
@pytest.mark.parametrize("file", ["delft/train", "oakland/train"])
def test_real_clouds(data_dir, file):
    import laspy

    result = data_dir / file if (data_dir / file).is_dir() else (data_dir / file).parent
    path = min(p for p in sorted(result.rglob("*.la[sz]")) if file.split("/")[-1] in str(p))
    with laspy.open(path) as reader:
        cloud = reader.read()
    xyz = np.c_[cloud.x, cloud.y, cloud.z]
    xyz = xyz[np.lexsort((xyz[:, 0], np.floor(xyz[:, 1] / 20)))][:20_000]
    queries = some(xyz, 20)
    check_nearest(xyz, queries, 101)
    table = choose(xyz, queries, "kopt")
    for i, q in enumerate(queries):
        points, distance = oracle.by_distance(xyz, q)
        members, _, entropies = oracle.kopt(points[:101], q)
        n = int(table[M.N, i])
        assert n == len(members) or abs(entropies[n - 11] - entropies[len(members) - 11]) < 2e-9
        assert table[M.RADIUS, i] == distance[n - 1]
