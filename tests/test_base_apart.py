"""Calls in a process apart: answers, errors, and a Python within a program."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from pdal_stages.base import apart
from pdal_stages.base.checks import whole
from pdal_stages.base.errors import OptionError, StageError


def test_answers_come_back():
    assert apart.apart(os.getpid) != os.getpid()
    x = np.linspace(0, 1, 100_000)
    assert np.array_equal(apart.apart(np.sqrt, x), np.sqrt(x))
    assert apart.apart(print, "what a library prints is no answer") is None


def test_modules_of_the_folder_at_hand_are_not_run(tmp_path, monkeypatch):
    """Whoever works among files of others runs none of them."""
    for name in ("json", "numpy", "pickle", "subprocess", "pdal_stages"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    assert apart.apart(whole, "--workers", 5, 1, 1024) == whole("--workers", 5, 1, 1024)
    assert not (tmp_path / "ran").exists()


def test_errors_come_back():
    with pytest.raises(OptionError) as told:
        apart.apart(whole, "--workers", 5000, 1, 1024)
    with pytest.raises(OptionError) as here:
        whole("--workers", 5000, 1, 1024)
    assert str(told.value) == str(here.value)
    with pytest.raises(StageError, match="ValueError: "):
        apart.apart(int, "x")
    with pytest.raises(StageError, match="could not be started"):
        apart.apart(os._exit, 3)


def test_the_python_within_a_program(monkeypatch):
    """A program that has Python within names itself, or nothing, as the interpreter."""
    for name in ("/usr/bin/pdal", "", None):
        monkeypatch.setattr(sys, "executable", name)
        found = apart.interpreter()
        said = subprocess.run(
            [found, "-c", "import sys; print(sys.prefix)"], capture_output=True, text=True, check=True
        )
        assert said.stdout.strip() == sys.prefix
    monkeypatch.setattr(sys, "prefix", "/nowhere")
    monkeypatch.setattr(sys, "base_prefix", "/nowhere")
    with pytest.raises(StageError, match="pdal-stages pipeline"):
        apart.interpreter()
