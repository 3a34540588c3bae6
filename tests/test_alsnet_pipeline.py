"""Networks through PDAL: trained by one word, applied by the same stage, in tiles as in one piece."""

import dataclasses
import importlib.util
import json
from importlib.resources import files

import jsonschema
import laspy
import numpy as np
import pytest
from alsnet_scenes import TINY, model_of, random_net, scene

import pdal_stages as ps
from pdal_stages import load_model
from pdal_stages.alsnet.batches import Batches
from pdal_stages.base.errors import DimensionError, OptionError
from pdal_stages.stages.registry import stage_type

WRITER = "writers.classifiermodel"


def las_writer(path):
    """The writer of a LAS file with all dimensions."""
    words = {"forward": "all", "extra_dims": "all", "minor_version": 4}
    return {"type": "writers.las", "filename": str(path), **words}


@pytest.fixture
def cloud(tmp_path, write_las):
    xyz, labels, dimensions = scene(6000, 48.0, origin=(500_000.0, 5_400_000.0, 100.0))
    arrays = {
        **dict(zip("XYZ", xyz.T, strict=True)),
        "Classification": labels,
        "Intensity": dimensions["Intensity"],
    }
    return write_las(tmp_path / "in.las", arrays, point_format=6), xyz, dimensions


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "net.model"
    net = dataclasses.replace(
        random_net(("Z", "Intensity"), seed=4), mean=(0.2, 100.0), scale=(0.3, 60.0)
    )
    model_of(net).save(path)
    return path


@pytest.mark.pdal
def test_modelclassifier_applies_a_network(cloud, model, tmp_path, pdal_module):
    path = cloud[0]
    out = tmp_path / "out.las"
    ps.run_pipeline(
        [
            str(path),
            {
                "type": "filters.modelclassifier",
                "model": str(model),
                "margin": True,
                "variance": True,
            },
            las_writer(out),
        ]
    )
    las = laspy.read(out)
    read = np.round(np.column_stack([las.x, las.y, las.z]), 6)  # as stages see coordinates
    prediction = load_model(model).predict(
        read, {"Intensity": np.asarray(las.intensity)}, margin=True, variance=True
    )
    assert np.array_equal(np.asarray(las.classification), prediction.classification)
    assert np.array_equal(np.asarray(las["Margin"]), prediction.margin)
    assert (
        np.array_equal(np.asarray(las["Variance"]), prediction.variance)
        and prediction.variance.max() > 0
    )
    assert len(np.unique(prediction.classification)) > 1


@pytest.mark.pdal
def test_tiles_give_the_labels_of_the_whole(cloud, tmp_path, pdal_module):
    """Heights above ground included, which neighbors need too."""
    from pdal_stages import run_tiled

    path, model = cloud[0], tmp_path / "heights.model"
    net = dataclasses.replace(
        random_net(("Z", "HeightAboveGround"), seed=4), mean=(0.2, 1.0), scale=(0.3, 2.0)
    )
    model_of(net).save(model)

    def stages(out):
        return [
            str(path),
            {"type": "filters.hag_minima"},
            {"type": "filters.modelclassifier", "model": str(model)},
            las_writer(out),
        ]

    ps.run_pipeline(stages(tmp_path / "whole.las"))
    run = run_tiled(stages(tmp_path / "tiled.las"), 20, workers=0)
    assert not run.failures and len(run.tiles) == 9
    whole, tiled = laspy.read(tmp_path / "whole.las"), laspy.read(tmp_path / "tiled.las")

    def rows(las):
        names = ("X", "Y", "Z", "intensity", "classification", "Reliability")
        table = np.column_stack([np.asarray(las[name], np.float64) for name in names])
        return table[np.lexsort(table.T[::-1])]

    assert np.array_equal(rows(whole), rows(tiled))


@pytest.mark.pdal
@pytest.mark.skipif(
    importlib.util.find_spec("torch") is None,
    reason="PyTorch is not installed (extra 'deep'): training is not tested",
)
def test_color_and_echo_width_of_a_file_are_inputs(tmp_path, write_las, pdal_module):
    """Color is LAS's own; echo width is an extra dimension, which the reader of LAS 1.4 gives by its name."""
    xyz, labels, _ = scene(4000, 36.0, origin=(500_000.0, 5_400_000.0, 100.0))
    arrays = {
        **dict(zip("XYZ", xyz.T, strict=True)),
        "Classification": labels,
        "Red": (9000 * labels.astype(int)).astype(np.uint16),
        "EchoWidth": (4.0 + labels).astype(np.float32),
    }
    path = write_las(tmp_path / "in.las", arrays, point_format=7)
    reader = {"type": "readers.las", "filename": str(path), "use_eb_vlr": True}
    output, out = str(tmp_path / "a.model"), str(tmp_path / "out.las")
    network = {
        "configuration": TINY.to_dict(),
        "epochs": 16,
        "validation": 0,
        "learning_rate": 0.01,
    }
    writer = {
        "type": WRITER,
        "filename": output,
        "algorithm": "alsnet",
        "alsnet": network,
        "threads": 1,
    }
    ps.run_pipeline([reader, {**writer, "dimensions": "Red,EchoWidth"}])
    assert load_model(output).required_dimensions == ("Red", "EchoWidth")
    ps.run_pipeline([reader, {"type": "filters.modelclassifier", "model": output}, out])
    assert (np.asarray(laspy.read(out).classification) == labels).mean() > 0.95
    assert len(load_model(output).info["training"]["curve"]) == 16
    del arrays["EchoWidth"]
    bare = str(write_las(tmp_path / "bare.las", arrays, point_format=7))
    with pytest.raises(DimensionError, match="EchoWidth"):
        ps.run_pipeline([bare, {"type": "filters.modelclassifier", "model": output}])


@pytest.mark.pdal
def test_accuracy_of_each_batch(cloud, model, tmp_path, pdal_module):
    """[WM19 Figure 3]: a share for each batch, at its center, in the JSON of filters.accuracy."""
    path = cloud[0]
    stages = [
        {"type": "readers.las", "filename": str(path)},
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        {"type": "filters.modelclassifier", "model": str(model)},
        {"type": "filters.accuracy", "json": str(tmp_path / "a.json"), "print": False},
        las_writer(tmp_path / "out.las"),
    ]
    ps.run_pipeline(stages)
    written = json.loads((tmp_path / "a.json").read_text())
    schema = files("pdal_stages.accuracy").joinpath("accuracy-1.json").read_text()
    jsonschema.Draft202012Validator(json.loads(schema)).validate(written)
    out = laspy.read(tmp_path / "out.las")
    right = np.asarray(out.classification) == np.asarray(out.Reference)
    net = load_model(model).algorithm
    batches = Batches(np.asarray(out.xyz), net.configuration.points, net.spacing)
    assert len(written["batches"]) == len(batches) > 50
    for number, entry in enumerate(written["batches"]):
        rows = batches.members(number)
        assert (entry["x"], entry["y"]) == tuple(batches.centers[number])
        assert entry["points"] == len(rows)
        assert entry["overall_accuracy"] == pytest.approx(right[rows].mean())


def test_stage_options(model, tmp_path):
    classifier, writer = stage_type("filters.modelclassifier"), stage_type(WRITER)
    stage = classifier({"model": str(model)})
    assert stage.halo_m() == load_model(model).halo_m
    known = {
        "filename": str(tmp_path / "m"),
        "algorithm": "alsnet",
        "alsnet": {"coordinates": "XYZ"},
    }
    assert writer(known).reads() == ["Classification", "HeightAboveGround"]
    with pytest.raises(OptionError, match="epochs"):
        writer({**known, "alsnet": {"epochs": -1}})
    with pytest.raises(OptionError, match="algorithm"):
        writer({**known, "algorithm": "resnet"})
