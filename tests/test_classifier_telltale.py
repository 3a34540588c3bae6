"""Dimensions that say the class by themselves are told of; honest ones are not."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.telltale import Labels, telltale


def sample(n=4000, seed=0):
    random = np.random.default_rng(seed)
    known = random.integers(-1, 3, n).astype(np.int16)
    return known, random


def told(dimensions, known):
    xyz = np.random.default_rng(1).random((len(known), 3))
    return telltale([Labels("cloud", xyz, dimensions, known)])


def test_copies_of_the_label_are_found():
    known, random = sample()
    dimensions = {
        "Copy": np.array([7, 2, 6, 5])[known],
        "Half": (known == 1).astype(np.uint8),
        "Noisy": known + random.normal(0, 0.05, len(known)),
        "Intensity": random.integers(0, 1000, len(known)),
        "HeightAboveGround": known.astype(float),
        "Odd": np.where(known == 0, np.nan, known),
    }
    assert set(told(dimensions, known)) == {"Copy", "Noisy", "Odd"}


def test_hints_are_not():
    """A dimension that tells nine in ten, one that numbers the points, and one that is constant."""
    known, random = sample()
    mostly = np.where(random.random(len(known)) < 0.9, known, random.integers(0, 3, len(known)))
    assert told({"Mostly": mostly, "Row": np.arange(len(known)), "One": known * 0}, known) == {}


def test_few_points_and_one_class_say_nothing():
    known, _ = sample(16)
    assert told({"Copy": known}, known) == {}
    assert told({"Copy": np.zeros(100)}, np.zeros(100, np.int16)) == {}
    assert telltale([]) == {}


def test_neither_order_nor_parts_matter():
    known, random = sample()
    xyz = random.random((len(known), 3))
    dimensions = {"Noisy": known + random.normal(0, 0.2, len(known)), "Copy": known}
    found = telltale([Labels("cloud", xyz, dimensions, known)])
    assert 0.98 <= found["Noisy"] < 1.0 == found["Copy"]
    for rows in (random.permutation(len(known)), np.argsort(xyz[:, 0])):
        parts = np.array_split(rows, 3)
        cut = [
            Labels("cloud", xyz[part], {name: v[part] for name, v in dimensions.items()}, known[part])
            for part in parts
        ]
        assert telltale(cut) == found


@pytest.mark.parametrize("copied", [True, False])
def test_the_model_says_it(copied):
    random = np.random.default_rng(3)
    xyz = random.random((3000, 3)) * (40, 40, 3)
    labels = np.where(xyz[:, 2] > 1.5, 6, 2)
    extra = labels if copied else random.integers(0, 9, len(labels))
    options = TrainingOptions(
        neighborhoods="c1",
        feature_set="covariance",
        dimensions=("Extra",),
        count=100,
        trees=3,
        passes=1,
        folds=0,
    )
    model = train([TrainingCloud(xyz, labels, {"Extra": extra})], options, progress=False)
    assert ("telltale" in model.info["training"]) == copied
