"""The page about a model file: what it shows for a forest and a network, and what odd manifests do to it."""

import re
from html.parser import HTMLParser

import pytest
from test_classifier_training import SMALL, scene

from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.cli import main


class _Balance(HTMLParser):
    """Open tags must be closed."""

    def __init__(self):
        super().__init__()
        self.open, self.text = [], []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br", "path", "rect", "circle", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in ("path", "rect", "circle"):
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(page):
    parser = _Balance()
    parser.feed(page)
    assert not parser.open
    return " ".join(parser.text)


@pytest.fixture(scope="module")
def searched():
    xyz, label, dimensions = scene(n=4000)
    options = TrainingOptions(**{**SMALL, "trees": 10}, folds=2, prior_weight=0.5)
    return train([TrainingCloud(xyz, label, dimensions, "a<b>.laz")], options, progress=False)


def test_a_forest(searched, tmp_path, capsys):
    searched.save(tmp_path / "town.model")
    assert main(["model", str(tmp_path / "town.model"), "--html", str(tmp_path / "m.html")]) == 0
    said = capsys.readouterr().out
    words = read((tmp_path / "m.html").read_text())
    assert "Model town.model" in words and "blocks held out" in words and "a<b>.laz" in words
    row = searched.info["accuracy"]["cross_validation"]["chosen"]
    assert f"{100 * row['overall_accuracy']:.1f}" in words
    assert "Prior factor" in words and not re.search(r"\d\.\d{7,}", words)
    assert "By neighborhood" in words and "random_forest" in said
