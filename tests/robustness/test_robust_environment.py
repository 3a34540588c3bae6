"""What is round the program: no PDAL, wrong plugin, no rights, no room, no locale, signals."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from robustness_kit import HAG, Command, job, las, scene

pytestmark = [
    pytest.mark.pdal,
    pytest.mark.skipif(os.name == "nt", reason="signals and mounts of Unix"),
]


def prepared(*lines: str) -> dict:
    """Options that run the command line after a preparation in the same process."""
    code = "\n".join([*lines, "import sys", "from pdal_stages.cli import main", "sys.exit(main())"])
    return {"command": [sys.executable, "-c", code]}


def without_rights() -> dict:
    """Options that run a command which the rights of files hold for: a superuser's exemption is
    dropped."""
    if os.geteuid() != 0:
        return {}
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "prctl"):
        pytest.skip("run by a superuser, whom no rights hold")

    def drop():
        for capability in (
            1,
            2,
        ):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, from the bounding set (24)
            libc.prctl(24, capability, 0, 0, 0)

    return {"preexec_fn": drop}


@contextlib.contextmanager
def mounted(folder: Path, options: str):
    """A small file system in memory, where that is allowed."""
    folder.mkdir(exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(
            ["umount", "-l", str(folder)], check=False
        )  # PDAL may hold a file of it open


# ---- PDAL and Python packages --------------------------------------------------------------------------------


def test_no_pdal(command, tmp_path, cloud):
    path = job(tmp_path, cloud, HAG, las(tmp_path / "out.las"))
    without = prepared("import sys", "sys.modules['pdal'] = None")
    command.refused(
        command.process("pipeline", path, **without),
        "python-pdal cannot be imported",
        "conda install",
    )
    alone = ("import sys; sys.modules['pdal'] = None\nimport pdal_stages as ps\n"
             "assert ps.hag_minima([1., 2.], [1., 2.], [3., 5.])[1] == 2")  # fmt: skip
    command.runs(command.process(command=[sys.executable, "-c", alone]))
    nowhere = prepared(
        "import sys, pdal_stages.pipeline.pdal as e",
        "sys.executable = '/nowhere/python'",
        "e.shutil.which = lambda *a: None",
    )
    command.refused(
        command.process("validate", path, **nowhere), "'pdal' is not on PATH", "conda install"
    )


@pytest.mark.parametrize("kind", ["missing folder", "another Python"])
def test_driver_path(command, tmp_path, cloud, kind):
    drivers = tmp_path / "drivers"
    plugin = drivers / "libpdal_plugin_filter_python.so"
    if kind == "another Python":
        drivers.mkdir()
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("no C compiler to build a plugin that needs a Python that is not here")
        source = "extern void Py_NoSuchPython_Ever(void);\nvoid PF_initPlugin(void) { Py_NoSuchPython_Ever(); }\n"
        words = [compiler, "-shared", "-fPIC", "-o", plugin, "-x", "c", "-"]
        subprocess.run(words, check=True, input=source, text=True)
    path = job(tmp_path, cloud, HAG, las(tmp_path / "out.las"))
    done = command.process("pipeline", path, env={"PDAL_DRIVER_PATH": str(drivers)})
    command.refused(done, "filters.python", "pdal-plugins", "PDAL_DRIVER_PATH")


# ---- rights and room -------------------------------------------------------------------------------------------


def test_no_rights(capfd, write_las):
    nobody, folder = (
        without_rights(),
        Path(tempfile.mkdtemp(prefix="pdal-stages-open-")),
    )  # any user reaches it
    try:
        folder.chmod(0o777)
        command = Command(folder, capfd)
        source, closed = write_las(folder / "in.las", scene(), point_format=3), folder / "closed"
        closed.mkdir(mode=0o555)
        plain = job(folder, source, HAG, name="p.json")

        def refused(*words, says):
            command.refused(command.process(*words, **nobody), *says)

        refused(
            "pipeline", job(folder, source, HAG, closed / "out.las"), says=["cannot be written to"]
        )
        refused("train", source, "--model", closed / "m", says=["cannot be written to"])
        for words, says in (
            (["classify", source, closed / "out.las"], "folder of the output file"),
            (["classify", source, f"{closed}/"], "folder of the output file"),
            (["classify", source, f"{closed}/below/"], "folder of the output cannot be created"),
            (["surfaces", source, closed / "below"], "folder of the rasters cannot be created"),
            (["objects", source, closed / "o.gpkg"], "folder of the vector file cannot"),
            (["review", source, closed / "r.gpkg"], "folder of the vector file cannot"),
            (["report", source, closed / "p.html"], "folder of the report file cannot"),
        ):
            refused(*words, says=[says, "Give another folder"])
        assert not list(closed.iterdir())
        for path in (source, plain):
            path.chmod(0o000)
        refused("pipeline", job(folder, source, HAG), says=["in.las", "Permission denied"])
        refused("pipeline", plain, says=["p.json", "Permission denied"])
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_disk_full(command, tmp_path, write_las, suffix):
    arrays = dict(
        zip("XYZ", np.random.default_rng(0).uniform(0, 300, (3, 60_000)).round(2), strict=True)
    )
    source = write_las(tmp_path / "big.las", arrays)
    with mounted(tmp_path / "small", "size=200k") as small:
        path = job(tmp_path, source, HAG, small / f"out.{suffix}")
        command.refused(["pipeline", path], f"out.{suffix}", "ake room")
        assert not list(small.iterdir())


@pytest.mark.parametrize("room_kib", [20, 60, 100, 120])
@pytest.mark.parametrize("name", ["classified.laz", "review.gpkg"])
def test_no_room_for_what_others_write(command, tmp_path, request, name, room_kib):
    """lazrs and GDAL have errors of their own, wherever the room ends."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room_kib * 1024, room_kib * 1024))

    verb = "classify" if name.endswith("laz") else "review"
    if verb == "review":
        pytest.importorskip("pyogrio")
    source = request.config.rootpath / "tests" / "data" / "city.laz"
    done = command.process(verb, source, tmp_path / name, preexec_fn=limit)
    if done.code:
        command.refused(done, "could not be written", "room")
        assert not (tmp_path / name).exists()
    else:
        assert (tmp_path / name).stat().st_size <= room_kib * 1024


# ---- locale and names --------------------------------------------------------------------------------------------


def test_locale_c(command, tmp_path, cloud):
    usual = {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": None, "PYTHONIOENCODING": None}
    plain = {**usual, "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    folder = tmp_path / "Stra\u00dfe \u6e2c\u91cf"
    folder.mkdir()
    shutil.copy(cloud, folder / "in.las")
    path = job(tmp_path, folder / "in.las", {**HAG, "tag": "h"}, folder / "out.las")
    command.runs(command.process("pipeline", path, env=usual))
    (folder / "out.las").unlink()
    command.refused(command.process("pipeline", path, env=plain), "PYTHONUTF8=1")
    bad = job(tmp_path, folder / "in.las", {**HAG, "where": "\u6e2c > 3"})
    command.refused(command.process("expand", bad, env=plain), "\\u6e2c")


# ---- signals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "ours"), [("SIGTERM", False), ("SIGKILL", True)])
def test_signals(command, tmp_path, name, ours):
    """While PDAL works, and while a stage of ours does: the older result stays, and the next run
    tidies up."""
    out = tmp_path / "out.las"
    out.write_bytes(b"LASF, an older result")
    faux = {
        "type": "readers.faux",
        "count": 2_000_000,
        "mode": "uniform",
        "bounds": "([0,100],[0,100],[0,9])",
    }
    slow = [{"type": "filters.sort", "dimension": axis} for axis in "XYZ" * 60]
    if ours:
        slow = [
            {"type": "filters.multiscalefeatures", "neighborhoods": "c5,kopt", "feature_set": "all"}
        ]
    path = job(tmp_path, faux, *slow, las(out, forward="header"))
    words = [sys.executable, "-m", "pdal_stages.cli", "pipeline", str(path)]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    end, partial = time.monotonic() + 60, ".pdal-stages-partial-*"
    while time.monotonic() < end and process.poll() is None and not list(tmp_path.glob(partial)):
        time.sleep(0.02)
    time.sleep(0.5)
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=60)
    assert process.returncode == -getattr(signal, name), (process.returncode, err)
    assert "Traceback" not in err and out.read_bytes() == b"LASF, an older result"
    command.runs(["expand", path, "-o", tmp_path / "expanded.json"])
    assert not list(tmp_path.glob(partial))


_SYSTEMS = """
import gc, sys
import pdal_stages as ps
from pdal_stages.pipeline.spatial_reference import described, fault_of_reference
for number in range(20):
    ps.run_pipeline([sys.argv[1], {"type": "writers.las", "filename": sys.argv[2]}])
    gc.collect()
    others = [bytes([255]) * size for size in range(100, 3000, 7)]
    for function in (described, fault_of_reference):
        function.cache_clear()
    fault_of_reference("EPSG:1")
"""


def test_gdal_reports_errors_after_pipelines_are_gone(tmp_path, cloud):
    """PDAL lets it write to the log of the last one: two cells of a notebook that end Python."""
    words = [sys.executable, "-c", _SYSTEMS, str(cloud), str(tmp_path / "o.las")]
    assert subprocess.run(words).returncode == 0


def test_a_closed_pipe(command):
    done = command.process(
        command=["sh", "-c", f"{sys.executable} -m pdal_stages.cli drivers | head -1"]
    )
    assert "BrokenPipe" not in command.runs(done).err
