"""The Python interface: defaults that work, arrays in and out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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


def test_every_public_name_is_on_the_api_page():
    page = (ROOT / "docs" / "api.md").read_text()
    missing = [name for name in ps.__all__ if f".{name}\n" not in page and name != "__version__"]
    assert not missing and all(getattr(ps, name) is not None for name in ps.__all__)


def test_importing_the_package_is_light():
    code = "import sys, pdal_stages; sys.exit(bool({'numba', 'sklearn', 'pdal', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
