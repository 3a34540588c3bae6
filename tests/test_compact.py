"""`classify` rounds heights and reliabilities, so that its outputs stay small."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from pdal_stages import cli
from pdal_stages.stages.dimensions import _MEANINGS, meaning
from pdal_stages.synthetic import TownOptions, write_town

pytestmark = pytest.mark.pdal
MADE = {"HeightAboveGround": 32, "Reliability": 64}


def test_outputs_are_half_as_large_again_at_most(tmp_path):
    town = tmp_path / "town.laz"
    write_town(TownOptions(size=60, density=12, seed=4), town)
    words = ["--where", "X > 500020", "--dimensions", "HeightAboveGround,Reliability,Margin"]
    for name, more in (("small", []), ("exact", ["--filters.modelclassifier.compact=false"])):
        assert cli.main(["classify", str(town), str(tmp_path / f"{name}.laz"), *more]) == 0
        assert cli.main(["classify", str(town), str(tmp_path / f"{name}_where.laz"), *words, *more]) == 0
    assert (tmp_path / "small.laz").stat().st_size <= 1.5 * town.stat().st_size
    small, exact = laspy.read(tmp_path / "small.laz"), laspy.read(tmp_path / "exact.laz")
    np.testing.assert_array_equal(small.classification, exact.classification)
    for name, parts in MADE.items():
        values, exactly = np.asarray(small[name]), np.asarray(exact[name])
        np.testing.assert_array_equal(values * parts, np.round(values * parts))
        assert np.abs(values - exactly).max() <= 0.5 / parts + 1e-6
        assert not np.array_equal(values, exactly)
    small, exact = laspy.read(tmp_path / "small_where.laz"), laspy.read(tmp_path / "exact_where.laz")
    inside = np.asarray(small.x) > 500020
    for name, parts in {**MADE, "Margin": 64}.items():
        values, exactly = np.asarray(small[name]), np.asarray(exact[name])
        np.testing.assert_array_equal(values[inside] * parts, np.round(values[inside] * parts))
        np.testing.assert_array_equal(values[~inside], exactly[~inside])


def said_of(path):
    with laspy.open(path) as reader:
        return {one.name: one.description for one in reader.header.point_format.extra_dimensions}


def test_files_say_what_their_dimensions_mean_and_how_they_are_rounded(tmp_path):
    plain, town, tiled = tmp_path / "plain.laz", tmp_path / "town.laz", tmp_path / "tiled"
    write_town(TownOptions(size=60, density=6, seed=4), plain)
    cloud = laspy.read(plain)
    cloud.add_extra_dim(laspy.ExtraBytesParams("Amplitude", "uint16", "of the echo, in dB by 0.01, long"))
    cloud.add_extra_dim(laspy.ExtraBytesParams("HeightAboveGround", "float32", "someone else's"))
    cloud.write(town)
    chosen = ["--dimensions=HeightAboveGround,Reliability,Margin,Ground"]
    small, exact = tmp_path / "small.laz", tmp_path / "exact.las"
    assert cli.main(["classify", str(town), str(small), *chosen]) == 0
    assert (
        cli.main(["classify", str(town), str(exact), *chosen, "--filters.modelclassifier.compact=false"]) == 0
    )
    assert cli.main(["classify", str(town), f"{tiled}/", *chosen, "--tile", "40"]) == 0
    rounded = {
        "Amplitude": "of the echo, in dB by 0.01, long",
        "HeightAboveGround": "above ground (Z unit), to 1/32",
        "Reliability": "probability of class, to 1/64",
        "Margin": "best minus second, to 1/64",
        "Ground": "1: ground, found by a filter",
    }
    assert said_of(small) == rounded == said_of(tiled / "town.laz")
    assert said_of(exact) == {
        **rounded,
        "HeightAboveGround": "above ground (Z unit)",
        "Reliability": "probability of class",
        "Margin": "best minus second",
    }


def test_every_meaning_fits_into_the_file_with_a_zero_after_it():
    rounded = ["HeightAboveGround", "Reliability", "Margin", "Variance", "Probability_255"]
    for text in [
        *map(meaning, [*_MEANINGS, "HeightAboveOpening_17_5"]),
        *(meaning(name, True) for name in rounded),
    ]:
        assert 0 < len(text.encode()) <= 31, text
    assert meaning("HeightAboveOpening_2_5") == "above 2.5 m opening (Z unit)"
