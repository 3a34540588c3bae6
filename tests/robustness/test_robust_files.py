"""Every file that a command opens for writing is one it was asked for, or lies in a hidden folder
of its own.

Watched from outside by strace, so that PDAL's and libraries' own files are seen as well.
"""

from __future__ import annotations

import os
import re
import shutil
import sys

import pytest
from processes import ended
from robustness_kit import HAG, job

no_strace = shutil.which("strace") is None
pytestmark = [pytest.mark.pdal, pytest.mark.skipif(no_strace, reason="watches with strace")]

#: Ours: hidden folders, notes of tiled runs and of their pace, compiled kernels, temporary folders;
#: and the system's.
OWN = re.compile(
    r"/\.pdal-stages-partial-|/\.pdal-stages(/|$)|/__pycache__(/|$)|\.nb[ic]|/pdal-stages(/measured\.json)?$"
    r"|^/(tmp|var/tmp)/(pdal-stages-[^/]+|tmp\w+|[a-z0-9_]{8})(/|$)|^/dev/(null|tty|shm/)|^/proc/"
)
_OPENED = re.compile(
    r'\b(?:open|openat|creat)\((?:[^"]*)"((?:[^"\\]|\\.)*)", ([A-Z_|0-9a-fx]+).*\) = \d+'
)
_CHANGED = re.compile(
    r"\b(rename\w*|link\w*|symlink\w*|truncate|unlink\w*|mkdir\w*|rmdir)\((.*)\) = 0"
)
#: A name, and the folder that it is in, where that is open.
_NAMED = re.compile(r'(?:\d+<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')


def written(folder, *words: object) -> set[str]:
    """Return what a command opened for writing, made, renamed or removed beyond what is its own."""
    log = folder / "trace.txt"
    calls = "trace=open,openat,creat,rename,renameat,renameat2,link,linkat,symlink,symlinkat,truncate,unlink,unlinkat,mkdir,mkdirat,rmdir"
    strace = [
        "strace",
        "-f",
        "--seccomp-bpf",
        "-qq",
        "-y",
        "-s",
        "4096",
        "-o",
        str(log),
        "-e",
        calls,
    ]
    done = ended(*strace, sys.executable, "-m", "pdal_stages.cli", *words, cwd=folder)
    if not log.exists() or "ptrace" in done.stderr:
        pytest.skip(f"nothing may be traced here: {done.stderr[:200]}")
    assert done.returncode == 0, done.stderr[-2000:]
    paths = set()
    for line in log.read_text(errors="replace").splitlines():
        if opened := _OPENED.search(line):
            if {"O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC", "O_APPEND"} & set(opened[2].split("|")):
                paths.add(opened[1])
        elif changed := _CHANGED.search(line):
            paths.update(os.path.join(at, name) for at, name in _NAMED.findall(changed[2]))
    names = {os.path.normpath(os.path.join(folder, name)) for name in paths}
    return {os.path.relpath(name, folder) for name in names if not OWN.search(name)}


def test_files_that_are_written(tmp_path, cloud, model):
    shutil.copy(cloud, tmp_path / "raw.las")
    words = [
        "classify",
        "raw.las",
        "out.las",
        "--model",
        model,
        "--metadata",
        "m.json",
    ]
    assert written(tmp_path, *words) == {"out.las", "m.json"}
    path = job(
        tmp_path,
        "raw.las",
        HAG,
        {"type": "filters.modelclassifier", "model": str(model)},
        "o_#.las",
    )
    words = ["pipeline", path, "--tile", "15", "--workers", "2", "--report", "r.json"]
    assert written(tmp_path, *words) == {"o_raw.las", "r.json"}
