"""What a model file may ask to be run before it: stages of a short list, options in bounds, never a path."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import ModelError
from pdal_stages.stages.preprocessing import PDAL_OPTIONS, check, same
from pdal_stages.stages.registry import stage_types

HAG = {"type": "filters.hag_morphological"}
#: Kinds of options that hold a path, or more than a model may say.
_PATHS = ("filename", "mapping", "string")


CARRIED = {name: kind.in_models for name, kind in stage_types().items() if kind.in_models} | {
    name: tuple(entry.name for entry in options) for name, options in PDAL_OPTIONS.items()
}


def test_no_option_that_holds_a_path_is_carried():
    for kind in stage_types().values():
        declared = {entry.name: entry.kind for entry in kind.all_options()}
        assert not any(declared[name] in _PATHS for name in kind.in_models), kind.type
        assert not {"threads", "horizontal_unit", "vertical_unit"} & set(kind.in_models)
        assert not (kind.in_models and "filename" in declared.values()), kind.type


def test_one_spelling():
    known = {
        **HAG,
        "cell": "2.0",
        "ground": "TRUE",
        "openings": "5, 17",
        "ignore": "7,Withheld[1:1]",
    }
    assert check([known]) == [
        {**HAG, "cell": 2, "ground": True, "openings": [5, 17], "ignore": ["7", "Withheld[1:1]"]}
    ]
    assert same(
        [known],
        [{**HAG, "cell": 2, "ground": True, "openings": [5, 17], "ignore": [7, "Withheld[1:1]"]}],
    )
    assert check(check([known])) == check([known])
    bracket = {**HAG, "ignore": "7,Z[0:2)"}
    assert check(check([bracket]))[0]["ignore"] == ["7", "Z[0:2)"]


@pytest.mark.parametrize(
    ("stage", "says"),
    [
        ({"type": "filters.python", "source": "x"}, "filters.python"),
        ({"type": "filters.multiscalefeatures"}, "filters.multiscalefeatures"),
        ({"type": "filters.modelclassifier", "model": "x"}, "filters.modelclassifier"),
        ({"type": "filters.smrf", "dir": "/tmp"}, "'dir'"),
        ({"type": "filters.smrf", "where": "Z > 1"}, "'where'"),
        ({"type": "filters.smrf", "ignore": "/etc/passwd"}, "'ignore'"),
        ({"type": "filters.smrf", "cell": 1e-9}, "0.2 to 100"),
        ({"type": "filters.hag_nn", "count": 1.5}, "whole number"),
        ({**HAG, "cell": 1e-9}, "0.05 to 1000"),
        ({**HAG, "cell": True}, "must be a number"),
        ({**HAG, "cell": 10**400}, "must be a number"),
        ({**HAG, "option_file": "/etc/passwd"}, "'option_file'"),
        ({**HAG, "horizontal_unit": "foot"}, "'horizontal_unit'"),
        ({**HAG, "cell": "1;2"}, "'cell'"),
        ({**HAG, "openings": [5] * 1000}, "2000 characters"),
        ({**HAG, "openings": [[5]]}, "'openings'"),
        ({**HAG, "where": "__import__('os')"}, "'where'"),
        ({**HAG, "where": "Z > 1" + " && Z > 1" * 1000}, "2000 characters"),
        ({**HAG, "cell": 0.2, "window": 1000}, "cells"),
        ({"type": "filters.hag_minima", "cell": 5, "resolution": 10}, "resolution"),
    ],
)
def test_what_is_not_carried_is_refused_by_name(stage, says):
    with pytest.raises(ModelError) as caught:
        check([HAG, stage])
    assert says in str(caught.value)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=True) | st.text(max_size=20),
    lambda inside: (
        st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=8), inside, max_size=3)
    ),
    max_leaves=8,
)
_KINDS = [*stage_types(), *PDAL_OPTIONS, "filters.python", "filters.stats", "filters.head"]
_OTHERS = ("log", "dir", "source", "json", "user_data", "tag")
_NAMES = [*{name for names in CARRIED.values() for name in names}, *_OTHERS]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.builds(
            lambda kind, options: {**options, "type": kind},
            st.sampled_from(_KINDS),
            st.dictionaries(st.sampled_from(_NAMES), _JSON, max_size=4),
        ),
        max_size=9,
    )
)
def test_whatever_passes_is_harmless(stages):
    """Random preparations are refused, or hold known stages, rules' options, and no text that could be a path."""
    try:
        passed = check(stages)
    except ModelError as error:
        assert len(str(error)) < 1000
        return
    assert check(passed) == passed
    for stage in passed:
        assert set(stage) - {"type"} <= set(CARRIED[stage["type"]])
        text = json.dumps({k: v for k, v in stage.items() if k not in ("type", "where")})
        assert "/" not in text and "\\" not in text
