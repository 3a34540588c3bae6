"""Classes of lines: decided after the probabilities, at once or as a stage of its own."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pytest
from test_towers import lattice, write

import pdal_stages as ps
from pdal_stages.base.errors import ModelError, OptionError
from pdal_stages.base.messages import Report
from pdal_stages.classifier.interface import Block
from pdal_stages.classifier.line_evidence import REACH, RULES
from pdal_stages.classifier.model import assemble
from pdal_stages.classifier.prediction import (
    LineCandidates,
    Prediction,
    PredictionOptions,
    set_lines_aside,
    settle_lines,
)
from pdal_stages.cli import main
from pdal_stages.pipeline.copies import run_stages
from pdal_stages.pipeline.expansion import expand_stage

CODES = np.array([2, 5, 14], np.uint8)
IS_LINE = CODES == 14


def wire(length, step=0.5, across=0.0):
    """Return a straight wire (n, 3) along x, 12 m above the ground."""
    x = np.arange(0.0, length, step)
    return np.column_stack([x, np.full(len(x), across), np.full(len(x), 12.0)])


@pytest.fixture(scope="module")
def cloud():
    """Return ground, a crown and a wire, the points of each class in this order."""
    rng = np.random.default_rng(5)
    ground = rng.uniform((0, 0, 0), (60, 60, 0.1), (3000, 3))
    crown = rng.uniform((40, 40, 2), (55, 55, 14), (1500, 3))
    xyz = np.concatenate([ground, crown, wire(60.0, across=10.0)])
    return ps.TrainingCloud(
        xyz, np.repeat(CODES, [3000, 1500, 120]), {"HeightAboveGround": xyz.T[2]}
    )


@pytest.fixture(scope="module")
def models(cloud):
    """Return a model without lines, and one of which class 14 is of lines."""
    options = {"neighborhoods": "k10", "passes": 1, "trees": 8, "folds": 0, "voxel": 0}
    return [
        ps.train(cloud, ps.TrainingOptions(**options, lines=lines), progress=False)
        for lines in ((), (14,))
    ]


def test_candidates_are_set_aside_and_what_can_be_nothing_else_stays():
    p = np.array([[0.6, 0.38, 0.02], [0.5, 0.3, 0.2], [0.0, 0.1, 0.9], [0.0, 0.0, 1.0]])
    block, columns = set_lines_aside(Block(np.arange(4), p), IS_LINE, CODES)
    expected = [[0.6, 0.38, 0.02], [0.625, 0.375, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(block.probabilities, expected)
    np.testing.assert_allclose(columns["line_probability"], [0.0, 0.2, 0.9, 1.0], rtol=1e-6)
    assert columns["line_class"].tolist() == [0, 14, 14, 14]
    assert p[1, 2] == 0.2, "the block of the passes is not changed"


def test_what_lies_on_a_line_is_of_its_class_halfway_to_sure():
    candidates = LineCandidates(np.float32([0.2, 0.2, 0.0]), np.uint8([14, 14, 0]))
    prediction = Prediction(
        np.uint8([5, 5, 2]),
        np.float32([0.75, 0.75, 0.9]),
        Report({}),
        margin=np.float32([0.5, 0.5, 0.8]),
        probabilities=np.float32([[0.25, 0.75, 0], [0.25, 0.75, 0], [0.9, 0.1, 0]]),
        candidates=candidates,
    )
    settle_lines(prediction, np.array([0]), CODES)
    assert prediction.classification.tolist() == [14, 5, 2]
    np.testing.assert_allclose(prediction.reliability, [0.6, 0.75, 0.9])
    np.testing.assert_allclose(prediction.margin, [0.3, 0.5, 0.8], rtol=1e-6)
    np.testing.assert_allclose(prediction.probabilities[0], [0.1, 0.3, 0.6], rtol=1e-6)
    np.testing.assert_allclose(prediction.probabilities[1], [0.25, 0.75, 0])


def test_a_model_says_which_classes_are_of_lines(models, cloud, tmp_path):
    free, bound = models
    assert "lines" not in free.info and bound.info["lines"] == [14]
    assert bound.halo_m == free.halo_m + REACH
    bound.save(tmp_path / "lines.model")
    for model in (bound, ps.load_model(tmp_path / "lines.model")):
        found = model.predict(cloud.xyz, cloud.dimensions)
        assert (found.classification == cloud.labels).mean() > 0.99
        assert (found.classification[4500:] == 14).all()
        assert (found.reliability[4500:] >= 0.5 * (1.0 + RULES.candidate)).all()
    manifest = bound.manifest() | {"lines": [15]}
    with pytest.raises(ModelError, match="no such class"):
        assemble(manifest, [each.arrays() for each in bound.passes])


def test_unlikely_points_on_a_line_are_of_it_and_likely_ones_on_none_are_not(models):
    rng = np.random.default_rng(3)
    specks = rng.uniform((0, 100, 5), (60, 160, 15), (60, 3))
    xyz = np.concatenate([wire(60.0), specks])
    share = np.float32([*np.where(np.arange(120) % 7, 0.1, 0.6), *np.full(60, 0.9)])
    prediction = Prediction(
        np.full(180, 5, np.uint8),
        np.full(180, 0.8, np.float32),
        Report({}),
        candidates=LineCandidates(share, np.full(180, 14, np.uint8)),
    )
    found = models[1].finish(
        prediction, np.ones(180, bool), PredictionOptions(), xyz.__getitem__, None
    )
    assert found.classification.tolist() == [14] * 120 + [5] * 60
    assert found.report.figures["classes"] == {"5": 60, "14": 120}


OPTIONS = [
    {},
    {"margin": True, "probabilities": True, "compact": True},
    {"vegetation_heights": [6, 9], "mark": "Chosen", "where": "Y < 45"},
    {"reject_below": 0.97, "margin": True, "given_ground": True},
    {"reject_below": 0.97, "rejected_code": 1, "keep": "5", "ignore": "7"},
]


@pytest.mark.parametrize("options", OPTIONS)
def test_two_parts_are_one_stage(models, cloud, tmp_path, options):
    path = str(tmp_path / "lines.model")
    models[1].save(path)
    rng = np.random.default_rng(2)
    columns = dict(zip("XYZ", cloud.xyz.T, strict=True))
    columns["Classification"] = rng.choice([0, 1, 2, 5, 7], len(cloud.xyz)).astype(np.uint8)
    columns["HeightAboveGround"] = cloud.dimensions["HeightAboveGround"]
    stage = {"type": "filters.modelclassifier", "model": path, **options}
    whole = expand_stage(stage)
    changes = whole.stage.parts()
    assert len(changes) == 2
    parts = [
        expand_stage({n: v for n, v in {**stage, **change}.items() if v is not None})
        for change in changes
    ]
    assert [each.stage.costly for each in parts] == [True, False]
    expected = run_stages([whole], columns, "")
    found = run_stages(parts, columns, "")
    assert (expected["Classification"] == 14).any()
    for name in (*whole.stage.creates(), "HeightAboveGround"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    counted = [
        {name: sum(report.figures.get(name, 0) for each in run for report in each.reports)}
        for run in ([whole], parts)
        for name in whole.stage.counts()
    ]
    half = len(counted) // 2
    assert counted[:half] == counted[half:]


def test_only_models_with_lines_have_parts(models, tmp_path):
    path = str(tmp_path / "free.model")
    models[0].save(path)
    stage = {"type": "filters.modelclassifier", "model": path}
    assert expand_stage(stage).stage.parts() == ()
    with pytest.raises(OptionError, match="'part' is for models with classes of lines"):
        expand_stage({**stage, "part": "lines"})


@pytest.mark.pdal
@pytest.mark.parametrize("pdal", [[], [{"type": "filters.assign", "value": "UserData = 3"}]])
def test_in_tiles_as_in_one_piece_with_and_without_stages_of_pdal(tmp_path, pdal):
    """Both parts run in one pipeline of PDAL, too, and count in a report that is made anew."""
    results = {"margin": True, "probabilities": True, "compact": True}
    job = [
        write(tmp_path / "in.las", *lattice()),
        {"type": "filters.hag_morphological", "ground": True, "openings": "5,17"},
        {"type": "filters.modelclassifier", "model": "standard", **results, "tag": "model"},
        *pdal,
        {"type": "filters.towers"},
        {"type": "writers.las", "extra_dims": "all"},
    ]
    job[2] |= {"keep_sure": 0.9, "where": "Classification != 6"}
    tiles = ("--tile", "30", "--workers", "0", "--report", str(tmp_path / "report.json"))
    reports = []
    for name, words in (("whole", ()), ("tiled", tiles), ("tiled", (*tiles, "--resume"))):
        job[-1]["filename"] = str(tmp_path / f"{name}.las")
        (tmp_path / "job.json").write_text(json.dumps(job))
        assert main(["pipeline", str(tmp_path / "job.json"), "--no-progress", *words]) == 0
        if words:
            reports.append(json.loads((tmp_path / "report.json").read_text()))
    assert [report["models"] for report in reports] == [["standard"]] * 2
    assert [report["states"]["done"] > 0 for report in reports] == [True, False]
    assert reports[0]["point_counts"] == reports[1]["point_counts"]
    assert reports[0]["point_counts"]["filters.modelclassifier.outside_where"] > 0
    whole, tiled = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiled"))
    assert (np.asarray(whole.classification) == 14).sum() > 500
    names = sorted(whole.point_format.dimension_names)
    assert names == sorted(tiled.point_format.dimension_names) and "Probability_14" in names
    for name in names:
        assert np.array_equal(whole[name], tiled[name]), name
