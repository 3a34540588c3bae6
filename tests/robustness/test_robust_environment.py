"""What is round the program: no PDAL, wrong plugin, no rights, no room, no locale, one core, signals."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import scene
from robustness_kit import job

pytestmark = [pytest.mark.pdal, pytest.mark.skipif(os.name == "nt", reason="signals and mounts of Unix")]

HAG = {"type": "filters.hag_minima"}
#: Runs the command line after a preparation in the same process.
AFTER = [sys.executable, "-c"]


def prepared(*lines: str) -> list[str]:
    return [*AFTER, "\n".join([*lines, "import sys", "from pdal_stages.cli import main", "sys.exit(main())"])]


def without_rights() -> dict:
    """Options that run a command which the rights of files hold for: a superuser's exemption is dropped."""
    if os.geteuid() != 0:
        return {}
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "prctl"):
        pytest.skip("run by a superuser, whom no rights hold")

    def drop():
        for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, from the bounding set (24)
            libc.prctl(24, capability, 0, 0, 0)

    return {"preexec_fn": drop}


@contextlib.contextmanager
def mounted(folder: Path, options: str):
    """A small file system in memory, where that is allowed."""
    folder.mkdir(exist_ok=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)  # PDAL may hold a file of it open


def simple(tmp_path, cloud, out="out.las"):
    return job(
        tmp_path,
        str(cloud),
        HAG,
        {"type": "writers.las", "filename": str(tmp_path / out), "extra_dims": "all"},
    )


# ---- PDAL and Python packages --------------------------------------------------------------------------------


def test_no_python_pdal(cell, tmp_path, cloud):
    path = simple(tmp_path, cloud)
    it = cell("Environment", "python-pdal is not installed")
    without = prepared("import sys", "sys.modules['pdal'] = None")
    it.refused(
        it.process("pipeline", path, command=without), "python-pdal cannot be imported", "conda install"
    )
    it = cell("Environment", "numpy-level functions without PDAL")
    done = it.process(command=[*AFTER, "import sys; sys.modules['pdal'] = None\nimport pdal_stages as ps\n"
                               "assert ps.hag_minima([1., 2.], [1., 2.], [3., 5.])[1] == 2"])  # fmt: skip
    it.runs(done, "work")


def test_no_pdal_program(cell, tmp_path, cloud):
    path = simple(tmp_path, cloud)
    it = cell("Environment", "the program 'pdal' is not on PATH")
    lines = (
        "import sys, pdal_stages.pipeline.pdal as e",
        "sys.executable = '/nowhere/python'",
        "e.shutil.which = lambda *a: None",
    )
    it.refused(it.process("drivers", command=prepared(*lines)), "'pdal' is not on PATH", "conda install")
    it.refused(it.process("validate", path, command=prepared(*lines)), "'pdal' is not on PATH")


@pytest.mark.parametrize(
    "kind",
    [
        "an empty folder",
        "a folder that is not there",
        "a plugin that is no library",
        "a plugin for another Python",
    ],
)
def test_driver_path(cell, tmp_path, cloud, kind):
    drivers = tmp_path / "drivers"
    plugin = drivers / "libpdal_plugin_filter_python.so"
    if kind != "a folder that is not there":
        drivers.mkdir()
    if kind == "a plugin that is no library":
        plugin.write_bytes(b"not a library")
    if kind == "a plugin for another Python":
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("no C compiler to build a plugin that needs a Python that is not here")
        source = tmp_path / "plugin.c"
        source.write_text(
            "extern void Py_NoSuchPython_Ever(void);\nvoid PF_initPlugin(void) { Py_NoSuchPython_Ever(); }\n"
        )
        subprocess.run([compiler, "-shared", "-fPIC", "-o", plugin, source], check=True)
    it = cell("Environment", f"PDAL_DRIVER_PATH names {kind}")
    done = it.process("pipeline", simple(tmp_path, cloud), env={"PDAL_DRIVER_PATH": str(drivers)})
    it.refused(done, "filters.python", "pdal-plugins", "PDAL_DRIVER_PATH")


# ---- rights and room -------------------------------------------------------------------------------------------


@pytest.fixture()
def open_folder():
    """A folder that any user reaches, unlike pytest's."""
    folder = Path(tempfile.mkdtemp(prefix="pdal-stages-open-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def test_no_rights(cell, open_folder, write_las):
    nobody = without_rights()
    source = write_las(open_folder / "in.las", scene(), point_format=3)
    closed = open_folder / "closed"
    closed.mkdir()
    path = job(open_folder, str(source), HAG, str(closed / "out.las"))
    closed.chmod(0o555)
    words = {"cwd": open_folder, **nobody}
    it = cell("Environment", "no right to write the output's folder")
    it.refused(it.process("pipeline", path, **words), "cannot be written to")
    it = cell("Environment", "no right to write the model's folder")
    train = job(
        open_folder,
        str(source),
        HAG,
        {"type": "writers.classifiermodel", "filename": str(closed / "m")},
        name="t.json",
    )
    it.refused(it.process("pipeline", train, **words), "cannot be written to")
    it = cell("Environment", "no right to write the metadata's folder")
    plain = job(open_folder, str(source), HAG, name="p.json")
    it.refused(
        it.process("pipeline", plain, "--metadata", closed / "m.json", **words),
        "metadata file cannot be written to",
    )
    it = cell("Environment", "no right to read the input")
    source.chmod(0o000)
    it.refused(it.process("pipeline", plain, **words), "in.las", "Permission denied")
    text = open_folder / "in.txt"
    text.write_text("X,Y,Z\n1,1,1\n")
    text.chmod(0o000)
    it.refused(
        it.process("pipeline", job(open_folder, str(text), HAG, name="t.json"), **words),
        "in.txt",
        "Permission denied",
    )
    it = cell("Environment", "no right to read the pipeline")
    plain.chmod(0o000)
    it.refused(it.process("pipeline", plain, **words), "p.json", "Permission denied")


def big(tmp_path, write_las, n=60_000):
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(0, 300, (3, n)).round(2)
    return write_las(tmp_path / "big.las", {"X": x, "Y": y, "Z": z})


@pytest.mark.parametrize("suffix", ["las", "laz", "txt"])
def test_disk_full(cell, tmp_path, write_las, suffix):
    source = big(tmp_path, write_las)
    with mounted(tmp_path / "small", "size=200k") as small:
        path = job(tmp_path, str(source), HAG, str(small / f"out.{suffix}"))
        cell("Environment", f"disk full while writing .{suffix}").refused(
            ["pipeline", path], f"out.{suffix}", "ake room"
        )
        assert not list(small.iterdir())


# ---- locale, names, cores ----------------------------------------------------------------------------------------


def test_locale_c(cell, tmp_path, cloud):
    usual = {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": None, "PYTHONIOENCODING": None}
    plain = {**usual, "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    folder = tmp_path / "Stra\u00dfe \u6e2c\u91cf"
    folder.mkdir()
    source = folder / "in.las"
    source.write_bytes(cloud.read_bytes())
    path = job(tmp_path, str(source), {**HAG, "tag": "h"}, str(folder / "out.las"))
    it = cell("Environment", "locale C with non-ASCII names in the pipeline")
    it.runs(it.process("pipeline", path, env=usual), "the file is written")
    (folder / "out.las").unlink()
    it = cell("Environment", "locale C with Python's UTF-8 mode switched off")
    it.refused(it.process("pipeline", path, env=plain), "PYTHONUTF8=1")
    it = cell("Environment", "locale C and a message with characters it lacks")
    bad = job(tmp_path, str(source), {**HAG, "cell": "\u6e2c"})
    it.refused(it.process("expand", bad, env=plain), "option 'cell' must be a number")
    bad = job(tmp_path, str(source), {**HAG, "where": "\u6e2c > 3"})
    it.refused(it.process("expand", bad, env=plain), "\\u6e2c")


def test_file_name_that_is_not_utf8(cell, tmp_path, cloud, model):
    name = os.fsdecode(b"gr\xfcn.las")
    try:
        shutil.copy(cloud, tmp_path / name)
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    it = cell("Environment", "file name in Latin-1")
    it.refused(
        it.process("classify", tmp_path / name, tmp_path / "out.las", "--model", model),
        "not valid UTF-8",
        "rename the file",
    )


# ---- signals -------------------------------------------------------------------------------------------------------


def started(tmp_path, path):
    """The command in a process of its own."""
    return subprocess.Popen([sys.executable, "-m", "pdal_stages.cli", "pipeline", str(path)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, cwd=tmp_path)  # fmt: skip


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGKILL", "SIGHUP"])
@pytest.mark.parametrize("where", ["while PDAL writes", "while a stage of ours works"])
def test_signals(cell, tmp_path, write_las, name, where):
    out = tmp_path / "out.las"
    out.write_bytes(b"an older result")
    if where == "while PDAL writes":
        faux = {
            "type": "readers.faux",
            "count": 3_000_000,
            "mode": "uniform",
            "bounds": "([0,1],[0,1],[0,1])",
        }
        sort = [{"type": "filters.sort", "dimension": axis} for axis in "XYZ" * 60]
        path = job(tmp_path, faux, *sort, {"type": "writers.las", "filename": str(out)})
    else:
        faux = {
            "type": "readers.faux",
            "count": 3_000_000,
            "mode": "uniform",
            "bounds": "([0,100],[0,100],[0,9])",
        }
        stage = {"type": "filters.multiscalefeatures", "neighborhoods": "c5,kopt", "feature_set": "all"}
        path = job(tmp_path, faux, stage, {"type": "writers.las", "filename": str(out), "extra_dims": "all"})
    process = started(tmp_path, path)
    partial = ".pdal-stages-partial-*"
    assert wait_for(lambda: process.poll() is not None or list(tmp_path.glob(partial)))
    time.sleep(1.0)
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=60)
    assert process.returncode == -getattr(signal, name), (process.returncode, err)
    assert "Traceback" not in err
    assert out.read_bytes() == b"an older result"
    it = cell("Environment", f"{name} {where}")
    assert it.command("expand", path, "-o", tmp_path / "expanded.json").code == 0
    assert not list(tmp_path.glob(partial))


def test_a_closed_pipe(cell, tmp_path):
    it = cell("Environment", "output into a program that ends early")
    done = it.process(command=["sh", "-c", f"{sys.executable} -m pdal_stages.cli drivers | head -1"])
    it.runs(done, "ends quietly")
    assert "BrokenPipe" not in done.err
