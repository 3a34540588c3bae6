"""Model files outlive releases: frozen ones give the same classes today."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from pdal_stages import load_model
from pdal_stages.classifier import model_file
from pdal_stages.classifier.model_file import shipped
from pdal_stages.cli import main

DATA = Path(__file__).parent / "data"
#: A model of the cloud below, written in version 3 of the format.
FROZEN = DATA / "frozen-3.model"


@pytest.fixture(scope="module")
def cloud():
    """Squares of 5 m, smooth and rough in turn, and which points are rough."""
    rng = np.random.default_rng(4)
    xyz = rng.uniform(0, 30, (2500, 3))
    rough = (np.floor(xyz[:, 0] / 5) + np.floor(xyz[:, 1] / 5)) % 2 == 1
    xyz[:, 2] = rng.normal(0, 1, len(xyz)) * np.where(rough, 0.6, 0.1)
    return xyz.round(2), np.where(rough, 5, 2)


def test_a_frozen_file_gives_the_classes_it_gave(cloud):
    xyz, truth = cloud
    predicted = load_model(FROZEN).predict(xyz).classification
    counts = np.bincount(predicted, minlength=6)[[2, 5]]
    assert np.abs(counts - (1241, 1259)).max() <= 3  # another processor may round otherwise
    assert np.mean(predicted == truth) > 0.94


def test_columns_in_another_order_are_read_by_their_names(cloud, tmp_path):
    """A file whose columns are in reverse order, with the trees that go with them, gives the same classes."""
    model = load_model(FROZEN)
    manifest = json.loads(json.dumps(model.manifest()))
    arrays = [
        {name: values.copy() for name, values in classifier.arrays().items()}
        for classifier in model.passes
    ]
    for entry, of_pass, classifier in zip(manifest["passes"], arrays, model.passes, strict=True):
        count = len(classifier.plan.names)
        entry["feature_names"][:count] = entry["feature_names"][:count][::-1]
        splits = (of_pass["feature"] >= 0) & (of_pass["feature"] < count)
        of_pass["feature"][splits] = count - 1 - of_pass["feature"][splits]
    model_file.write(tmp_path / "reverse.model", manifest, arrays)
    predicted = load_model(tmp_path / "reverse.model").predict(cloud[0]).classification
    assert np.array_equal(predicted, model.predict(cloud[0]).classification)


def test_the_table_of_features_is_the_registry():
    docs = Path(__file__).parent.parent / "docs"
    table = runpy.run_path(str(docs / "feature_table.py"))["table"]()
    assert table in (docs / "features.md").read_text(encoding="utf-8"), "run docs/feature_table.py"


def test_models_of_other_algorithms_warn_and_say_what_to_do(cloud):
    xyz, _ = cloud
    model = load_model(FROZEN)
    assert not model.outdated and not model.predict(xyz).report.warnings
    model.info["algorithms"]["filters.multiscalefeatures"] += 1
    (warning,) = model.predict(xyz).report.warnings
    assert "version 2 of filters.multiscalefeatures" in warning.text
    assert "Train the model again" in warning.text


def test_shipped_models_are_of_the_algorithms_of_this_release():
    for name in shipped():
        assert load_model(name).outdated == [], f"build {name} anew: docs/models.md"


def test_the_shipped_model_is_described_in_words(capsys):
    main(["model", "standard"])
    output = capsys.readouterr().out
    model = load_model("standard")
    for token in {
        neighborhood.token for each in model.passes for neighborhood in each.plan.neighborhoods
    }:
        assert token in output
    for words in (
        "of points right, on ground it had not seen",
        "filters.hag_morphological (ground True, openings",
        f"version {model.info['algorithms']['filters.hag_morphological']} of its algorithm",
        "Montpellier, Delft, Seville",
        *(f"{code} {name}" for code, name in model.classes),
    ):
        assert words in output, words
