"""What a first job says of the kernels that it compiles, and a second one does not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def test_a_first_job_says_that_it_compiles_and_the_next_one_nothing(tmp_path):
    code = (
        "from pdal_stages.base.messages import Progress; Progress.delay = 0.0; "
        "import numpy as np; from pdal_stages.synthetic.townplan import Plan, ground, heights; plan = Plan(1, "
        "np.ones((2, 4)), 0, np.eye(2)); assert ground(3.0, 40.0, plan)[0] == heights(np.array([[3.0, 40.0]]), plan)"
    )
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PDAL_STAGES_PROGRESS": "1"}

    def said(code: str = code) -> str:
        return subprocess.run(
            [sys.executable, "-c", code], env=env, text=True, capture_output=True
        ).stderr

    assert "compiling for this processor, once" in said()
    assert not said()
    for caller in (tmp_path / "kernels").rglob("*.heights-*"):
        caller.unlink()  # and is compiled again, with what it calls from the cache
    assert "compiling for this processor, once" in said()
    for index in (tmp_path / "kernels").rglob("*.nbi"):
        index.write_bytes(b"damaged")
    assert "Traceback" not in said("import os; os.environ['PDAL_STAGES_PROGRESS'] = '0'; " + code)
    assert not said()
    index.parent.chmod(0o777)
    assert "other users can write to" in said()


@pytest.mark.pdal
def test_after_warmup_a_job_compiles_nothing(ready_town, tmp_path):
    pytest.importorskip("pyogrio")
    code = (
        "from sys import argv; from pdal_stages.base.jit import _functions; from pdal_stages.cli import main\n"
        "def compiled():\n"
        "    made = [kernel._dispatcher for kernel in _functions if kernel._dispatcher]\n"
        "    return {(one.__name__, str(types)) for one in made for types in one.signatures}\n"
        "main(['warmup'])\nbefore = compiled()\n"
        "assert main(['classify', '--wires', *argv[1:3]]) == main(['objects', *argv[2:]]) == 0\n"
        "assert compiled() == before, compiled() - before"
    )
    files = [ready_town, tmp_path / "c.laz", tmp_path / "o.gpkg"]
    ended = subprocess.run([sys.executable, "-c", code, *files], text=True, capture_output=True)
    assert ended.returncode == 0, ended.stderr
