"""`--keep-sure`: limits that follow from what was right on ground held out, and points below them left unclassified."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.base.errors import ModelError, OptionError
from pdal_stages.classifier.calibration import (
    BINS,
    Calibration,
    calibrate_on_base,
    read_calibration,
)
from pdal_stages.classifier.model_file import find
from pdal_stages.cli import main
from pdal_stages.pipeline.classify_request import ClassifyRequest


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 300), st.sampled_from([0.5, 0.8, 0.95, 0.99]))
def test_limits_are_the_lowest_that_hold(seed, n, accuracy):
    random = np.random.default_rng(seed)
    given_, true = random.choice([2, 6], (2, n))
    reliability = np.round(random.random(n), 3)
    known = Calibration()
    half = n // 2  # counted in parts
    known.add(given_[:half], true[:half], reliability[:half])
    known.add(given_[half:], true[half:], reliability[half:])
    bins = np.minimum(np.floor(reliability * BINS), BINS - 1)
    for code, limit in known.limits(accuracy).classes.items():
        inside = given_ == code
        shares = {}
        for k in range(BINS):
            kept = inside & (bins >= k)
            if kept.any():
                shares[k] = float((true[kept] == code).mean())
        good = [k for k, share in shares.items() if share >= accuracy - 1e-12]
        if good:
            assert limit.reliability == min(good) / BINS
            assert np.isclose(limit.kept, (inside & (bins >= min(good))).sum() / inside.sum())
            assert np.isclose(limit.accuracy, shares[min(good)])
        else:
            assert limit.reliability > 1 and limit.kept == 0
            assert np.isclose(limit.accuracy, max(shares.values()))
    again = Calibration.from_dict(json.loads(json.dumps(known.to_dict())))
    assert again.limits(accuracy) == known.limits(accuracy)
    assert 0 <= known.limits(accuracy).kept <= 1


def test_what_is_damaged_or_not_there_is_refused(tmp_path):
    for wrong in ({}, {"about": "", "classes": {"2": {"right": [1], "wrong": [1]}}}):
        with pytest.raises(ModelError):
            Calibration.from_dict(wrong)
    with pytest.raises(OptionError, match="never scored on ground"):
        read_calibration({}, str(tmp_path / "m.model"))
    for text in (b"{", b"\xff", b"[]"):
        (tmp_path / "m.calibration.json").write_bytes(text)
        with pytest.raises(ModelError, match="damaged"):
            read_calibration({}, str(tmp_path / "m.model"))


def test_the_shipped_model_says_what_it_costs():
    lines = ClassifyRequest(classifier_options={"keep_sure": 0.95}).cost
    assert lines[0].startswith("to be right in 95 % of the points of each class, about ")
    assert any("6 Building" in line for line in lines) and ClassifyRequest().cost == []
    known = Calibration()
    known.add(np.array([6, 6]), np.array([6, 2]), np.array([0.9, 0.9]))
    line = known.limits(0.9).describe_cost({})[1]
    assert "no point keeps it" in line
    assert "50.0 % of the most reliable were right" in line
    # Of corrections on top of a base: what is known of the base, and of new classes alone what they say: here as many
    # points of 17 as of the base's classes.
    counts = known.to_dict()["classes"]["6"]
    ours = {"about": "", "classes": {"6": counts, "17": counts}}
    standard = calibrate_on_base({}, {}, find("standard"))
    joined = calibrate_on_base(ours, {}, find("standard"))
    assert joined["about"] == standard["about"] and standard["about"].startswith("its base (")
    assert {code: joined["classes"][code] for code in standard["classes"]} == standard["classes"]
    both = Calibration.from_dict(joined)
    assert np.isclose(both.points([17]), both.points([2, 5, 6, 14]), rtol=1e-3)
    assert calibrate_on_base(ours, {}, "nowhere.model") == ours


def blocks(seed, n=6000):
    """Two classes that overlap in height, so that a forest is unsure of some."""
    random = np.random.default_rng(seed)
    xyz = random.random((n, 3)) * [200, 200, 0]
    label = np.where((xyz[:, 0] // 20 + xyz[:, 1] // 20) % 2 > 0, 6, 2).astype(np.uint8)
    xyz[:, 2] = np.where(label == 6, 2.0, 0.0) + random.normal(0, 1.2, n)
    return xyz, label


def test_a_model_knows_from_cross_validation_how_sure_it_must_be():
    xyz, label = blocks(0)
    options = TrainingOptions("k6", "HeightRange", trees=20, count=1500, passes=1)
    heights = {"HeightAboveGround": xyz[:, 2]}
    model = train([TrainingCloud(xyz, label, heights)], options, progress=False)
    known = Calibration.from_dict(model.info["sureness"])
    assert "held out" in known.about and set(known.right) == {2, 6}
    # As many as the labels, not as the samples.
    assert np.isclose(
        sum((known.right[c] + known.wrong[c]).sum() for c in (2, 6)), len(xyz), rtol=0.02
    )
    limits = known.limits(0.9)
    other, truth = blocks(1)
    heights = {"HeightAboveGround": other[:, 2]}
    prediction = model.predict(other, heights, limits=limits, rejected_code=1)
    plain = model.predict(other, heights)
    kept = prediction.classification != 1
    assert 0 < len(prediction.unsure) == np.count_nonzero(~kept) < len(other)
    assert np.array_equal(prediction.classification[kept], plain.classification[kept])
    for code in (2, 6):
        inside = kept & (prediction.classification == code)
        all_ = plain.classification == code
        assert (truth[inside] == code).mean() > 0.87 > (truth[all_] == code).mean() - 0.02
        assert (plain.reliability[all_ & ~kept] < limits.classes[code].reliability).all()


@pytest.mark.pdal
def test_classify_keeps_only_what_is_sure_in_tiles_too(ready_town, tmp_path, capsys):
    """What is rejected is counted once, not with each tile's surroundings again."""
    source = str(ready_town)
    counted = []
    for target, *words in (["whole.laz"], ["tiles", "--tile", "30", "--workers", "0"]):
        words = ["classify", source, str(tmp_path / target), *words, "--keep-sure", "0.98"]
        assert main(words) == 0
        text = capsys.readouterr()
        assert "expected to become class 1" in text.err
        (line,) = (line for line in text.out.splitlines() if "rejected as unreliable" in line)
        counted.append(int(line.split()[-1].replace(",", "")))
    las = laspy.read(tmp_path / "whole.laz")
    rejected = np.asarray(las.classification) == 1
    assert (tmp_path / "tiles/town.laz").read_bytes() == (tmp_path / "whole.laz").read_bytes()
    assert counted == [np.count_nonzero(rejected)] * 2 and counted[0] > 0
    assert np.asarray(las["Reliability"])[rejected].max() < 1.0
    assert main(["classify", source, str(tmp_path / "o.laz"), "--keep-sure", "1.5"]) == 1
