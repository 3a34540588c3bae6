"""Checks of single values: what is taken, and what is said of the rest."""

from __future__ import annotations

import numpy as np
import processes
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdal_stages.base import checks, threads
from pdal_stages.base.errors import OptionError


@given(st.integers() | st.floats() | st.booleans() | st.none() | st.text())
def test_numbers_are_taken_where_they_are_within(value):
    good = (
        isinstance(value, int | float) and not isinstance(value, bool) and -5 <= value <= 2**63 - 1
    )
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


def test_what_is_taken_and_what_is_not():
    assert checks.whole("x", np.int8(5)) == 5 and checks.number("x", np.float32(0.5)) == 0.5
    assert checks.flag("x", np.True_) is True and checks.one_of("x", "a", ("a", "b")) == "a"
    assert checks.names("x", "a, b,,a") == checks.names("x", ["a", "b", "a"]) == ("a", "b")
    assert checks.number("x", 1e-300, 0, above=True) == 1e-300
    for check, says in {
        lambda: checks.number("x", 0, 0, above=True): r"x must be a number above 0 \(found 0\)",
        lambda: checks.number("x", np.float64("nan")): "x must be a number",
        lambda: checks.one_of("x", True, (0, 1)): "one of 0, 1",
        lambda: checks.names("x", ["a", 2]): "x must be a list of names",
        lambda: checks.flag("x", "yes"): "true or false",
    }.items():
        with pytest.raises(OptionError, match=says):
            check()


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, []),
        ({"cpu.max": "max 100000"}, []),
        ({"cpu.max": "250000 100000"}, [3]),
        ({"cpu.max": "1000 100000"}, [1]),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, []),
        ({"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"}, [4]),
    ],
)
def test_quotas_of_control_groups(tmp_path, files, cores):
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(f"{text}\n")
    assert list(threads._quota(str(tmp_path))) == cores


def test_a_worker_takes_the_cores_that_it_is_told():
    code = "from pdal_stages.base.threads import available_threads; print(available_threads())"
    every = int(processes.python(code, env={threads.CORES_VARIABLE: "many"}))
    for value, cores in (("1", 1), ("0", 1), ("4000", every)):
        assert int(processes.python(code, env={threads.CORES_VARIABLE: value})) == cores
