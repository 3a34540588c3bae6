"""`where` expressions, checked against PDAL's own evaluation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import DimensionError, OptionError
from pdal_stages.stages.where import Expression

ARRAYS = {
    "X": np.array([0.0, 1.0, 2.0, 3.0]),
    "Z": np.array([5.0, -1.0, 2.5, 8.0]),
    "Classification": np.array([2, 2, 6, 5], np.uint8),
}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Classification == 2", [1, 1, 0, 0]),
        ("Classification==2&&Z>0", [1, 0, 0, 0]),
        ("!(Classification == 2) || Z < 0", [0, 1, 1, 1]),
        ("Z > 1 + 0.5 * 2", [1, 0, 1, 1]),
        ("Z - X >= 2 && X < 3", [1, 0, 0, 0]),
        ("-Z > 0", [0, 1, 0, 0]),
        ("Classification != 2 && Classification != 6 || X == 0", [1, 0, 0, 1]),
        ("X / 0 > 1", [0, 1, 1, 1]),
    ],
)
def test_evaluates(text, expected):
    assert Expression(text).evaluate(ARRAYS).astype(int).tolist() == expected


@pytest.mark.parametrize(
    "text", ["", "Z", "Z >", "Z ~ 2", "(Z > 1", "Z > 1)", "Z > 1 && 3", "!Z", "1 + 2", "Z > > 1", "(" * 500]
)
def test_refuses(text):
    with pytest.raises(OptionError, match="cannot be read"):
        Expression(text)


def test_names_the_missing_dimension():
    with pytest.raises(DimensionError, match=r"'Clasification'.*Did you mean 'Classification'\?"):
        Expression("Clasification == 2").evaluate(ARRAYS)


@given(st.text(max_size=40))
def test_any_text_parses_or_is_refused(text):
    try:
        Expression(text)
    except OptionError:
        pass


_terms = st.sampled_from(["X", "Y", "Z", "Classification", "3", "0.5", "(X + Y)", "Z * 2", "Y - 1", "X / 2"])
_comparisons = st.builds(
    lambda a, op, b: f"{a} {op} {b}", _terms, st.sampled_from(["==", "!=", "<", "<=", ">", ">="]), _terms
)
_conditions = st.recursive(
    _comparisons,
    lambda inner: st.one_of(
        st.builds(lambda a, b: f"({a}) && ({b})", inner, inner),
        st.builds(lambda a, b: f"({a}) || ({b})", inner, inner),
        st.builds(lambda a: f"!({a})", inner),
    ),
    max_leaves=5,
)


@pytest.mark.pdal
@settings(max_examples=25, deadline=None)
@given(_conditions)
def test_agrees_with_pdal(pdal_module, condition):
    rng = np.random.default_rng(7)
    points = np.zeros(
        200, [("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("Classification", "u1"), ("GpsTime", "f8")]
    )
    for name in "XYZ":
        points[name] = rng.integers(0, 6, 200)
    points["Classification"] = rng.integers(0, 6, 200)
    # PDAL's own filter keeps the points; GpsTime says which they were.
    points["GpsTime"] = np.arange(200)
    pipeline = pdal_module.Pipeline(
        json.dumps([{"type": "filters.assign", "value": f"GpsTime = -1 WHERE {condition}"}]), arrays=[points]
    )
    pipeline.execute()
    inside = pipeline.arrays[0]["GpsTime"] == -1
    assert np.array_equal(Expression(condition).evaluate({n: points[n] for n in points.dtype.names}), inside)
