"""The Python interface: defaults that work, arrays in and out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from block_scene import ground_and_block

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.stages.multiscale_features import MultiscaleFeatures

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def scene():
    """Ground (2) and a block (6), meters."""
    points = ground_and_block(1500, size=30.0)
    return np.column_stack([points[axis] for axis in "XYZ"]), points["Classification"]


@pytest.fixture(scope="module")
def small():
    return ps.TrainingOptions("k10", "Linearity,HeightRange", count=100, trees=5, passes=1)


def test_features_with_defaults(scene):
    xyz = scene[0][:300]
    table = ps.compute_features(xyz)
    stage = MultiscaleFeatures({})
    assert table.names == stage.plan.names and table.values.shape == (300, len(table.names))
    assert np.array_equal(table["Planarity_c2"], table.values[:, table.names.index("Planarity_c2")])


def test_heights_of_one_array(scene):
    xyz = scene[0]
    assert np.array_equal(ps.hag_minima(xyz), ps.hag_minima(*xyz.T))
    heights, three = ps.filtered_ground(xyz), ps.filtered_ground(*xyz.T)
    assert all(np.array_equal(heights[name], three[name]) for name in three)
    with pytest.raises(StageError, match=r"\(n, 3\)"):
        ps.hag_minima(xyz[:, :2])


def test_train_and_predict_on_coordinates_alone(scene, small, tmp_path):
    xyz, y = scene
    model = ps.train(xyz, y, small, progress=False)
    model.save(tmp_path / "m.model")
    loaded = ps.load_model(tmp_path / "m.model")
    assert loaded.info["preparation"][0]["type"] == "filters.hag_morphological"
    prediction = loaded.predict(xyz)
    assert (prediction.classification == y).mean() > 0.98


@pytest.mark.pdal
def test_a_model_of_arrays_classifies_files_alike(scene, small, tmp_path, write_las):
    """Heights that were made of arrays are those of the stage that the model names."""
    from pdal_stages.cli import main

    xyz, y = scene[0].round(3), scene[1]
    model = ps.train(xyz, y, small, progress=False)
    model.save(tmp_path / "m.model")
    source = write_las(tmp_path / "in.las", dict(zip("XYZ", xyz.T, strict=True)), offset=(0, 0, 0))
    assert (
        main(
            ["classify", str(source), str(tmp_path / "o.las"), "--model", str(tmp_path / "m.model")]
        )
        == 0
    )
    import laspy

    classified = laspy.read(tmp_path / "o.las")
    xyz = np.column_stack([classified.x, classified.y, classified.z])
    assert np.array_equal(np.asarray(classified.classification), model.predict(xyz).classification)


@pytest.mark.pdal
def test_functions_give_the_bits_of_stages_on_rounded_coordinates(tmp_path, write_las):
    """docs/api.md: a stage rounds coordinates to 1e-6 of the file's unit, the functions do not."""
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 120, (3000, 3)) / 10 * [1, 1, 0.1]  # many neighbors exactly at a radius
    xyz = cells + np.array([632_000.3, 5_400_000.7, 100.1])
    arrays = dict(zip("XYZ", xyz.T, strict=True))
    path = write_las(tmp_path / "a.las", arrays, offset=[632_000.3, 5_400_000.7, 0.1])
    words = {"neighborhoods": "c1,s1,kopt", "feature_set": "covariance,geometric"}
    pipeline = ps.Pipeline([str(path), {"type": "filters.multiscalefeatures", **words}])
    pipeline.execute()
    las = laspy.read(path)
    raw = np.column_stack([las.x, las.y, las.z])
    same = [
        all(np.array_equal(table[name], pipeline.arrays[0][name]) for name in table.names)
        for xyz in (np.rint(raw * 1e6) / 1e6, raw)
        for table in [ps.compute_features(xyz, **words)]
    ]
    assert same == [True, False]
    assert "np.rint(np.column_stack" in (ROOT / "docs" / "api.md").read_text()


def test_every_public_name_is_on_the_api_page():
    page = (ROOT / "docs" / "api.md").read_text()
    missing = [name for name in ps.__all__ if f".{name}\n" not in page and name != "__version__"]
    assert not missing and all(getattr(ps, name) is not None for name in ps.__all__)


def test_importing_the_package_is_light():
    code = "import sys, pdal_stages; sys.exit(bool({'numba', 'sklearn', 'pdal', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
