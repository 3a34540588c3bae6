"""Figures that mean nothing: sides of voxels, no memory, labels of another number, coordinates that are none."""

from __future__ import annotations

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.classifier.prediction import PredictionOptions


def test_figures_that_mean_nothing():
    for side in (1e-300, 1e-6, -1.0, 6.0):
        with pytest.raises(OptionError, match="voxel"):
            ps.TrainingOptions(voxel=side)
    for side in (0, 0.001, 5.0):
        assert ps.TrainingOptions(voxel=side).voxel == side
    for memory in (0, -5, float("nan")):
        with pytest.raises(OptionError, match="memory_mb"):
            PredictionOptions(memory_mb=memory)


def test_labels_of_another_number_of_points():
    xyz = np.random.default_rng(0).uniform(0, 9, (50, 3))
    with pytest.raises(OptionError, match="one label per point"):
        ps.train(xyz, np.zeros(49, int), progress=False)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300])
def test_a_coordinate_that_is_none(wrong):
    xyz = np.random.default_rng(0).uniform(0, 9, (200, 3))
    labels = np.where(xyz[:, 2] > 4, 6, 2)
    options = ps.TrainingOptions(
        neighborhoods="k5", dimensions=(), count=20, trees=2, passes=1, folds=0
    )
    model = ps.train(xyz, labels, options, dimensions={}, progress=False)
    xyz[7, 0] = wrong
    for call in (
        lambda: model.predict(xyz),
        lambda: ps.train(xyz, labels, options, dimensions={}, progress=False),
        lambda: ps.train([ps.TrainingCloud(xyz, labels)], options, progress=False),
    ):
        with pytest.raises(StageError, match="1 of 200 points"):
            call()
    with pytest.raises(StageError, match="shape"):
        model.predict(xyz[:, :2])
