"""Tokens, presets, canonical spelling, errors."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError
from pdal_stages.features.neighborhoods import (
    PRESETS,
    parse_neighborhoods,
    preset_dimensions,
)


def tokens(spec):
    return [n.token for n in parse_neighborhoods(spec)]


@pytest.mark.parametrize(
    "spec, expected",
    [
        ("c2", ["c2"]),
        ("c2.0, c2 ,C2", ["c2"]),
        ("c2.50", ["c2.5"]),
        ("s.5", ["s0.5"]),
        ("k50", ["k50"]),
        ("kopt(10,100)", ["kopt"]),
        ("kopt( 10 , 50 ),c1", ["kopt(10,50)", "c1"]),
        ("ropt(0.25,2,0.05)", ["ropt"]),
        ("ropt(0.3,1.5,0.1)", ["ropt(0.3,1.5,0.1)"]),
        ("rdim(0.25,2,0.05), RDIM(0.5,2,0.05)", ["rdim", "rdim(0.5,2,0.05)"]),
        ("copt", ["copt"]),
        (["c1", "s1,s2"], ["c1", "s1", "s2"]),
        ("blomley2016", ["c1", "c2", "c3", "c5", "kopt"]),
        ("weinmann2018", ["c1", "c2", "c3", "c5", "s1", "s2", "s3", "s5", "kopt"]),
        ("s1, weinmann2018, c10", ["s1", "c1", "c2", "c3", "c5", "s2", "s3", "s5", "kopt", "c10"]),
        ("he2017", ["copt"]),
    ],
)
def test_parses(spec, expected):
    assert tokens(spec) == expected
    assert tokens(tokens(spec)) == expected  # canonical tokens parse to themselves


@pytest.mark.parametrize(
    "spec, word",
    [
        ("", "no neighborhood"),
        ([], "no neighborhood"),
        ("c", "unknown"),
        ("c0", "radius"),
        ("c-1", "unknown"),
        ("c1e3", "unknown"),
        ("c1000000", "radius"),
        ("s0.0001", "radius"),
        ("k0", "whole number"),
        ("k2.5", "whole number"),
        ("k100001", "whole number"),
        ("kopt(100,10)", "kopt"),
        ("kopt(10)", "two of them"),
        ("kopt(1,5)", "kopt"),
        ("kopt5", "unknown"),
        ("ropt(1,2)", "ropt"),
        ("ropt(2,1,0.1)", "ropt"),
        ("ropt(0.1,2,0)", "ropt"),
        ("ropt(0.1,200,0.001)", "1000 radii"),
        ("ropt(a,b,c)", "unknown"),
        ("rdim(1,2)", "rdim"),
        ("copt(1)", "no values"),
        ("weinman2018", "weinmann2018"),
        ("c1;c2", "unknown"),
        (5, "text"),
        ([3], "text"),
        ("ropt(1,2.5,1),ropt(1.2,5,1)", "same suffix"),
    ],
)
def test_refuses(spec, word):
    with pytest.raises(OptionError, match=word):
        parse_neighborhoods(spec)


def test_suffix_and_reach():
    result = {
        n.token: (n.suffix, n.reach, n.adaptive)
        for n in parse_neighborhoods("c2.5,s1,k50,kopt,ropt,rdim,copt")
    }
    assert result == {
        "c2.5": ("c2_5", 2.5, False),
        "s1": ("s1", 1.0, False),
        "k50": ("k50", None, False),
        "kopt": ("kopt", None, True),
        "ropt": ("ropt", 2.0, True),
        "rdim": ("rdim", 2.0, True),
        "copt": ("copt", 3.0, True),
    }
    assert parse_neighborhoods("kopt(10,50)")[0].suffix == "kopt10_50"


def test_presets_bring_dimensions():
    assert preset_dimensions("blomley2016") == ("Z",)
    assert preset_dimensions("c1, weinmann2018") == ("HeightAboveGround",)
    assert preset_dimensions(["he2017", "blomley2016", "weinmann2018"]) == (
        "Z",
        "HeightAboveGround",
    )
    assert preset_dimensions("c1") == ()
    assert all(parse_neighborhoods(list(words)) for words, _ in PRESETS.values())


@given(st.floats(0.001, 99999.0), st.sampled_from("cs"))
def test_any_radius_survives_its_token(radius, kind):
    (single,) = parse_neighborhoods(f"{kind}{radius:.9f}")
    (again,) = parse_neighborhoods(single.token)
    assert single == again
    assert abs(single.parameters[0] - radius) <= 5.1e-7
    assert single.suffix.replace("_", "").isalnum()
