"""The set-up: scripts, environment.yml, package data, and the rule on skips."""

from __future__ import annotations

import fnmatch
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from processes import ended, printed

ROOT = Path(__file__).resolve().parent.parent
SHELL = [
    "scripts/lib.sh",
    "scripts/setup",
    "scripts/install-pdal",
    "scripts/demo",
    "scripts/test",
    ".ci/run",
]


# ---- the scripts -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHELL)
def test_shell_scripts_parse_and_are_executable(name):
    script = ROOT / name
    subprocess.run(["bash", "-n", script], check=True)
    assert name.endswith(".sh") or os.access(script, os.X_OK)


# ---- PDAL's check -----------------------------------------------------------------------------------------


@pytest.mark.pdal
def test_check_pdal_proves_bindings_and_program(pdal_program):
    output = printed(sys.executable, ROOT / "scripts/check_pdal.py", "--program", pdal_program)
    assert re.match(r"PDAL \d+\.\d+\.\d+, python-pdal \d", output)


# ---- what is shipped and what is named -------------------------------------------------------------------


def project():
    return pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib").loads(
        (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    )


def test_every_data_file_is_packaged():
    patterns = project()["tool"]["setuptools"]["package-data"]["pdal_stages"]
    package = ROOT / "pdal_stages"
    code = {".py", ".pyc", ".nbi", ".nbc"}
    data = [
        p.relative_to(package).as_posix()
        for p in package.rglob("*")
        if p.is_file() and p.suffix not in code
    ]
    assert data and not [
        name for name in data if not any(fnmatch.fnmatch(name, p) for p in patterns)
    ]
    without_init = {p.parent for p in package.rglob("*.py")} - {
        p.parent for p in package.rglob("__init__.py")
    }
    assert not without_init


# ---- the rule on skips -----------------------------------------------------------------------------------

SKIPS = """
import pytest

def test_imports():
    pytest.importorskip("pdal_is_not_here", reason="no pdal on this machine")

def test_plugin():
    pytest.skip("filters.python is missing")

def test_version():
    pytest.skip("needs PDAL >= 99")

def test_data(data_dir):
    pass

@pytest.mark.skipif(True, reason="PyTorch is not installed (extra 'deep'): training is not tested")
def test_torch():
    pass
"""


def test_skips_that_must_not_happen_fail(tmp_path):
    for name in ("conftest.py", "block_scene.py"):
        shutil.copy(ROOT / "tests" / name, tmp_path)
    (tmp_path / "test_skips.py").write_text(SKIPS)
    environment = {"PDAL_STAGES_REQUIRE": "pdal,data", "PDAL_STAGES_DATA": str(tmp_path / "absent")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["-c", os.devnull, "--rootdir", tmp_path]
    done = ended(*command, tmp_path, env=environment)
    counts = dict.fromkeys(("failed", "error", "skipped"), 0)
    for number, word in re.findall(r"(\d+) (failed|error|skipped)", done.stdout.splitlines()[-1]):
        counts[word] = int(number)
    assert (counts["failed"] + counts["error"], counts["skipped"]) == (3, 2), done.stdout
    assert done.returncode == 1
