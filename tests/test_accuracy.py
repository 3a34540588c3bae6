"""Accuracy measures against scikit-learn, their algebra, and every way to misuse them."""

from __future__ import annotations

import json
import warnings
from importlib.resources import files

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sklearn import metrics

from pdal_stages.accuracy.measures import CHUNK, Accuracy
from pdal_stages.base.errors import StageError

SCHEMA = json.loads(files("pdal_stages").joinpath("accuracy/accuracy-1.json").read_text())
CODES = (0, 1, 2, 5, 6, 64, 255)


def labels(n):
    return hnp.arrays(np.uint8, n, elements=st.sampled_from(CODES))


@st.composite
def label_pairs(draw, smallest=1):
    n = draw(st.integers(smallest, 60))
    return draw(labels(n)), draw(labels(n))


def town(n=5000, seed=1):
    """Labels with mistakes, a rejected class, a reliability that means something."""
    rng = np.random.default_rng(seed)
    reference = rng.choice([2, 3, 5, 6], n, p=[0.5, 0.05, 0.2, 0.25])
    reliability = rng.uniform(0.4, 1, n)
    wrong = rng.random(n) > reliability
    predicted = np.where(wrong, rng.choice([2, 3, 5, 6], n), reference)
    predicted[reliability < 0.45] = 1
    return reference, predicted, reliability


# ---- against the oracle ----------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(label_pairs())
def test_all_measures_equal_scikit_learn(pair):
    reference, predicted = pair
    a = Accuracy.from_labels(reference, predicted, ignore=())
    present = sorted(set(reference.tolist()))
    everything = present + sorted(set(predicted.tolist()) - set(present))
    assert list(a.classes) == present
    assert list(a.columns) == everything
    full = metrics.confusion_matrix(reference, predicted, labels=everything)
    np.testing.assert_array_equal(a.matrix, full[: len(present)])
    assert not full[len(present) :].any()

    assert a.overall_accuracy == pytest.approx(metrics.accuracy_score(reference, predicted))
    p, r, f, n = metrics.precision_recall_fscore_support(
        reference, predicted, labels=present, zero_division=0.0
    )
    iou = metrics.jaccard_score(
        reference, predicted, labels=present, average=None, zero_division=0.0
    )
    np.testing.assert_allclose(list(a.precision.values()), p)
    np.testing.assert_allclose(list(a.recall.values()), r)
    np.testing.assert_allclose(list(a.f1.values()), f)
    np.testing.assert_allclose(list(a.iou.values()), iou)
    assert list(a.support.values()) == n.tolist()
    assert a.mean_class_precision == pytest.approx(p.mean())
    assert a.mean_class_recall == pytest.approx(r.mean())
    assert a.mean_f1 == pytest.approx(f.mean())
    assert a.mean_iou == pytest.approx(iou.mean())
    if len(everything) == 1:
        assert a.kappa is None  # chance agrees on everything
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert a.kappa == pytest.approx(
                metrics.cohen_kappa_score(reference, predicted), abs=1e-12
            )
    np.testing.assert_allclose(
        a.by_reference,
        metrics.confusion_matrix(reference, predicted, labels=everything, normalize="true")[
            : len(present)
        ],
    )


def test_reliability_is_graded_by_tenths():
    reference, predicted, reliability = town()
    right = reference == predicted
    g = Accuracy.from_labels(reference, predicted, reliability=reliability).reliability
    inside = np.digitize(reliability, np.arange(1, 10) / 10)
    error = sum(
        abs(reliability[inside == b].mean() - right[inside == b].mean()) * (inside == b).mean()
        for b in range(10)
        if (inside == b).any()
    )
    assert g.expected_calibration_error() == pytest.approx(error, abs=1e-12)
    assert g.mean == pytest.approx(reliability.mean())


# ---- properties ------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(label_pairs(2), st.integers(0, 60), st.sampled_from([(), (1,), (0, 1, 5)]))
def test_tiles_add_to_the_whole(pair, cut, ignore):
    reference, predicted = pair
    reliability = np.linspace(0, 1, len(reference))
    cut = min(cut, len(reference))

    def compare(part):
        return Accuracy.from_labels(
            reference[part],
            predicted[part],
            ignore=ignore,
            reliability=reliability[part],
            allow_empty=True,
        )

    whole, tiles = compare(slice(None)), sum([compare(slice(cut)), compare(slice(cut, None))])
    assert (whole.classes, whole.extra, whole.left_out) == (
        tiles.classes,
        tiles.extra,
        tiles.left_out,
    )
    np.testing.assert_array_equal(whole.matrix, tiles.matrix)
    np.testing.assert_array_equal(whole.reliability.count, tiles.reliability.count)
    np.testing.assert_allclose(whole.reliability.total, tiles.reliability.total)
    if whole.points:
        assert whole.table() == tiles.table()


@settings(max_examples=10, deadline=None)
@given(label_pairs())
def test_json_fits_the_schema_and_has_no_nan(pair):
    reference, predicted = pair
    confidence = np.linspace(1, 0, len(reference))
    a = Accuracy.from_labels(
        reference,
        predicted,
        classes=[*set(reference.tolist()), 17],
        reliability=confidence,
    )
    d = json.loads(json.dumps(a.to_dict(), allow_nan=False))
    jsonschema.validate(d, SCHEMA)
    assert sum(map(sum, d["confusion"]["counts"])) == d["points"]
    a.table()


# ---- rules -----------------------------------------------------------------------------------------------


def test_rejected_points_count_as_errors_in_a_column_of_their_own():
    a = Accuracy.from_labels([2, 2, 6, 6], [2, 1, 6, 6])
    assert (a.classes, a.extra, a.extra_points) == ((2, 6), (1,), 1)
    assert a.overall_accuracy == 0.75
    assert a.recall == {2: 0.5, 6: 1.0}
    assert a.precision == {2: 1.0, 6: 1.0}
    assert "Outside the classes" in a.table()
    assert "1*" in a.table()


def test_absent_classes_are_left_out_of_the_means():
    a = Accuracy.from_labels([2, 2, 2, 6], [2, 2, 9, 2], classes=[2, 6, 9, 17])
    assert a.classes == (2, 6, 9, 17)
    assert a.recall == {2: 2 / 3, 6: 0.0, 9: None, 17: None}
    assert a.precision == {2: 2 / 3, 6: 0.0, 9: 0.0, 17: None}
    assert a.mean_class_recall == pytest.approx(1 / 3)
    assert a.f1[17] is None


def test_what_training_leaves_out_is_not_scored():
    reference = [0, 1, 7, 12, 18, 2, 6]
    a = Accuracy.from_labels(reference, [2] * 7)
    assert a.left_out == {0: 1, 1: 1, 7: 1, 12: 1, 18: 1}
    assert a.classes == (2, 6)
    assert Accuracy.from_labels(reference, [2] * 7, ignore=[]).points == 7
    assert Accuracy.from_labels(reference, [2] * 7, classes=[1, 6]).classes == (1, 6)


def test_classes_merged_into_an_ignored_code_are_scored():
    """The background of a binary model is 1, whose own points are unclassified: its precision came out as 100 %."""
    reference, predicted = [1, 2, 5, 5, 6, 6], [6, 1, 1, 6, 6, 1]
    a = Accuracy.from_labels(reference, predicted, merge={1: [2, 5]})
    assert a.left_out == {1: 1}
    assert a.precision == {1: 2 / 3, 6: 0.5}
    assert a.recall == {1: 2 / 3, 6: 0.5}
    assert sum([a, a]).to_dict()["left_out"] == {"points": 2, "by_class": {"1": 2}}


def test_merged_classes_get_a_name_that_says_so():
    a = Accuracy.from_labels([3, 4, 5, 6], [4, 5, 3, 6], merge={5: [3, 4]})
    assert a.overall_accuracy == 1
    assert a.name(5) == "Vegetation"
    assert a.name(6) == "Building"
    assert a.to_dict()["merged"] == {"3": 5, "4": 5}
    assert "Merged                3 as 5, 4 as 5" in a.table()
    b = Accuracy.from_labels([3, 4], [3, 4], merge={"100": ["3", "4"]}, names={100: "Vegetation"})
    assert b.name(100) == "Vegetation"


def test_more_points_than_one_chunk():
    sides = town(CHUNK + 2000)

    def compare(part):
        reference, predicted, reliability = (values[part] for values in sides)
        return Accuracy.from_labels(reference, predicted, reliability=reliability)

    whole, parts = compare(slice(None)), compare(slice(5000)) + compare(slice(5000, None))
    np.testing.assert_array_equal(whole.matrix, parts.matrix)
    assert whole.table() == parts.table()


# ---- misuse ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reference": [], "predicted": []}, "no point to compare.*0 points"),
        (
            {"reference": [1, 1], "predicted": [2, 2], "ignore": [1]},
            "every reference point is left out.*class 1: 2",
        ),
        ({"reference": [2, 6], "predicted": [2]}, "a different length.*1 and 2"),
        (
            {"reference": [2, 6], "predicted": [2, 6], "reliability": [1.0]},
            "reliability has a different length",
        ),
        ({"reference": [2.0, np.nan], "predicted": [2, 2]}, "not class codes.*nan"),
        (
            {"reference": [2], "predicted": [2], "classes": ["ground"]},
            "a class in 'classes'.*'ground'",
        ),
        (
            {"reference": [2], "predicted": [2], "merge": {5: [3], 6: [3]}},
            "to two others.*class 3 to 5 and 6",
        ),
        ({"reference": [2], "predicted": [2], "merge": {3: 5}}, "list of classes.*5"),
        ({"reference": [2], "predicted": [2], "reliability": [87.0]}, "not between 0 and 1.*87"),
        (
            {"reference": np.arange(300), "predicted": np.zeros(300, int)},
            "too many different values.*300",
        ),
    ],
)
def test_misuse_is_told(arguments, message):
    with pytest.raises(StageError, match=message):
        Accuracy.from_labels(**arguments)


def test_an_empty_tile_adds_but_has_no_figures():
    empty = Accuracy.from_labels([], [], allow_empty=True)
    assert empty.points == 0
    with pytest.raises(StageError, match="no point was compared"):
        _ = empty.overall_accuracy
    full = Accuracy.from_labels([2, 6], [2, 2], reliability=[0.5, 0.6])
    assert (empty + full).to_dict() == full.to_dict()
