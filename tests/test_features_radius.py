"""Cylinders and spheres against the oracle: members exactly, features to 1e-5."""

import math

import numpy as np
import oracle
import pytest

from pdal_stages.features import compute_features
from pdal_stages.features.neighborhoods import parse_neighborhoods

CHECKED = [*oracle.COVARIANCE, *oracle.GEOMETRIC]
RTOL = 1e-5
#: Where a true value is 0 (a perfect plane), rounding leaves e3 of 1e-15, whose cube root is 1e-5.
ATOL = {"Omnivariance": 3e-5}


def check(xyz, queries, radii=(1.0, 2.5), atol=1e-9):
    """Compare with the oracle at the points `queries`."""
    radii = [round(radius, 6) for radius in radii]
    names = [f"{kind}{radius}" for kind in "cs" for radius in radii]
    results = compute_features(xyz, queries, names, ["covariance", *oracle.GEOMETRIC], threads=1)
    for kind in "cs":
        for radius in radii:
            (suffix,) = (n.suffix for n in parse_neighborhoods(f"{kind}{radius}"))
            volume = math.pi * radius**2 if kind == "c" else oracle.ball_volume(radius)
            for i, q in enumerate(xyz[queries]):
                members = (
                    oracle.cylinder(xyz, q, radius)
                    if kind == "c"
                    else oracle.sphere(xyz, q, radius)
                )
                expected = oracle.features(members, volume, q)
                where = f"{suffix}, query {i}, {len(members)} members"
                assert round(float(results[f"Density_{suffix}"][i]) * volume) == len(members), where
                for name in CHECKED:
                    got = float(results[f"{name}_{suffix}"][i])
                    if name == "Verticality" and (
                        len(members) < 3 or oracle.normal_gap(members) < 1e-7
                    ):
                        assert 0.0 <= got <= 1.0, where  # no normal to speak of
                        continue
                    assert got == pytest.approx(
                        expected[name], rel=RTOL, abs=ATOL.get(name, atol)
                    ), (
                        name,
                        where,
                    )


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(5)


def test_random_cloud(random_cloud):
    xyz = random_cloud(2500, seed=1)
    check(xyz, np.arange(0, 2500, 40), radii=(0.5, 1.0, 2.5, 5.0))


def test_utm_coordinates_with_millimeters(random_cloud, rng):
    xyz = random_cloud(1500, seed=2, extent=(15, 15, 0.02), origin=(500_000, 6_000_000, 4000))
    check(xyz, np.arange(0, 1500, 50), radii=(0.7, 3.0), atol=1e-8)


def test_negative_coordinates_and_cell_borders(rng):
    # Integer and half coordinates: distances of exactly a radius, points on borders of cells.
    grid = np.array(
        [(x, y, z) for x in range(-7, 7) for y in range(-7, 7) for z in (0, 0.5, 1)], float
    )
    check(grid, np.arange(0, len(grid), 23), radii=(1.0, 2.0, 5.0))


def test_members_at_exactly_the_radius():
    xyz = np.array(
        [
            [0, 0, 0],
            [3, 4, 0],
            [5, 0, 0],
            [-5, 0, 0],
            [0, -5, 0],
            [0, 0, 5],
            [3, 4, 1e-7],
            [5.0000001, 0, 0],
        ]
    )
    table = compute_features(xyz, [0], "c5,s5", "Density")
    assert round(table["Density_c5"][0] * math.pi * 25) == 7
    assert round(table["Density_s5"][0] * oracle.ball_volume(5)) == 6


@pytest.mark.parametrize("radius", [0.05, 0.5, 0.75, 4.0, 20.0, 60.0])
def test_every_cell_size(rng, radius):
    side = radius * 5
    xyz = rng.uniform(-side / 2, side / 2, (1500, 3)) * [1, 1, 0.3]
    check(xyz, np.arange(0, 1500, 150), radii=(radius, radius / 3))


@pytest.mark.parametrize(
    "name, make",
    [
        ("plane", lambda r: np.column_stack([r.uniform(0, 9, (900, 2)), np.zeros(900)])),
        (
            "slope",
            lambda r: (lambda p: np.column_stack([p, p @ [0.3, -0.7]]))(r.uniform(0, 9, (900, 2))),
        ),
        (
            "wall",
            lambda r: np.column_stack(
                [r.uniform(0, 9, 900), np.full(900, 2.0), r.uniform(0, 9, 900)]
            ),
        ),
        ("line", lambda r: r.uniform(0, 20, (300, 1)) * [1.0, 0.5, 0.25]),
        ("pole", lambda r: r.uniform(0, 20, (300, 1)) * [0.0, 0.0, 1.0]),
        (
            "thin line",
            lambda r: r.uniform(0, 20, (400, 1)) * [1.0, 0.5, 0.25] + r.normal(0, 1e-4, (400, 3)),
        ),
        ("duplicates", lambda r: np.repeat(r.uniform(0, 5, (60, 3)), 7, axis=0)),
        ("one place", lambda r: np.tile(r.uniform(0, 5, (1, 3)), (40, 1))),
        ("two places", lambda r: np.tile(r.uniform(0, 1, (2, 3)), (20, 1))),
        (
            "cube corners",
            lambda r: np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float),
        ),
        ("sparse", lambda r: r.uniform(0, 300, (200, 3))),
        ("dense", lambda r: r.normal(0, 0.2, (3000, 3))),
        (
            "stray",
            lambda r: np.vstack([r.uniform(0, 9, (400, 3)), [[1e9, -1e9, 1e4], [4.0, 4.0, 1e6]]]),
        ),
    ],
)
def test_degenerate_clouds(rng, name, make):
    xyz = make(rng)
    queries = np.unique(np.linspace(0, len(xyz) - 1, 25).astype(int))
    check(xyz, queries, radii=(1.0, 3.0), atol=1e-8 if name != "stray" else 1e-6)
    values = compute_features(xyz, None, "c1,s3", ["covariance", *oracle.GEOMETRIC]).values
    assert np.isfinite(values).all()


def test_points_of_one_place_coincide_wherever_it_is(rng):
    """Far from 0 too, what rounding leaves is no variance."""
    places = rng.uniform(0, 2000, (300, 3)) + np.array([500_000, 5_400_000, 100])
    table = compute_features(
        np.tile(places, (40, 1)), np.arange(300), "c1,c3,s3", ["covariance", *oracle.GEOMETRIC]
    )
    alone = np.array([np.sum(np.hypot(*(places - p)[:, :2].T) <= 3) == 1 for p in places])
    assert alone.sum() > 200
    for name in table.names:
        if not name.startswith("Density"):
            wanted = np.float32(1 / 3) if name.startswith("SurfaceVariation") else 0
            assert (table[name][alone] == wanted).all(), name


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_points(count, rng):
    check(rng.uniform(0, 1, (count, 3)), np.arange(count), radii=(0.5, 3.0))


def test_no_points():
    table = compute_features(np.zeros((0, 3)), None, "c1,s1", "covariance")
    assert table.values.shape == (0, 16)


def test_horizontal_line_is_not_vertical_and_a_pole_is():
    line = np.column_stack([np.arange(9.0), np.arange(9.0) * 0.5, np.zeros(9)])
    pole = np.column_stack([np.zeros(9), np.zeros(9), np.arange(9.0)])
    assert compute_features(line, [4], "s3", "Verticality").values[0, 0] == pytest.approx(
        0.0, abs=1e-6
    )
    assert compute_features(pole, [4], "s3", "Verticality").values[0, 0] == pytest.approx(
        1.0, abs=1e-6
    )


def test_large_spheres_in_a_dense_cloud(rng):
    """10 m round points of a cloud of 100 a square meter: 30,000 members each."""
    xyz = rng.uniform(0, 30, (90_000, 3)) * [1, 1, 0.05]
    near = np.argsort(((xyz[:, :2] - 15) ** 2).sum(axis=1))[:4]
    check(xyz, near, radii=(10.0,))


@pytest.mark.data
@pytest.mark.parametrize("file", ["delft/train.laz", "isprs_filter/samp11.laz"])
def test_real_tiles(data_dir, file):
    laspy = pytest.importorskip("laspy")
    xyz = np.ascontiguousarray(laspy.read(data_dir / file).xyz)
    near = xyz[np.abs(xyz - np.median(xyz, axis=0))[:, :2].max(axis=1) < 10]
    assert len(near) > 50
    check(near, np.arange(0, len(near), max(len(near) // 40, 1)), radii=(1.0, 3.0), atol=1e-7)


def test_against_pgeof():
    """An independent library; it takes square roots of eigenvalues and adds 1e-3 to what it divides by."""
    pgeof = pytest.importorskip("pgeof")
    cloud = np.random.default_rng(8).random((4000, 3)) * [12, 12, 3]
    ids = pgeof.EFeatureID
    wanted = [ids.Verticality, ids.Linearity, ids.Scattering]
    vertical, linear, scatter = pgeof.compute_features_selected(cloud, 1.2, 4000, wanted).T
    ours = compute_features(cloud, None, "s1.2", ["covariance", "geometric"])
    np.testing.assert_allclose(ours["Verticality_s1_2"], vertical, atol=1e-6)
    np.testing.assert_allclose(1 - np.sqrt(1 - ours["Linearity_s1_2"]), linear, atol=3e-3)
    np.testing.assert_allclose(np.sqrt(ours["Scattering_s1_2"]), scatter, atol=3e-3)
