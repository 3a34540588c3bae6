"""The generated town: the same every time, dense as asked, true to its labels, readable by everybody."""

from __future__ import annotations

import dataclasses
import json
import math

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from processes import printed

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.model import load_model
from pdal_stages.stages.registry import stage_type, stage_types
from pdal_stages.synthetic import Town, make_town, write_town
from pdal_stages.synthetic.blocks import Solid
from pdal_stages.synthetic.demo import pipelines
from pdal_stages.synthetic.town import Pulses, cast

COLUMNS = [f.name for f in dataclasses.fields(Town)][:-2]


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(200, 3, seed=1, noise=0.0, progress=False)


def same(one: Town, two: Town) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(two, name)) for name in COLUMNS)


# ---- the same every time, as dense as asked ----------------------------------------------------------------


def test_same_seed_same_points_whatever_the_threads():
    whole = make_town(40, 3, seed=5, threads=1, progress=False)
    assert same(whole, make_town(40, 3, seed=5, threads=3, progress=False))


@pytest.mark.parametrize(("size", "density"), [(200, 1.5), (50, 15)])
def test_density_is_met(size, density):
    t = make_town(size, density, progress=False)
    assert len(t) / size**2 == pytest.approx(density, rel=0.06)


@settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    size=st.floats(20, 35),
    density=st.floats(0.5, 4),
    seed=st.integers(0, 2**31 - 1),
    noise=st.sampled_from([0.0, 0.5]),
)
def test_any_options_give_whole_pulses(**options):
    """Every pulse has returns 1..n from top to bottom, each saying n, under one time, strip and angle."""
    t = make_town(progress=False, **options)
    assert np.isfinite(t.xyz).all() and np.abs(t.height_above_ground).max() < 60
    starts = np.flatnonzero(np.r_[True, t.gps_time[1:] != t.gps_time[:-1]])
    counts = np.diff(np.r_[starts, len(t)])
    assert (np.diff(t.gps_time[starts]) > 0).all() and counts.max() <= 5
    assert np.array_equal(t.return_number, np.arange(len(t)) - np.repeat(starts, counts) + 1)
    assert np.array_equal(t.number_of_returns, np.repeat(counts, counts))
    for column in (t.point_source_id, t.scan_angle):
        assert np.array_equal(column, np.repeat(column[starts], counts))
    assert np.abs(t.scan_angle).max() <= 25
    later = np.flatnonzero(t.return_number > 1)
    assert (t.z[later] < t.z[later - 1]).all()


# ---- labels and heights are true ---------------------------------------------------------------------------


def test_ground_lies_on_the_ground_and_noise_moves_it(town):
    def error(t, code):
        members = t.classification == code
        return t.z[members] - t.ground_height(t.x[members], t.y[members])

    assert np.abs(error(town, 2)).max() < 0.003  # rounding to 1 mm on slopes
    noisy = make_town(60, 3, noise=0.05, progress=False)
    assert np.std(error(noisy, 2)) == pytest.approx(0.05, rel=0.15)
    height = town.z - town.ground_height(town.x, town.y)
    assert np.allclose(height, town.height_above_ground, atol=1e-4)


def test_labels_and_heights_agree(town):
    h, c = town.height_above_ground, town.classification
    west = town.x < np.median(town.x)
    for half in (west, ~west):  # so that training on one half and classifying the other is fair
        codes, counts = np.unique(c[half], return_counts=True)
        assert set(codes) == {1, 2, 3, 4, 5, 6, 14} and counts.min() >= 30
    assert (h[c == 3] > -0.01).all() and (h[c == 3] < 0.5).all()
    assert ((h[c == 4] >= 0.5) & (h[c == 4] < 2.0)).all()
    assert (h[c == 5] >= 2.0).all() and h[c == 5].max() < 32
    assert np.median(h[c == 6]) > 4 and 12 < h[c == 6].max() < 30
    assert h[c == 14].min() > 3


def straight_down(places):
    zeros = np.zeros(len(places))
    return Pulses(places, np.zeros((len(places), 2)), zeros, zeros.astype(np.uint16), zeros)


def test_heights_of_roofs_balls_and_wires():
    """Beams straight down, and slanted ones, meet a gable, a ball and a wire where these are."""
    rng = np.random.default_rng(0)
    solids = [
        Solid("box", (0, 0), (8, 4), 20, 34, 6, 0.5, pitch=(0.0, 1.0), peak=(0.0, 34.0)),
        Solid("ball", (30, 0), (4, 5), 30, 38, 5, 0.5),
        Solid("wire", (0, 20), (15, 0), 40, 43, 14, 0.5),
    ]
    pulses = straight_down(rng.uniform((-10, -25), (40, 25), (20_000, 2)))
    pulses.drift[10_000:] = 0.3, -0.2
    returns = cast(pulses, solids, 1, rng)
    uv, z = pulses.at(returns.pulse, returns.z), returns.z
    roof = (returns.code == 6) & (abs(uv[:, 1]) < 3.99) & (abs(uv[:, 0]) < 7.99)
    np.testing.assert_allclose(z[roof], 34 - abs(uv[roof, 1]), atol=1e-9)
    ball = returns.code == 5
    sphere = ((np.column_stack([uv, z])[ball] - (30, 0, 34)) / (4, 5, 4)) ** 2
    np.testing.assert_allclose(sphere.sum(axis=1), 1.0, atol=1e-9)
    wire = returns.code == 14
    u = uv[wire, 0]
    np.testing.assert_allclose(z[wire], 41.5 + 0.1 * u - 0.6 * (1 - (u / 15) ** 2), atol=0.02)
    assert np.abs(uv[wire, 1] - 20).max() < 0.13 and min(roof.sum(), ball.sum(), wire.sum()) > 20


# ---- files, the command, errors ----------------------------------------------------------------------------


@pytest.mark.pdal
def test_pdal_reads_the_file_back(tmp_path, pdal_program):
    path = tmp_path / "t.laz"
    t = make_town(40, 3, seed=4, progress=False)
    write_town(t, path)
    las = laspy.read(path)
    assert np.array_equal(np.round(las.xyz, 3), t.xyz)
    names = "classification intensity return_number number_of_returns point_source_id gps_time"
    for name in names.split():
        assert np.array_equal(np.asarray(las[name]), getattr(t, name)), name
    assert np.abs(las["scan_angle"] * 0.006 - t.scan_angle).max() <= 0.004
    metadata = json.loads(printed(pdal_program, "info", "--metadata", path))["metadata"]
    assert (
        metadata["count"] == len(t)
        and metadata["dataformat_id"] == 6
        and metadata["minor_version"] == 4
    )
    assert 'AUTHORITY["EPSG","25832"]' in metadata["srs"]["horizontal"]
    assert metadata["srs"]["units"]["horizontal"] == "metre" and metadata["scale_x"] == 0.001
    write_town(t, tmp_path / "again.laz")
    assert (tmp_path / "again.laz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"size": 5}, "size"),
        ({"density": math.nan}, "density"),
        ({"seed": 1.5}, "seed"),
    ],
)
def test_bad_options_are_named(options, word):
    with pytest.raises(OptionError, match=word):
        make_town(**options)


def test_stages_of_the_demo_take_their_options(tmp_path):
    load_model("standard").save(tmp_path / "town.model")
    for stages in pipelines(tmp_path, 0.0, 1).values():
        for options in map(dict, stages):
            kind = options.pop("type")
            if kind in stage_types():
                stage_type(kind)(options)
