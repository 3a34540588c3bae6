"""`classify` rounds heights and reliabilities, so that its outputs stay small."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from pdal_stages import cli

pytestmark = pytest.mark.pdal
MADE = {"HeightAboveGround": 32, "Reliability": 64}


def test_outputs_are_half_as_large_again_at_most(ready_town, tmp_path):
    town = ready_town
    words = ["--where", "X > 500020", "--dimensions", "HeightAboveGround,Reliability,Margin"]
    for name, more in (("small", []), ("exact", ["--filters.modelclassifier.compact=false"])):
        assert cli.main(["classify", str(town), str(tmp_path / f"{name}.laz"), *more]) == 0
        assert (
            cli.main(["classify", str(town), str(tmp_path / f"{name}_where.laz"), *words, *more])
            == 0
        )
    assert (tmp_path / "small.laz").stat().st_size <= 1.5 * town.stat().st_size
    small, exact = laspy.read(tmp_path / "small.laz"), laspy.read(tmp_path / "exact.laz")
    np.testing.assert_array_equal(small.classification, exact.classification)
    for name, parts in MADE.items():
        values, exactly = np.asarray(small[name]), np.asarray(exact[name])
        np.testing.assert_array_equal(values * parts, np.round(values * parts))
        assert np.abs(values - exactly).max() <= 0.5 / parts + 1e-6
        assert not np.array_equal(values, exactly)
    small, exact = (
        laspy.read(tmp_path / "small_where.laz"),
        laspy.read(tmp_path / "exact_where.laz"),
    )
    inside = np.asarray(small.x) > 500020
    for name, parts in {**MADE, "Margin": 64}.items():
        values, exactly = np.asarray(small[name]), np.asarray(exact[name])
        np.testing.assert_array_equal(values[inside] * parts, np.round(values[inside] * parts))
        np.testing.assert_array_equal(values[~inside], exactly[~inside])
