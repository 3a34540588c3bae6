"""The generated town: the same every time, dense as asked, true to its labels, readable by everybody."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import subprocess

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pdal_stages import synthetic
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.synthetic import Town, TownOptions, make_town, town_chunks, write_town
from pdal_stages.synthetic import raycast as rays
from pdal_stages.synthetic.flight import Chunk, Flight
from pdal_stages.synthetic.materials import REFLECTANCE
from pdal_stages.synthetic.plan import Plan, ground, to_uv, to_xy
from pdal_stages.synthetic.scene import CONE, CONVEX, ELLIPSOID, VEGETATION, Parts, build_scene
from pdal_stages.synthetic.town import _COLUMNS, _Survey


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(200, 3, seed=1, outliers=0.001, progress=False)


def digest(town: Town) -> str:
    h = hashlib.sha256()
    for name in _COLUMNS:
        h.update(np.ascontiguousarray(getattr(town, name)).tobytes())
    return h.hexdigest()


def assert_whole_pulses(town: Town) -> None:
    """Every pulse has returns 1..n, in order of range, each saying n; strip and angle are the pulse's."""
    starts = np.flatnonzero(np.r_[True, town.gps_time[1:] != town.gps_time[:-1]])
    counts = np.diff(np.r_[starts, len(town)])
    assert len(np.unique(town.gps_time)) == len(starts), (
        "a pulse's points lie together and no time comes twice"
    )
    position = np.arange(len(town)) - np.repeat(starts, counts)
    assert np.array_equal(town.return_number, position + 1)
    assert np.array_equal(town.number_of_returns, np.repeat(counts, counts))
    assert counts.max() <= 5
    for name in ("point_source_id", "scan_angle", "edge_of_flight_line"):
        column = getattr(town, name)
        assert np.array_equal(column, np.repeat(column[starts], counts)), name
    later = np.flatnonzero(town.return_number > 1)
    assert (town.z[later] < town.z[later - 1]).all()


# ---- the same every time -----------------------------------------------------------------------------------


def test_same_seed_same_points_whatever_the_threads():
    one = make_town(60, 3, seed=5, threads=1, progress=False)
    two = make_town(60, 3, seed=5, threads=3, progress=False)
    assert digest(one) == digest(two)
    assert digest(make_town(60, 3, seed=6, progress=False)) != digest(one)


def test_chunks_joined_are_the_town(monkeypatch):
    whole = make_town(80, 3, seed=2, progress=False)
    monkeypatch.setattr("pdal_stages.synthetic.town.PULSES_PER_CHUNK", 3000)
    pieces = list(town_chunks(size=80, density=3, seed=2, progress=False))
    assert len(pieces) > 5
    for name in _COLUMNS:
        assert np.array_equal(np.concatenate([getattr(p, name) for p in pieces]), getattr(whole, name)), name


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_same_bytes(tmp_path, suffix):
    options = TownOptions(size=50, density=2, seed=3)
    for name in ("a", "b"):
        write_town(options, tmp_path / f"{name}.{suffix}", threads=2 if name == "a" else 1)
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


# ---- density, extent, columns ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "density", "more"),
    [
        (200, 1.5, {}),
        (60, 20, {}),
        (150, 4, {"seed": 9, "altitude": 900, "overlap": 0.5}),
        (400, 0.6, {"scan_angle": 12, "overlap": 0.0}),
    ],
)
def test_density_is_met(size, density, more):
    t = make_town(size, density, progress=False, **more)
    assert len(t) / size**2 == pytest.approx(density, rel=0.06)


def test_extent_and_columns(town):
    o = town.options
    local = town.xyz - np.array(o.origin)
    assert (local[:, :2] >= 0).all() and (local[:, :2] < o.size).all()
    assert local[:, :2].min() < 1 and local[:, :2].max() > o.size - 1
    whole = town.xyz * 1000
    assert np.abs(whole - np.round(whole)).max() < 1e-3  # multiples of a millimetre, as far as float64 goes
    for name in _COLUMNS:
        assert len(getattr(town, name)) == len(town)
        assert np.isfinite(getattr(town, name)).all()
    assert np.abs(town.scan_angle).max() <= o.scan_angle
    assert set(np.unique(town.point_source_id)) == {1, 2}
    assert (np.diff(town.gps_time) >= 0).all()
    assert 0 < town.edge_of_flight_line.mean() < 0.02
    assert np.abs(town.scan_angle[town.edge_of_flight_line]).min() > 0.98 * o.scan_angle


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    size=st.floats(20, 70),
    density=st.floats(0.5, 5),
    seed=st.integers(0, 2**31 - 1),
    altitude=st.floats(150, 2000),
    scan_angle=st.floats(3, 35),
    overlap=st.floats(0, 0.8),
    outliers=st.sampled_from([0.0, 0.05]),
)
def test_any_options_give_whole_pulses(**options):
    t = make_town(progress=False, **options)
    assert_whole_pulses(t)
    assert np.isfinite(t.xyz).all() and np.abs(t.height_above_ground).max() < 120


# ---- returns -----------------------------------------------------------------------------------------------


def test_returns_are_consistent(town):
    assert_whole_pulses(town)
    share = np.bincount(town.number_of_returns) / len(town)
    assert 0.55 < share[1] < 0.9 and share[2] > 0.05 and share[3] > 0.02 and share[5] > 0.002


def test_canopy_lets_beams_through_to_the_ground(town):
    first = town.return_number == 1
    tree = np.flatnonzero(first & (town.classification == 5))
    last = tree + town.number_of_returns[tree] - 1
    reached = np.isin(town.classification[last], (2, 3)).mean()
    assert 0.15 < reached < 0.75


# ---- labels ------------------------------------------------------------------------------------------------


def test_ground_lies_on_the_true_ground(town):
    low = town.classification == 2
    error = town.z[low] - town.ground_height(town.x[low], town.y[low])
    assert np.allclose(error, town.height_above_ground[low], atol=2e-3)
    assert abs(np.median(error)) < 0.01
    assert np.percentile(np.abs(error), 95) < 0.06 and np.percentile(np.abs(error), 99.9) < 0.35


def test_labels_and_heights_agree(town):
    h, c = town.height_above_ground, town.classification
    assert (h[c == 3] < 0.5).all() and (h[c == 3] > -0.15).all()
    assert ((h[c == 4] >= 0.5) & (h[c == 4] < 2.0)).all()
    assert (h[c == 5] >= 2.0).all() and h[c == 5].max() < 32
    assert np.median(h[c == 6]) > 4 and 12 < h[c == 6].max() < 45
    assert h[c == 14].min() > 3
    assert 5 < h[c == 15].max() < 26
    assert np.abs(np.median(h[c == 9])) < 0.02
    assert h[c == 7].max() < -1 and h[c == 18].min() > 15
    assert set(np.unique(c)) == {1, 2, 3, 4, 5, 6, 7, 9, 14, 15, 17, 18}
    assert 18 not in make_town(40, 2, progress=False).classification


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_both_halves_hold_every_class(seed):
    """Training on one half and classifying the other is a fair task."""
    t = make_town(200, 2, seed=seed, progress=False)
    west = t.x < np.median(t.x)
    for code in (1, 2, 3, 4, 5, 6, 9, 14, 15, 17):
        for half in (west, ~west):
            assert (t.classification[half] == code).sum() >= 30, (seed, code)


def test_facades_roofs_and_water(town):
    """Walls are hit (many heights at one place), roofs more often, and water returns little."""
    building = town.subset(town.classification == 6)
    cell = np.floor(building.xyz[:, :2] / 0.8).astype(np.int64)
    _, which = np.unique(cell, axis=0, return_inverse=True)
    low, high = np.full(which.max() + 1, np.inf), np.full(which.max() + 1, -np.inf)
    np.minimum.at(low, which, building.z)
    np.maximum.at(high, which, building.z)
    assert ((high - low) > 3.0).mean() > 0.02
    survey = _Survey(town.options)
    xy = np.random.default_rng(0).uniform(0, 200, (4000, 2))
    surface = np.array([ground(x, y, survey.plan.ground)[1] for x, y in xy])
    area = (surface == 3).mean() * 200**2
    assert 0.05 < (town.classification == 9).sum() / area / 3.0 < 0.8


def test_intensity_tells_materials_apart(town):
    ground_points = town.classification == 2
    names = synthetic.materials.NAMES
    mean = {
        n: town.intensity[ground_points & (town.material == names.index(n))].mean()
        for n in ("asphalt", "lawn")
    }
    assert mean["lawn"] > 2 * mean["asphalt"] > 0


# ---- the ray caster against a slow, obvious one ------------------------------------------------------------


def _inside(scene, n, p):
    """Which of the places p (m, 3) lie inside thing n."""
    q, (first, count, kind) = scene.shape[n], scene.label[n, :3]
    if kind == CONVEX:
        planes = scene.planes[first : first + count]
        return (p @ planes[:, :3].T <= planes[:, 3]).all(axis=1)
    if kind == ELLIPSOID:
        return (((p - q[:3]) / q[3:6]) ** 2).sum(axis=1) <= 1
    if kind == CONE:
        down = q[2] - p[:, 2]
        across = np.hypot(p[:, 0] - q[0], p[:, 1] - q[1])
        return (p[:, 2] >= q[3]) & (down >= 0) & (across <= q[4] * down / (q[2] - q[3]))
    along = np.clip(((p - q[:3]) @ (q[3:6] - q[:3])) / ((q[3:6] - q[:3]) ** 2).sum(), 0, 1)
    return np.linalg.norm(p - q[:3] - along[:, None] * (q[3:6] - q[:3]), axis=1) <= q[6]


def test_first_hit_equals_marching_through_all_things():
    rng = np.random.default_rng(4)
    parts = Parts()
    for _ in range(25):
        x, y, z = rng.uniform(0, 30), rng.uniform(0, 30), rng.uniform(0, 10)
        parts.prism(
            x,
            y,
            rng.uniform(0, 6),
            rng.uniform(0.3, 4),
            rng.uniform(0.3, 2),
            z,
            z + rng.uniform(0.5, 6),
            6,
            "tile",
            cuts=[(0, 1.0, 1.0, z + 4)] if rng.random() < 0.5 else (),
        )
        parts.ellipsoid(*rng.uniform(0, 30, 2), rng.uniform(2, 12), *rng.uniform(0.5, 3, 3), 5, "leaf", 0.0)
        z0 = rng.uniform(0, 4)
        parts.cone(*rng.uniform(0, 30, 2), z0, z0 + rng.uniform(2, 9), rng.uniform(0.5, 3), 5, "needle", 0.0)
        parts.rod(tuple(rng.uniform(0, 15, 3)), tuple(rng.uniform(5, 20, 3)), 0.15, 14, "cable")
    scene = build_scene([parts.arrays(1)], -5.0, -5.0, 40.0, 40.0)
    met = 0
    for _ in range(90):
        target = np.array([*rng.uniform(0, 30, 2), 0.0])
        a, tilt = rng.uniform(0, 2 * math.pi), rng.uniform(0, math.tan(math.radians(35)))
        d = np.array([tilt * math.cos(a), tilt * math.sin(a), -1.0])
        d /= np.linalg.norm(d)
        o = target - d * 60.0
        t = np.arange(20.0, 60.0, 0.004)
        places = o + t[:, None] * d
        slow = min(
            (t[hit.argmax()] for n in range(len(scene.box)) if (hit := _inside(scene, n, places)).any()),
            default=60.0,
        )
        fast, index, _, _ = rays._first_thing(scene, *o, *d, 60.0, np.uint64(1))
        if index < 0:
            assert slow > 59.99 or slow == 60.0
        else:
            met += 1
            near_rod = scene.label[index, 2] == 3
            assert fast == pytest.approx(slow, abs=0.35 if near_rod else 0.006)
    assert 30 < met < 90


def test_ground_range_lies_on_the_ground():
    plan = Plan(200, 3, 0.0)
    rng = np.random.default_rng(1)
    for _ in range(300):
        x, y = rng.uniform(0, 200, 2)
        a, tilt = rng.uniform(0, 2 * math.pi), rng.uniform(0, 0.47)
        d = np.array([tilt * math.cos(a), tilt * math.sin(a), -1.0])
        d /= np.linalg.norm(d)
        o = np.array([x, y, 0.0]) - d * 380
        t, surface = rays._ground_range(*o, *d, 350.0, plan.ground)
        p = o + t * d
        # On a quay wall a small step sideways is a large one in height.
        assert abs(p[2] - plan.height(p[0], p[1])) < (0.9 if surface == 4 else 0.01)


def test_no_point_lies_in_a_shadow():
    """From every ground point the way back to the sensor is free of solid things."""
    o = TownOptions(size=90, density=1.5, seed=2, noise=0.0)
    survey = _Survey(o)
    chunk = Chunk(0, 0, survey.flight.lines)
    origin, direction, ids, *_ = survey.flight.fire(chunk, every=12)
    n = len(origin)
    pieces = [survey.blocks.get(i, j) for i, j in survey.plan.blocks_in(-60, -60, 150, 150, 30.0)]
    scene = build_scene(pieces, -60, -60, 150, 150)
    xyz, byte = np.empty((5 * n, 3)), np.empty((5 * n, 6), dtype=np.uint8)
    height, pulse = np.empty(5 * n), np.empty(5 * n, dtype=np.int64)
    setting = np.array([0.0, 0.0, 0.0, o.size, o.altitude, 0.0, 0.0, 0.0])  # a beam without width
    count, lost = rays.cast(
        origin, direction, ids, scene, survey.plan.ground, REFLECTANCE, setting, 2, xyz, byte, height, pulse
    )
    assert count > 300 and lost < n
    solid = np.flatnonzero((scene.shape[:, 7] == 0) & (scene.label[:, 2] == CONVEX))
    low = np.flatnonzero(byte[:count, 0] == 2)
    checked = 0
    for row in low[:: max(1, len(low) // 60)]:
        p, d = xyz[row], direction[pulse[row]]
        way = p - d * np.arange(0.3, 60.0, 0.05)[:, None]
        close = solid[(np.abs(scene.box[solid, :2] - p[:2]) < 40).all(axis=1)]
        assert not any(_inside(scene, n, way).any() for n in close)
        checked += 1
    assert checked > 30


@pytest.mark.parametrize("extinction", [0.2, 0.6, 1.5])
def test_porous_things_follow_beer_and_lambert(extinction):
    parts = Parts()
    parts.prism(0, 0, 0, 30, 30, 0, 4.0, VEGETATION, "leaf", extinction=extinction)
    scene = build_scene([parts.arrays(1)], -40.0, -40.0, 40.0, 40.0)
    rng = np.random.default_rng(0)
    passed = 0
    for key in range(4000):
        x, y = rng.uniform(-25, 25, 2)
        passed += rays._first_thing(scene, x, y, 50.0, 0.0, 0.0, -1.0, 50.0, np.uint64(key))[1] < 0
    # Clumps let a little more through than their mean density (Jensen).
    expected = math.exp(-0.975 * extinction * 4.0)
    assert 0.9 * expected - 0.01 < passed / 4000 < 1.6 * expected + 0.02


@pytest.mark.parametrize("strip", [0, 1, 2])
def test_no_pulse_that_reaches_the_square_is_left_out(strip, monkeypatch):
    flight = Flight(60.0, 0.0, 900.0, 30.0, 0.4, 1.3, 2.0)
    flight.strips, flight.across = 3, np.array([-300.0, 40.0, 350.0])
    quick = flight.fire(Chunk(strip, 0, flight.lines))
    monkeypatch.setattr(Flight, "_steps", lambda self, strip: (0, self.per_line))
    for a, b in zip(quick, flight.fire(Chunk(strip, 0, flight.lines)), strict=True):
        assert len(a) > 1000 and np.array_equal(a, b)


def test_town_coordinates_invert():
    plan = Plan(500, 8)
    rng = np.random.default_rng(2)
    for u, v in rng.uniform(-300, 300, (50, 2)):
        back = to_uv(*to_xy(u, v, plan.ground.frame), plan.ground.frame)
        assert np.allclose(back, (u, v), atol=1e-6)


# ---- files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("minor", "fmt"), [(4, 6), (2, 3), (4, 7), (4, 8), (2, 1), (3, 0)])
def test_file_reads_back(tmp_path, minor, fmt):
    t = make_town(40, 3, seed=4, outliers=0.01, progress=False)
    path = tmp_path / "t.laz"
    counts = write_town(t, path, minor_version=minor, dataformat_id=fmt, true_height=True)
    las = laspy.read(path)
    assert las.header.version == f"1.{minor}" and las.header.point_format.id == fmt
    assert sum(counts.values()) == len(las) == len(t)
    assert np.array_equal(np.round(las.xyz, 3), t.xyz)
    for name in ("classification", "intensity", "return_number", "number_of_returns", "point_source_id"):
        assert np.array_equal(np.asarray(las[name]), getattr(t, name)), name
    assert not np.asarray(las["scan_direction_flag"]).any()
    assert np.array_equal(las["TrueHeight"], t.height_above_ground)
    assert counts == {
        int(c): int(n) for c, n in zip(*np.unique(t.classification, return_counts=True), strict=True)
    }
    if fmt not in (0, 2):
        assert np.array_equal(las["gps_time"], t.gps_time)
    if fmt in (3, 7, 8):
        assert np.asarray(las["green"]).std() > 0
    angle = las["scan_angle"] * 0.006 if fmt >= 6 else las["scan_angle_rank"]
    assert np.abs(angle - t.scan_angle).max() <= (0.004 if fmt >= 6 else 0.51)


@pytest.mark.pdal
@pytest.mark.parametrize(("minor", "fmt", "suffix"), [(4, 6, "laz"), (2, 3, "laz"), (4, 6, "las")])
def test_pdal_reads_points_and_srs(tmp_path, pdal_program, minor, fmt, suffix):
    path = tmp_path / f"t.{suffix}"
    t = make_town(40, 2, seed=4, progress=False)
    write_town(t, path, minor_version=minor, dataformat_id=fmt)
    command = [pdal_program, "info", "--metadata", path]
    said = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)["metadata"]
    assert said["count"] == len(t) and said["dataformat_id"] == fmt and said["minor_version"] == minor
    assert 'AUTHORITY["EPSG","25832"]' in said["srs"]["horizontal"]
    assert said["srs"]["units"]["horizontal"] == "metre"
    assert said["scale_x"] == 0.001


def test_srs_none_and_southern_zone(tmp_path):
    t = make_town(30, 2, progress=False, srs="none")
    write_town(t, tmp_path / "a.las")
    assert not laspy.read(tmp_path / "a.las").vlrs
    south = dataclasses.replace(t, options=dataclasses.replace(t.options, srs="EPSG:32733"))
    write_town(south, tmp_path / "b.las")
    text = laspy.read(tmp_path / "b.las").vlrs[0].string
    assert "zone 33S" in text and '"false_northing",10000000' in text and '"central_meridian",15' in text


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    def broken():
        yield make_town(30, 2, progress=False)
        raise RuntimeError("lost power")

    with pytest.raises(RuntimeError):
        write_town(broken(), tmp_path / "t.laz")
    assert list(tmp_path.iterdir()) == []


# ---- errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"size": 5}, "size"),
        ({"density": 0}, "density"),
        ({"density": math.nan}, "density"),
        ({"size": "big"}, "size"),
        ({"seed": 1.5}, "seed"),
        ({"seed": -1}, "seed"),
        ({"scan_angle": 60}, "scan_angle"),
        ({"overlap": 0.95}, "overlap"),
        ({"outliers": 1}, "outliers"),
        ({"origin": (0, 0)}, "origin"),
        ({"origin": (0, 0, math.inf)}, "origin"),
        ({"srs": 25832}, "srs"),
        ({"sead": 1}, "seed"),
    ],
)
def test_bad_options_are_named(options, word):
    with pytest.raises(OptionError, match=word):
        make_town(**options)


@pytest.mark.parametrize(
    ("name", "options", "more"),
    [
        ("t.txt", {}, {}),
        ("nowhere/t.las", {}, {}),
        ("t.las", {}, {"minor_version": 2}),
        ("t.las", {}, {"dataformat_id": 5}),
        ("t.las", {"srs": "25832"}, {}),
    ],
)
def test_bad_files_are_refused_and_leave_nothing(tmp_path, name, options, more):
    with pytest.raises(OptionError):
        write_town(TownOptions(size=30, density=1, **options), tmp_path / name, **more)
    assert list(tmp_path.iterdir()) == []


def test_coordinates_beyond_32_bits_are_refused(tmp_path):
    t = make_town(30, 1, progress=False)
    t.xyz = t.xyz + 3e6
    with pytest.raises(StageError, match="32 bits"):
        write_town(t, tmp_path / "t.las")
    assert list(tmp_path.iterdir()) == []


# ---- the command -------------------------------------------------------------------------------------------


def test_command(tmp_path, capsys):
    out = tmp_path / "t.laz"
    args = [
        str(out),
        "--points",
        "5000",
        "--density",
        "4",
        "--seed",
        "2",
        "--picture",
        str(tmp_path / "t.png"),
    ]
    assert synthetic.main(args) == 0
    said = capsys.readouterr().out
    assert "Ground" in said and "per square metre" in said
    assert len(laspy.read(out)) == pytest.approx(5000, rel=0.1)
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")


def test_command_reports_errors(tmp_path, capsys):
    assert synthetic.main([str(tmp_path / "t.laz"), "--density", "-1"]) == 1
    assert "density" in capsys.readouterr().err
    assert synthetic.main([str(tmp_path / "t.laz"), "--points", "100", "--size", "50"]) == 1
    assert "not both" in capsys.readouterr().err
