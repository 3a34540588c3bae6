"""Clouds in tiles: the forests trained on them are those of the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.train_forest import SHORT
from pdal_stages.classifier.training import reach
from pdal_stages.classifier.training_clouds import TiledCloud

QUICK = {"count": 120, "trees": 4, "threads": 1, "voxel": 0.25, "dimensions": ("Intensity",)}


def scene(n=6000, size=60.0, seed=0, **more):
    """Ground and boxes on it, noise above, strays; some of the labels are not to be used."""
    random = np.random.default_rng(seed)
    xy = random.random((n, 2)) * size + (1000.0, -20.0)
    roof = ((xy // 7).sum(axis=1) % 3) == 0
    z = np.where(roof, 5.0, 0.0) + random.normal(0, 0.05, n)
    labels = np.where(roof, 6, 2)
    bush = random.random(n) < 0.15
    z, labels = z + bush * random.random(n) * 3, np.where(bush, 5, labels)
    noise = random.random(n) < 0.01
    z, labels = np.where(noise, 60.0, z), np.where(noise, 7, labels)
    labels = np.where(random.random(n) < 0.05, 1, labels)
    xyz = np.column_stack([xy, z])
    dimensions = {
        "Intensity": random.integers(0, 99, n).astype(np.uint16),
        "Flight": (xy[:, 0] // 20).astype(int),
    }
    return TrainingCloud(xyz, labels, dimensions, "scene", **more)


def cut(cloud, side, folder, seed=1):
    """The cloud in squares, the points of each in any order."""
    tiles = TiledCloud(folder, side)
    place = np.floor(cloud.xyz[:, :2] / side).astype(int)
    random = np.random.default_rng(seed)
    for tile in np.unique(place, axis=0):
        rows = random.permutation(np.flatnonzero((place == tile).all(axis=1)))
        tiles.put(tuple(tile.tolist()), replace(cloud.part(rows), survey=""))
    return tiles


def same_forests(cloud, options, side, folder):
    """Trains on the whole and on tiles."""
    whole = train([cloud], options, progress=False)
    each = cut(cloud, side, folder / "raw").clouds(reach(options))
    tiles = train(each, options, progress=False)
    assert not (folder / "raw").exists()
    assert tiles.info["classes"] == whole.info["classes"]
    assert tiles.info["training"]["clouds"] == whole.info["training"]["clouds"]
    for first, other in zip(tiles.passes, whole.passes, strict=True):
        for name, array in first.arrays().items():
            assert np.array_equal(array, other.arrays()[name]), name
    assert tiles.info["densities"]["low"] == pytest.approx(whole.info["densities"]["low"], rel=0.3)


@pytest.mark.parametrize("side", [25.0, 1000.0])
def test_defaults(tmp_path, side):
    same_forests(scene(), TrainingOptions(**QUICK), side, tmp_path)


@pytest.mark.parametrize(
    "more",
    [
        {"passes": 3, "context": ("own", "box2"), "voxel": 0.9},
        {"target": 6, "classes": {"2": 2, "5": 5, "6": 6}},
    ],
    ids=["three", "binary"],
)
def test_other_options(tmp_path, more):
    cloud = scene()
    random = np.random.default_rng(5)
    number = random.integers(1, 4, len(cloud)).astype(np.uint8)
    returns = {"ReturnNumber": number, "NumberOfReturns": np.maximum(number, 2)}
    cloud = replace(
        cloud, dimensions={**cloud.dimensions, **returns}, mask=random.random(6000) < 0.8
    )
    same_forests(cloud, TrainingOptions(**{**QUICK, **more}), 17.0, tmp_path)


def test_neighbors_beyond_the_halo_are_counted(tmp_path):
    """At one point on 40 m2 the fifty nearest lie 25 m around."""
    options = TrainingOptions(**{**QUICK, "neighborhoods": "k50", "thin": 0.01})
    model = train(
        cut(scene(900, 190.0), 21.0, tmp_path / "raw").clouds(reach(options)),
        options,
        progress=False,
    )
    assert model.info["training"][SHORT] > 0
