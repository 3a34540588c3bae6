"""Labels to classes: lists, renaming, merging, dropping, binary; and options checked before any work."""

import numpy as np
import pytest

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.class_map import ClassMap
from pdal_stages.classifier.training_options import TrainingOptions


def test_default_takes_every_label_that_names_a_kind_of_object():
    classes = ClassMap.parse(None, [0, 1, 2, 5, 6, 7, 9, 12, 18, 64])
    assert classes.codes == (2, 5, 6, 9, 64)
    assert classes.names[:3] == ("Ground", "High vegetation", "Building")


@pytest.mark.parametrize("spec", [[2, 1, 6], "2,1,6", ["2", "1", "6"], (1, 2, 6), "1-2,6"])
def test_lists(spec):
    assert ClassMap.parse(spec).codes == (1, 2, 6)


@pytest.mark.parametrize("value", ["5 Vegetation", "5: Vegetation", "5=Vegetation"])
def test_mapping_merges_renames_and_drops(value):
    classes = ClassMap.parse({"2": "Ground", "3-4,5": value, 6: 6})
    assert classes.codes == (2, 5, 6)
    assert classes.names == ("Ground", "Vegetation", "Building")
    assert classes.labels == ((2,), (3, 4, 5), (6,))
    assert classes.index(np.array([2, 3, 5, 6, 9, 200])).tolist() == [0, 1, 1, 2, -1, -1]


def test_two_labels_may_become_one_class():
    classes = ClassMap.parse({"100": "6 Building", "101": "6", "2": 2})
    assert classes.codes == (2, 6) and classes.labels == ((2,), (100, 101))
    assert classes.names[1] == "Building"


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({"3,4": "Shrubbery"}, "its code too"),
        ({"3,4": 5, "4": 6}, "twice"),
        ({"x": 5}, "not a list of labels"),
        ({"5-3": 5}, "range"),
        ({"2": 256}, "0 to 255"),
        ([True, 2], "whole number"),
        ("{", "list of labels"),
        (7, "list or a mapping"),
    ],
)
def test_mistakes(spec, text):
    with pytest.raises(OptionError, match=text):
        ClassMap.parse(spec)


def test_labels_above_a_byte_need_a_mapping():
    with pytest.raises(OptionError, match="0 to 255"):
        ClassMap.parse(None, [2, 1004])


def test_binary():
    classes = ClassMap.parse({"2": 2, "3,4,5": 5, "6": 6}).binary(6)
    assert classes.codes == (1, 6) and classes.labels == ((2, 3, 4, 5), (6,))
    assert classes.names == ("Background", "Building")
    for known, target in ((classes, 9), (ClassMap.parse([1, 6]), 1), (ClassMap.parse([6]), 6)):
        with pytest.raises(OptionError, match="must be one of several classes"):
            known.binary(target)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"count": 0}, "count"),
        ({"seed": -1}, "seed"),
        ({"max_samples": 0}, "max_samples"),
        ({"max_features": "all"}, "max_features"),
        ({"threads": -1}, "threads"),
        ({"dimensions": [3]}, "dimensions"),
    ],
)
def test_options_are_checked(options, text):
    with pytest.raises(OptionError, match=text):
        TrainingOptions(**options)
