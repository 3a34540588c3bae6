"""What `pdal-stages doctor` finds, and what it says where something is missing."""

from __future__ import annotations

import sys

import pytest
from processes import ended

from pdal_stages import cli

pytestmark = pytest.mark.pdal


def test_all_that_is_needed_is_here(capsys, monkeypatch):
    assert cli.main(["doctor"]) == 0
    output = capsys.readouterr().out
    headings = "pdal_stages", "shipped model", "PDAL", "filters.python in this process", "machine"
    assert all(f"{what}: " in output for what in headings)
    assert "MISSING" not in output
    assert output.count("filters.python in ") >= 2


def test_what_is_missing_has_its_cure(tmp_path):
    """PDAL without filters.python; a process of its own, since PDAL looks for plugins once."""
    words = [sys.executable, "-m", "pdal_stages.cli", "doctor"]
    done = ended(*words, env={"PDAL_DRIVER_PATH": str(tmp_path)})
    assert done.returncode == 1, done.stderr
    lines = done.stdout.splitlines()
    missing = [n for n, line in enumerate(lines) if line.startswith("MISSING")]
    assert len(missing) == 2 and all("PDAL_DRIVER_PATH" in lines[n + 1] for n in missing)
    assert any(
        line.startswith("ok      machine") for line in lines
    )  # one fault does not hide the next
