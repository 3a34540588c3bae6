"""The HTML report: self-contained, well formed, readable, bounded, and telling the truth."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from PIL import Image

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.accuracy.text import percent
from pdal_stages.reports.accuracy_page import Place, write_accuracy_report

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Parses strictly: every tag is closed in order; keeps tags, attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs), f"duplicate attribute of <{tag}>"
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes <{self.open[-1:]}>"
        self.open.pop()

    def handle_data(self, data):
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def accuracy_page(a, **content):
    """The report as text."""
    with TemporaryDirectory() as folder:
        return write_accuracy_report(Path(folder) / "a.html", a, **content).read_text(
            encoding="utf-8"
        )


@pytest.fixture(scope="module")
def scene():
    """A house, a tree and ground in national-grid coordinates, with mistakes along the house's edge."""
    rng = np.random.default_rng(5)
    xy = rng.random((20_000, 2)) * (60, 40)
    house = (np.abs(xy - (20, 20)) < 8).all(axis=1)
    tree = np.hypot(*(xy - (45, 25)).T) < 5
    z = np.where(house, 8.0, np.where(tree, rng.uniform(2, 9, len(xy)), 0.0)) + rng.normal(
        0, 0.03, len(xy)
    )
    reference = np.where(house, 6, np.where(tree, 5, 2))
    reference[:50] = 1
    predicted = reference.copy()
    edge = house & (np.abs(xy[:, 1] - 12) < 1)
    predicted[edge] = 5
    predicted[60:90] = 1
    reliability = np.where(predicted == reference, 0.95, 0.55)
    xyz = np.column_stack([np.add(xy, (770_600, 6_277_500)), z + 50])
    return xyz, reference, predicted, reliability


@pytest.fixture(scope="module")
def accuracy(scene):
    _, reference, predicted, reliability = scene
    return Accuracy.from_labels(reference, predicted, ignore=[1], reliability=reliability)


@pytest.fixture(scope="module")
def full(scene, accuracy):
    xyz, reference, predicted, _ = scene
    return accuracy_page(
        accuracy,
        places=[Place("", xyz, reference, predicted)],
        title="Town <test> & more",
        subtitle='A "quoted" line',
        importances={"Planarity_c2": 0.6, "<b>bold</b>": 0.4},
        settings={"model": {"trees": 100, "spheres": [1, 2]}, "seed": None, "note": "</td>"},
    )


# ---- the page --------------------------------------------------------------------------------------------


def test_well_formed_and_self_contained(full):
    page = Page(full)
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    for _, attrs in page.tags:
        for name in ("src", "href", "data", "srcset", "xlink:href"):
            assert attrs.get(name, "data:").startswith("data:")
        assert not any(name.startswith("on") for name in attrs)
    assert "url(" not in full
    assert "@import" not in full
    assert "http" not in full
    assert full.startswith("<!DOCTYPE html>")


def test_nothing_given_becomes_markup(full):
    page = Page(full)
    for words in ("Town <test> & more", 'A "quoted" line', "<b>bold</b>", "</td>"):
        assert words in page.text
    assert "<test>" not in full
    assert page.text.count("model.trees") == 1
    assert "1, 2" in page.text


def test_every_figure_is_there(full, accuracy):
    text = Page(full).text
    for value in (
        accuracy.overall_accuracy,
        accuracy.kappa,
        accuracy.mean_class_recall,
        accuracy.mean_class_precision,
        accuracy.mean_f1,
        accuracy.mean_iou,
    ):
        assert percent(value, 1) in text
    for f in accuracy.per_class:
        assert f"{f.support:,}" in text
        for value in (f.recall, f.precision, f.f1, f.iou):
            assert percent(value, 1) in text
    for count in accuracy.matrix.ravel():
        assert f"{count:,}" in text
    for share in accuracy.by_reference.ravel():
        assert f"{100 * share:.1f} %" in text
    assert "Building taken for High vegetation" in text
    assert f"{accuracy.left_out_points} points (1 Unclassified: 50)" in text
    assert (
        "Points given a class that is not compared, which count as errors: 30 (1 Unclassified)."
        in text
    )
    assert "nan" not in text.lower().replace("national", "")


@pytest.mark.parametrize(
    "a",
    [
        Accuracy.from_labels([6, 6], [6, 6]),  # one class, all right
        Accuracy.from_labels([2, 6], [2, 2], classes=[2, 6, 17], reliability=[1, 0]),
        Accuracy.from_labels(np.arange(40), np.arange(40)[::-1], names={3: "<i>"}),
    ],
)
def test_odd_accuracies_make_a_page(a):
    page = Page(accuracy_page(a))
    assert percent(a.overall_accuracy, 1) in page.text
    assert "nan" not in page.text.lower()


# ---- maps ------------------------------------------------------------------------------------------------


def embedded(text):
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', text)
    return [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data, validate=True))).convert("RGB"))
        for data in images
    ]


def test_error_map_shows_the_errors(full):
    reference, prediction, errors = embedded(full)[:3]
    assert reference.shape == prediction.shape == errors.shape
    red = (errors[..., 0] > 2 * errors[..., 1].astype(int) + 20) & (errors[..., 0] > 100)
    rows, columns = np.nonzero(red)
    scale = errors.shape[1] / 60
    # The wrong strip lies at x 12..28, y 11..13; 30 rejected points lie anywhere.
    inside = (columns / scale > 11.5) & (columns / scale < 28.5)
    inside &= (40 - rows / scale > 10.5) & (40 - rows / scale < 13.5)
    assert inside.mean() > 0.7
    differs = (np.abs(reference.astype(int) - prediction) > 40).any(
        axis=2
    )  # each has a palette of its own
    assert red[differs].mean() > 0.5


@pytest.mark.parametrize(
    ("xyz", "maps"),
    [
        ([[1.0, 2.0, 3.0]], 0),
        ([[0.0, 0.0, 0.0], [10.0, 0.0, 1.0], [20.0, 0.0, 2.0]], 0),  # in a line
        ([[0.0, 0.0, 0.0], [0.001, 0.0, 500.0], [0.0, 0.001, 900.0]], 3),  # a spike
        ([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0], [0.0, 10.0, 0.0]], 3),  # a strip
    ],
)
def test_degenerate_clouds(xyz, maps):
    reference = np.full(len(xyz), 2)
    predicted = reference.copy()
    predicted[-1] = 6
    a = Accuracy.from_labels(reference, predicted)
    page = Page(accuracy_page(a, places=[Place("", xyz, reference, predicted)]))
    assert len([i for i in page.all("img") if i["alt"].startswith("Map")]) == maps
    assert ("No map: " in page.text) == (maps == 0)
