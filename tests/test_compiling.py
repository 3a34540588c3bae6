"""What a first job says of the kernels that it compiles, and a second one does not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

#: Two kernels, of which one calls the other, and a job of both.
KERNELS = """
import numpy as np
from pdal_stages.base.jit import njit

@njit
def ground(u):
    return 2.0 * u

@njit
def heights(places):
    out = np.empty(places.size)
    for n in range(places.size):
        out[n] = ground(places[n])
    return out
"""
TWO_KERNELS = (
    "from pdal_stages.base.progress import Progress; Progress.delay = 0.0; "
    "import numpy as np; from two import ground, heights; "
    "assert ground(3.0) == heights(np.array([3.0]))[0]"
)


@pytest.fixture(autouse=True)
def two_kernels(tmp_path, monkeypatch):
    """A module of two kernels in the folder that jobs run in."""
    (tmp_path / "two.py").write_text(KERNELS)
    monkeypatch.chdir(tmp_path)


def test_a_first_job_says_that_it_compiles_and_the_next_one_nothing(tmp_path):
    code = TWO_KERNELS
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PDAL_STAGES_PROGRESS": "1"}

    def output_of(code: str = code) -> str:
        return subprocess.run(
            [sys.executable, "-c", code], env=env, text=True, capture_output=True
        ).stderr

    assert "compiling for this processor, once" in output_of()
    assert not output_of()
    for caller in (tmp_path / "kernels").rglob("*.heights-*"):
        caller.unlink()  # and is compiled again, with what it calls from the cache
    assert "compiling for this processor, once" in output_of()
    for index in (tmp_path / "kernels").rglob("*.nbi"):
        index.write_bytes(b"damaged")
    assert "Traceback" not in output_of(
        "import os; os.environ['PDAL_STAGES_PROGRESS'] = '0'; " + code
    )
    assert not output_of()


@pytest.mark.skipif(os.name == "nt", reason="users and modes of Unix")
def test_code_is_kept_only_where_no_other_user_can_put_any(tmp_path):
    """The folder of compiled code and all its parents count; elsewhere kernels are compiled in memory."""
    home = tmp_path / "home"
    kernels = home / "kernels"

    def run(mode: int = 0o755, owner: int | None = None, folder=home) -> tuple[int, str]:
        """Return the number of files in the cache and what a job says, with another mode or owner of a folder."""
        shutil.rmtree(home, ignore_errors=True)
        kernels.mkdir(parents=True)
        folder.chmod(mode)
        if owner is not None:
            os.chown(folder, owner, -1)
        env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "link"), "PDAL_STAGES_PROGRESS": "0"}
        done = subprocess.run(
            [sys.executable, "-c", TWO_KERNELS], env=env, text=True, capture_output=True
        )
        assert done.returncode == 0, done.stderr
        return len(list(kernels.rglob("*.nbc"))), done.stderr

    (tmp_path / "link").symlink_to(kernels)
    for mode in (0o700, 0o775, 0o1777):  # one's own, a group's, sticky like /tmp
        assert run(mode) == (2, "")
    for count, errors in (run(0o777), run(0o777, folder=kernels)):
        assert not count and errors.count("compiled code is not kept") == 1
    if os.geteuid() == 0:
        count, errors = run(owner=65534)
        assert not count and f"other users can write to {home}" in errors


def test_code_that_was_not_loaded_for_long_is_removed(tmp_path):
    old, recent = (tmp_path / "kernels" / "kernels" / name for name in ("0123", "4567"))
    for folder in (old, recent):
        folder.mkdir(parents=True)
    os.utime(old, (0, 0))
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    subprocess.run([sys.executable, "-c", TWO_KERNELS], env=env, check=True, capture_output=True)
    assert recent.is_dir() and not old.exists()


@pytest.mark.pdal
def test_after_warmup_a_job_compiles_nothing(ready_town, tmp_path):
    pytest.importorskip("pyogrio")
    code = (
        "from sys import argv; from pdal_stages.base.jit import _functions; from pdal_stages.cli import main\n"
        "def compiled():\n"
        "    made = [kernel._dispatcher for kernel in _functions if kernel._dispatcher]\n"
        "    return {(one.__name__, str(types)) for one in made for types in one.signatures}\n"
        "main(['warmup'])\nbefore = compiled()\n"
        "assert main(['classify', *argv[1:3]]) == main(['objects', *argv[2:]]) == 0\n"
        "assert compiled() == before, compiled() - before"
    )
    files = [ready_town, tmp_path / "c.laz", tmp_path / "o.gpkg"]
    ended = subprocess.run([sys.executable, "-c", code, *files], text=True, capture_output=True)
    assert ended.returncode == 0, ended.stderr
