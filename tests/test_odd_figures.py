"""Figures that mean nothing: sides of voxels and units of 1e-300, no memory, labels of another number."""

from __future__ import annotations

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.base.units import units_of_wkt
from pdal_stages.classifier.deciding import PredictionOptions
from pdal_stages.classifier.estimator import PointClassifier

LOCAL = 'LOCAL_CS["here",UNIT["odd",{}]]'


@pytest.mark.parametrize("side", [1e-300, 1e-6, -1.0, 6.0])
def test_voxels(side):
    with pytest.raises(OptionError, match="voxel"):
        ps.TrainingOptions(voxel=side)
    with pytest.raises(StageError, match="voxel"):
        ps.Filter.multiscalefeatures(voxel=side)


def test_voxels_there_are():
    for side in (0, 0.001, 5.0):
        assert ps.TrainingOptions(voxel=side).voxel == side


@pytest.mark.parametrize("unit", ["1e-300", "1e300", "0.0000001"])
def test_units(unit):
    with pytest.raises(StageError, match="unit of length"):
        units_of_wkt(LOCAL.format(unit))
    assert units_of_wkt(LOCAL.format(unit), horizontal="foot", vertical="foot").horizontal == 0.3048


@pytest.mark.parametrize("unit", [0.0254, 0.001, 1609.344])
def test_units_there_are(unit):
    assert units_of_wkt(LOCAL.format(unit)).horizontal == unit


@pytest.mark.parametrize("memory", [0, -5, float("nan")])
def test_memory(memory):
    with pytest.raises(OptionError, match="memory_mb"):
        PredictionOptions(memory_mb=memory)


def test_the_estimator_says_what_is_wrong():
    xyz = np.random.default_rng(0).uniform(0, 9, (50, 3))
    with pytest.raises(OptionError, match="one label for each of the 50 points"):
        PointClassifier().fit(xyz, np.zeros(49, int))
    with pytest.raises(OptionError, match="'options' must be TrainingOptions"):
        PointClassifier(options=5).fit(xyz, np.zeros(50, int))
