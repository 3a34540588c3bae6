"""Compiled code comes from the cache without what only compiling needs."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pdal_stages.synthetic import TownOptions, write_town

KERNELS = """
import sys
import numpy as np
from pdal_stages.base.jit import njit

@njit
def inner(values):
    total = 0.0
    for value in values:
        total += value * value
    return total

@njit
def outer(values):
    out = np.zeros(3)
    for i in range(3):
        out[i] = inner(values[i:]) + i
    return out

@njit
def other(values):
    return inner(values) - 1.0
"""


@pytest.fixture
def say(tmp_path):
    """Runs lines with these kernels in a process of its own, on a cache of its own; what they print."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run(lines: str) -> list[str]:
        words = [sys.executable, "-c", f"from kernels import *\n{lines}"]
        done = subprocess.run(words, cwd=tmp_path, env=env, text=True, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return run


COMPILED = "print(sum(k.dispatcher.stats.cache_misses.total() for k in (inner, outer, other)))"
READY = "print('numba.np.linalg' in sys.modules)"


def test_code_of_the_cache_gives_the_same_and_brings_nothing_else(say):
    work = f"print(inner(np.arange(9.0)), outer(np.arange(9.0)).tolist())\n{COMPILED}\n{READY}"
    first, again = say(work), say(work)
    assert first[1:] == ["2", "True"]
    assert again == [first[0], "0", "False"]


def test_what_was_loaded_can_still_be_compiled_into_others(say):
    say("inner(np.arange(9.0))")
    assert say(f"print(inner(np.arange(9.0)), other(np.arange(9.0)))\n{COMPILED}") == ["204.0 203.0", "1"]
    assert say(f"print(other(np.arange(9.0)), inner(np.arange(9.0)))\n{COMPILED}") == ["203.0 204.0", "0"]


def test_other_arguments_are_compiled_after_cached_ones(say):
    say("inner(np.arange(9.0))")
    assert say(f"print(inner(np.arange(9.0)), inner(np.arange(9)))\n{COMPILED}") == ["204.0 204.0", "1"]


def test_changed_code_is_compiled_again_also_where_it_is_called_by_way_of_what_stands_below(say, tmp_path):
    below = "from pdal_stages.base.jit import device, njit\n"
    outer = "from below import deepest\nfrom pdal_stages.base.jit import device, njit\n\n"
    (tmp_path / "above.py").write_text(
        outer + "@njit\ndef top(x):\n    return middle(x)\n\n@device\ndef middle(x):\n    return deepest(x)\n"
    )
    for factor in (2, 30):
        (tmp_path / "below.py").write_text(f"{below}\n@device\ndef deepest(x):\n    return {factor} * x\n")
        assert say("from above import top\nprint(top(7))") == [str(7 * factor)]


@pytest.mark.pdal
def test_a_job_that_compiles_nothing_imports_no_linear_algebra(tmp_path):
    town = tmp_path / "town.laz"
    write_town(TownOptions(size=60, density=6, seed=4), town)
    work = "import sys; from pdal_stages.cli import main; main(sys.argv[1:]); print('scipy.linalg' in sys.modules)"
    words = [sys.executable, "-c", work, "classify", str(town), str(tmp_path / "out.laz")]
    for _ in range(2):
        done = subprocess.run(words, text=True, capture_output=True, check=True)
    assert done.stdout.split()[-1] == "False"
