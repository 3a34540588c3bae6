"""What a first job says of the kernels that it compiles."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pdal_stages.base.jit import Kernel
from pdal_stages.stages import registry
from pdal_stages.synthetic import TownOptions, write_town

ROOT = Path(__file__).resolve().parent.parent


def test_listed_kernels_are_there():
    for name in registry.kernels(registry.stages()):
        module, _, function = f"pdal_stages.{name}".rpartition(".")
        assert isinstance(getattr(importlib.import_module(module), function), Kernel), name


@pytest.mark.pdal
def test_the_list_is_what_stages_call():
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "kernels.py"), "--check"], cwd=ROOT, check=False
    )
    assert done.returncode == 0, "run python benchmarks/kernels.py"


@pytest.mark.pdal
def test_a_first_job_says_how_many_it_compiles_and_the_next_one_nothing(tmp_path):
    town = tmp_path / "town.laz"
    write_town(TownOptions(size=40, density=4, seed=2), town)
    job = [str(town), {"type": "filters.hag_minima"}, {"type": "filters.multiscalefeatures"}]
    words = [sys.executable, "-m", "pdal_stages.cli", "pipeline", "--stdin"]
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PDAL_STAGES_PROGRESS": "lines"}

    def said():
        done = subprocess.run(
            words, input=json.dumps(job), env=env, cwd=tmp_path, text=True, capture_output=True, check=True
        )
        lines = [line for line in done.stderr.splitlines() if "kernels" in line]
        return [tuple(map(int, re.search(r": (\d+) of (\d+) kernels \(", line).groups())) for line in lines]

    first = said()
    wanted = len(registry.kernels(["filters.hag_minima", "filters.multiscalefeatures"]))
    assert {total for _, total in first} == {wanted}
    assert first[-1][0] in range(wanted - 2, wanted + 1)  # some kernels are for clouds of other kinds
    assert said() == []


def test_warmup_says_how_many_there_are_and_the_next_one_nothing(tmp_path):
    words = [sys.executable, "-m", "pdal_stages.cli", "warmup"]
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PDAL_STAGES_PROGRESS": "lines"}

    def said():
        done = subprocess.run(words, env=env, cwd=tmp_path, text=True, capture_output=True, check=True)
        return re.findall(r": (\d+) of (\d+) kernels \(", done.stderr)

    first, wanted = said(), len(registry.kernels(["warmup"]))
    assert {int(total) for _, total in first} == {wanted} and int(first[-1][0]) == wanted
    assert said() == []
