"""Checks of single values: what is taken, and what is said of the rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdal_stages.base import checks, threads
from pdal_stages.base.errors import OptionError


@given(st.integers() | st.floats() | st.booleans() | st.none() | st.text())
def test_numbers_are_taken_where_they_are_within(value):
    good = isinstance(value, int | float) and not isinstance(value, bool) and -5 <= value <= 2**63 - 1
    try:
        number = checks.number("'x'", value, -5, 2**63 - 1)
    except OptionError as error:
        assert not good and str(error).startswith(
            "'x' must be a number from -5 to 9223372036854775807 (found "
        )
    else:
        assert good and number == float(value) and type(number) is float
    try:
        whole = checks.whole("'x'", value, -5, 2**63 - 1)
    except OptionError:
        assert not good or value != int(value)
    else:
        assert good and whole == value and type(whole) is int


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((None, None), ""),
        ((0, None), " of 0 or more"),
        ((None, 4), " of at most 4"),
        ((0, 1), " from 0 to 1"),
        ((0, None, True), " above 0"),
        ((0, 0.5, True, "m"), " above 0 and at most 0.5 m"),
        ((16, None, False, "MB"), " of 16 MB or more"),
        ((0, 2**31 - 1), " from 0 to 2147483647"),
    ],
)
def test_bounds_in_words(arguments, says):
    assert checks.bounds(*arguments) == says


def test_the_lower_bound_may_be_left_out():
    assert checks.number("x", 1e-300, 0, above=True) == 1e-300
    with pytest.raises(OptionError, match=r"x must be a number above 0 \(found 0\)"):
        checks.number("x", 0, 0, above=True)


def test_numbers_of_numpy():
    assert checks.whole("x", np.int8(5)) == 5 and checks.number("x", np.float32(0.5)) == 0.5
    assert checks.flag("x", np.True_) is True
    with pytest.raises(OptionError):
        checks.number("x", np.float64("nan"))


def test_words():
    assert checks.one_of("x", "a", ("a", "b")) == "a"
    with pytest.raises(
        OptionError, match=r"x must be one of 'sqrt', 'log2' \(found 'sqr'\). Did you mean 'sqrt'"
    ):
        checks.one_of("x", "sqr", ("sqrt", "log2"))
    with pytest.raises(OptionError):
        checks.one_of("x", True, (0, 1))
    assert checks.names("x", "a, b,,a") == checks.names("x", ["a", "b", "a"]) == ("a", "b")
    for wrong in (3, None, ["a", 2]):
        with pytest.raises(OptionError, match="x must be a list of names"):
            checks.names("x", wrong)
    with pytest.raises(OptionError, match="true or false"):
        checks.flag("x", "yes")


# ---- memory ----------------------------------------------------------------------------------------------


def test_cores_are_bounded_by_affinity_quota_and_what_a_worker_is_told(tmp_path, monkeypatch):
    count = threads.available_threads.__wrapped__
    monkeypatch.setattr(threads.os, "cpu_count", lambda: 16)
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: range(12), raising=False)
    monkeypatch.delenv(threads.CORES, raising=False)
    quota = threads._quota
    monkeypatch.setattr(threads, "_quota", lambda: quota(str(tmp_path)))
    assert count() == 12
    for told, cores in (("3", 3), ("0", 1), ("many", 12), ("40", 12)):
        monkeypatch.setenv(threads.CORES, told)
        assert count() == cores
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu/cpu.cfs_quota_us").write_text("-1\n")
    (tmp_path / "cpu/cpu.cfs_period_us").write_text("100000\n")
    assert count() == 12
    for text, cores in (("max 100000\n", 12), ("250000 100000\n", 3), ("1000 100000\n", 1), ("", 12)):
        (tmp_path / "cpu.max").write_text(text)
        assert count() == cores
    (tmp_path / "cpu/cpu.cfs_quota_us").write_text("400000\n")
    assert count() == 4
