"""Labels of the surveys that the shipped model is trained on."""

import importlib.util
import sys
from pathlib import Path

import numpy as np

SURVEYS = Path(__file__).resolve().parent.parent / "benchmarks" / "surveys"


def test_shrubs_are_low_and_let_pulses_through(monkeypatch):
    monkeypatch.syspath_prepend(str(SURVEYS))
    # By its path: another folder of benchmarks has a module of this name.
    spec = importlib.util.spec_from_file_location("survey_clouds", SURVEYS / "clouds.py")
    clouds = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, clouds)
    spec.loader.exec_module(clouds)
    rules = clouds.SHRUB_RULES
    side = 10 * rules.radius
    kinds = [
        ("shrub", 2, 0.5),
        ("car", 1, 0.5),
        ("crown", 2, 1.5),
        ("grass", 2, 0.2),
        ("hut", 2, 0.5),
    ]
    each = np.repeat(np.arange(len(kinds)), 20)
    xyz = np.stack([side * each, np.zeros(len(each)), np.zeros(len(each))], axis=1)
    returns = np.array([of for _, of, _ in kinds])[each]
    height = np.array([2 * rules.high * share for _, _, share in kinds])[each] * 0.75
    dimensions = {"HeightAboveGround": height, "NumberOfReturns": returns}
    none = np.zeros(len(each), np.uint8)
    cloud = clouds.Cloud("", "", xyz, none, none, dimensions)
    rows = clouds.find_shrubs(cloud, np.array([name != "hut" for name, _, _ in kinds])[each])
    assert {kinds[number][0] for number in each[rows]} == {"shrub"} and len(rows) == 20
