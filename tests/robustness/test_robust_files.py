"""Every file that a command opens for writing is one it was asked for, or lies in a hidden folder of its own.

Watched from outside by strace, so that PDAL's and libraries' own files are seen as well.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from audit import OWN
from robustness_kit import job

pytestmark = [
    pytest.mark.pdal,
    pytest.mark.skipif(shutil.which("strace") is None, reason="watches with strace"),
]

HAG = {"type": "filters.hag_minima"}
SMALL = ["--neighborhoods", "c1", "--count", "50", "--trees", "2"]
_OPENED = re.compile(r'\b(?:open|openat|creat)\((?:[^"]*)"((?:[^"\\]|\\.)*)", ([A-Z_|0-9a-fx]+).*\) = \d+')
_CHANGED = re.compile(
    r"\b(rename\w*|link\w*|symlink\w*|truncate|chmod|fchmodat|chown|fchownat|mknod\w*|unlink\w*|mkdir\w*|rmdir)\((.*)\) = 0"
)
#: A name, and the folder that it is in, where that is open.
_NAMED = re.compile(r'(?:\d+<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')
_WRITES = {"O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC", "O_APPEND"}


def changed_files(log: str, folder: Path) -> set[str]:
    """Files and folders that were opened for writing, made, renamed or removed."""
    found = set()
    for line in log.splitlines():
        if opened := _OPENED.search(line):
            if _WRITES & set(opened[2].split("|")):
                found.add(opened[1])
        elif done := _CHANGED.search(line):
            found.update(os.path.join(at, name) for at, name in _NAMED.findall(done[2]))
    return {os.path.normpath(os.path.join(folder, name)) for name in found}


def watched(folder: Path, *words: object) -> set[str]:
    """What a command changed beyond what is its own."""
    log = folder / "trace.txt"
    calls = "trace=open,openat,creat,rename,renameat,renameat2,link,linkat,symlink,symlinkat,truncate,chmod,fchmodat,chown,fchownat,unlink,unlinkat,mkdir,mkdirat,rmdir"
    command = [
        "strace",
        "-f",
        "-qq",
        "-y",
        "-s",
        "4096",
        "-o",
        str(log),
        "-e",
        calls,
        sys.executable,
        "-m",
        "pdal_stages.cli",
    ]
    done = subprocess.run(
        [*command, *map(str, words)], cwd=folder, capture_output=True, text=True, timeout=500
    )
    if not log.exists() or "ptrace" in done.stderr:
        pytest.skip(f"nothing may be traced here: {done.stderr[:200]}")
    assert done.returncode == 0, done.stderr[-2000:]
    names = changed_files(log.read_text(errors="replace"), folder)
    own = [re.compile(pattern) for pattern in OWN]
    return {name for name in names if not any(pattern.search(name) for pattern in own)}


def test_files_that_are_written(tmp_path, cloud, model):
    raw = shutil.copy(cloud, tmp_path / "raw.las")

    def inside(*names):
        return {str(tmp_path / name) for name in names}

    found = watched(
        tmp_path, "classify", raw, "out.las", "--model", model, "--metadata", "m.json", "--log", "run.log"
    )
    assert found == inside("out.las", "m.json", "run.log")
    found = watched(tmp_path, "train", raw, "--model", "own.model", *SMALL)
    assert found == inside("own.model")
    keep = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
    labeled = job(
        tmp_path,
        str(raw),
        keep,
        {"type": "writers.las", "filename": "r.las", "extra_dims": "all", "minor_version": 4},
    )
    found = watched(tmp_path, "pipeline", labeled)
    assert found == inside("r.las")
    found = watched(tmp_path, "accuracy", "r.las", "--json", "a.json", "--html", "a.html")
    assert found == inside("a.json", "a.html")


def test_files_that_tiled_runs_write(tmp_path, cloud, model):
    raw = shutil.copy(cloud, tmp_path / "raw.las")
    path = job(tmp_path, str(raw), HAG, {"type": "filters.modelclassifier", "model": str(model)}, "o_#.las")
    found = watched(tmp_path, "pipeline", path, "--tile", "15", "--workers", "2", "--report", "r.html")
    assert found == {str(tmp_path / "o_raw.las"), str(tmp_path / "r.html")}


def test_what_the_watch_sees():
    """Made-up lines: flags, relative names, calls that failed."""
    log = """1 openat(AT_FDCWD, "a", O_RDONLY|O_CLOEXEC) = 3
1 openat(AT_FDCWD, "b", O_WRONLY|O_CREAT|O_TRUNC, 0666) = 4
1 open("/c", O_RDWR) = -1 EACCES (Permission denied)
1 rename("d", "/e") = 0
1 unlink("/f") = -1 ENOENT (No such file or directory)"""
    assert changed_files(log, Path("/here")) == {"/here/b", "/here/d", "/e"}


def test_what_the_hook_sees(cell, tmp_path, monkeypatch):
    """A command that wrote what it was not asked for, in this process, in one that it starts, or through a program, is caught."""
    from pdal_stages import cli

    stray, asked = tmp_path / "stray", tmp_path / "asked"
    code = f"open({str(stray)!r}, 'w').close()"
    program = [sys.executable, "-c", code]

    def writes(path):
        def main(words):
            path.write_text("")
            return 0

        return main

    def starts(words):
        return subprocess.run(program).returncode

    it = cell("Environment", "the watch over the files of every case")
    for main, found in ((writes(stray), stray), (starts, stray), (writes(asked), None)):
        monkeypatch.setattr(cli, "main", main)
        if found is None:
            assert it.command("pipeline", asked).code == 0
        else:
            with pytest.raises(AssertionError, match="stray"):
                it.command("pipeline", asked)
        stray.unlink(missing_ok=True)
    with pytest.raises(AssertionError, match="stray"):
        it.process(command=program)
    monkeypatch.setattr(cli, "main", lambda words: subprocess.run(["true"]).returncode)
    with pytest.raises(AssertionError, match="program true"):
        it.command("pipeline", asked)
