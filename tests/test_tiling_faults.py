"""What a tiled run does when workers, disks, inputs and people fail it."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import pickle
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
import zipfile
from functools import partial
from pathlib import Path

import laspy
import numpy as np
import pytest
import tiling_clouds as clouds

from pdal_stages import run_tiled
from pdal_stages.base.errors import StageError
from pdal_stages.base.threads import available_threads
from pdal_stages.cli import main
from pdal_stages.pipeline import workers
from pdal_stages.pipeline.workers import perform_task
from pdal_stages.tiling import dask_workers as dask_cluster
from pdal_stages.tiling import plan_run
from pdal_stages.tiling.jobs import Store

pytestmark = pytest.mark.pdal
WORKERS = min(2, available_threads())
#: Seconds after which a program that is waited for hangs: many, as machines of tests may be busy.
_PATIENCE = 400.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory, write_las):
    """Two neighboring files of 40 m by 40 m."""
    rng = np.random.default_rng(4)
    folder = tmp_path_factory.mktemp("faults")
    for name, x0 in (("east", 40.0), ("west", 0.0)):
        xyz = np.round(rng.uniform(0, 1, (2_000, 3)) * (39.99, 40, 5) + (x0, 0, 0), 3)
        write_las(folder / f"{name}.laz", dict(zip("XYZ", xyz.T, strict=True)), point_format=6)
    return folder


def python_filter(body: str) -> dict:
    """A filter that runs some lines on each tile: the user's own, so it can do anything."""
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    source = f"import os, signal, time\ndef f(ins, outs):\n{lines}    return True\n"
    return {"type": "filters.python", "module": "own", "function": "f", "source": source}


def pipeline(folder: Path, output: Path, *own: dict) -> list:
    return [
        {"type": "readers.las", "filename": str(folder / "*.laz")},
        {"type": "filters.hag_minima", "cell": 2},
        *own,
        {"type": "writers.las", "filename": str(output), "forward": "all", "extra_dims": "all"},
    ]


def command(job: Path, stages: list, *flags: str, tile: int = 20, **popen) -> subprocess.Popen:
    job.write_text(json.dumps(stages))
    words = [sys.executable, "-m", "pdal_stages.cli", "pipeline", str(job)]
    words += ["--tile", str(tile), "--buffer", "0", *flags]
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **popen
    )


@pytest.fixture(scope="module")
def expected(folder, tmp_path_factory):
    """What an undisturbed run writes."""
    out = tmp_path_factory.mktemp("expected")
    assert not run_tiled(pipeline(folder, out / "o_#.laz"), 20, workers=0).failures
    return {name: (out / f"o_{name}.laz").read_bytes() for name in ("east", "west")}


def check_same(folder: Path, expected: dict[str, bytes]) -> None:
    for name, content in expected.items():
        assert (folder / f"o_{name}.laz").read_bytes() == content
    assert not clouds.hidden(folder)


# ---- workers ---------------------------------------------------------------------------------------------


def test_killed_workers(tmp_path, folder):
    """A tile that kills its worker is listed; the others are done, and --resume does it."""
    kill = "if ins['X'].min() > 50 and ins['Y'].max() < 30: os.kill(os.getpid(), signal.SIGKILL)"
    run = command(
        tmp_path / "job.json",
        pipeline(folder, tmp_path / "o_#.laz", python_filter(kill)),
        *("--workers", str(WORKERS), "--per", "tile", "--report", str(tmp_path / "r.json")),
    )
    _, err = run.communicate(timeout=300)
    assert run.returncode == 1
    assert "tile 60_0: its worker process died" in err and "--resume" in err
    report = json.loads((tmp_path / "r.json").read_text())
    assert [tile["name"] for tile in report["tiles"] if tile["state"] == "failed"] == ["60_0"]
    assert len(list(tmp_path.glob("o_*.laz"))) == 7 and not clouds.hidden(tmp_path)


def test_points_of_a_tile_do_not_stay(request):
    """Pipelines refer to themselves; a command's collector leaves them for hundreds of tiles."""
    gc.disable()
    request.addfinalizer(gc.enable)
    seen = []

    def task():
        points = type("Points", (), {})()
        points.own = points
        seen.append(weakref.ref(points))

    workers.ThisProcess(1).submit(task)
    assert seen[0]() is None


def test_a_reason_of_several_tiles_is_told_once(tmp_path, folder, capsys):
    given = {"type": "filters.hag_morphological", "given_ground": True}  # of which there is none
    stages = pipeline(folder, tmp_path / "o_#.laz", given)
    (tmp_path / "job.json").write_text(json.dumps(stages))
    words = ["--tile", "40", "--buffer", "0", "--workers", "0", "--no-progress"]
    assert main(["pipeline", str(tmp_path / "job.json"), *words]) == 1
    said = capsys.readouterr().err
    assert said.count("no ground is given") == 1 and "tile 0_0, tile 40_0: " in said, said


def test_a_failure_of_every_tile_stops_the_run(tmp_path, folder):
    with pytest.raises(StageError, match="all failed for the same reason"):
        fails = python_filter("raise ValueError('no')")
        run_tiled(pipeline(folder, tmp_path / "o_#.laz", fails), 10, workers=0, buffer=0.0)
    assert not list(tmp_path.iterdir())


# ---- disks -----------------------------------------------------------------------------------------------


def test_full_disk_leaves_nothing_half_written(tmp_path, folder, expected):
    """A limit on the size of files stands for a full disk: writes fail in the middle."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    room = max(map(len, expected.values())) // 2
    stages = pipeline(folder, tmp_path / "o_#.laz")
    run = command(tmp_path / "job.json", stages, "--workers", "0", preexec_fn=limit)
    _, err = run.communicate(timeout=300)
    assert run.returncode == 1 and "the temporary file could not be written" in err
    assert "Make room on the disk" in err and "that need it" not in err  # which are not to blame
    assert [path.name for path in tmp_path.iterdir()] == ["job.json"]
    assert not run_tiled(stages, 20, workers=0, resume=True, buffer=0.0).failures
    check_same(tmp_path, expected)


# ---- inputs ----------------------------------------------------------------------------------------------


def test_unreadable_input(tmp_path, folder, expected):
    """Its neighbors' seam tiles fail, all others are done; once repaired, --resume runs only what is missing."""
    inputs = tmp_path / "in"
    inputs.mkdir()
    for name in ("east", "west"):
        (inputs / f"{name}.laz").write_bytes((folder / f"{name}.laz").read_bytes())
    good = (inputs / "east.laz").read_bytes()
    (inputs / "east.laz").write_bytes(good[: len(good) // 2])
    stages = pipeline(inputs, tmp_path / "o_#.laz")
    run = run_tiled(stages, 10, workers=0)
    ((what, why),) = run.failures  # told once, whatever waits for it
    assert (
        "east.laz" in what
        and "damaged" in why
        and "tiles and outputs that need it are not made" in why
    )
    # West of x = 30 no tile sees the broken file; beside it, neighbors would be missing.
    states = {job.name: job.state for job in run.tiles}
    assert states["20_0"] == states["0_20"] == "done" and states["30_0"] == "failed"
    assert not list(tmp_path.glob("o_*")) and not clouds.hidden(tmp_path)
    (inputs / "east.laz").write_bytes(good)
    run = run_tiled(stages, 10, workers=0, resume=True)
    assert not run.failures
    check_same(tmp_path, expected)
    for path in inputs.iterdir():
        path.write_bytes(b"gone")
    with pytest.raises(StageError, match="none of the inputs"):
        run_tiled(stages, 20, workers=0)


def test_an_input_without_points_gets_what_the_others_get(tmp_path, folder, expected, write_las):
    """Its extra dimensions too, though no tile made any of its points."""
    inputs = tmp_path / "in"
    shutil.copytree(folder, inputs)
    write_las(inputs / "nothing.laz", {name: np.empty(0) for name in "XYZ"}, point_format=6)
    run = run_tiled(pipeline(inputs, tmp_path / "o_#.laz"), 20, workers=0)
    assert not run.failures
    east, nothing = (laspy.read(tmp_path / f"o_{name}.laz") for name in ("east", "nothing"))
    assert len(nothing.points) == 0 and nothing.header.point_format == east.header.point_format
    check_same(tmp_path, expected)


def test_resume_does_only_what_changed(tmp_path, expected, folder):
    """Outputs that are gone, notes that are damaged, an input replaced by one of the same size and time, other options."""
    inputs = tmp_path / "in"
    inputs.mkdir()
    for path in folder.glob("*.laz"):
        laspy.read(path).write(inputs / f"{path.stem}.las")
    stages = pipeline(inputs, tmp_path / "o_#.las")
    stages[0]["filename"] = str(inputs / "*.las")
    run_tiled(stages, 20, workers=0)
    first = {path.name: path.read_bytes() for path in tmp_path.glob("o_*.las")}

    def again() -> dict[str, int]:
        run = run_tiled(stages, 20, workers=0, resume=True)
        assert not run.failures
        return run.summary["states"] | {Path(o.source.path).stem: o.state for o in run.outputs}

    assert again() == {"done": 0, "kept": 8, "failed": 0, "west": "kept", "east": "kept"}
    (tmp_path / "o_west.las").unlink()
    result = again()
    assert (result["west"], result["east"]) == ("done", "kept") and result["done"] == 4
    notes = sorted((tmp_path / ".pdal-stages" / "kept").iterdir())
    assert {path.suffix for path in notes} == {".json"}
    for number, path in enumerate(notes):
        data = path.read_bytes()
        path.write_bytes(
            data[: len(data) // 2] if number % 2 else b'[{"fingerprint": 3}, null, 1e999]'
        )
    assert again()["done"] == 8
    assert {path.name: path.read_bytes() for path in tmp_path.glob("o_*.las")} == first
    path = inputs / "west.las"
    status, las = path.stat(), laspy.read(path)
    las.z = np.asarray(las.z) + 1
    las.write(path)
    assert path.stat().st_size == status.st_size
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert again()["done"] >= 4
    (tmp_path / "link").hardlink_to(path)  # as programs that make backups do
    path.chmod(0o600)
    assert again()["kept"] == 8
    stages[1]["cell"] = 3  # another pipeline: nothing of the old one counts
    assert again()["done"] == 8


# ---- people ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("per", ["file", "tile"])
def test_outputs_that_a_person_edited_are_kept_and_named(tmp_path, folder, capsys, per):
    """Also where their input changed since; copies are no edits; those of removed inputs are named."""
    inputs, out = tmp_path / "in", tmp_path / "out"
    inputs.mkdir()
    for path in folder.glob("*.laz"):
        shutil.copy(path, inputs)
    job = tmp_path / "job.json"
    job.write_text(json.dumps(pipeline(inputs, out / "o_#.laz")))

    def run(*words):
        flags = ["--tile", "40", "--workers", "0", "--per", per, "--no-progress", *words]
        assert main(["pipeline", str(job), *flags]) == 0
        return capsys.readouterr().err

    run()
    first, edited = sorted(out.glob("*.laz"))
    written = {path: path.read_bytes() for path in (first, edited)}
    las = laspy.read(edited)
    las.classification[:100] = 6
    las.write(edited)
    shutil.copy(first, tmp_path / "copy.laz")  # the same bytes at another time
    shutil.copy(tmp_path / "copy.laz", first)
    kept = edited.read_bytes()
    said = run("--resume")
    assert f"edited since they were written are kept (--overwrite replaces them): {edited}" in said
    assert edited.read_bytes() == kept and str(first) not in said
    for path in inputs.glob("*.laz"):
        las = laspy.read(path)
        las.intensity[:] = 7
        las.write(path)
    assert str(edited) in run("--resume")
    assert edited.read_bytes() == kept and set(laspy.read(first).intensity) == {7}
    assert "edited" not in run("--resume", "--overwrite")
    assert set(laspy.read(edited).intensity) == {7} and edited.read_bytes() not in (
        kept,
        written[edited],
    )
    assert "edited" not in run("--resume")
    (inputs / "east.laz").unlink()
    gone = out / "o_east.laz" if per == "file" else max(out.glob("*.laz"))
    assert f"outputs of inputs that are not among those of this run: {gone}" in run("--resume")
    gone.unlink()
    assert "output" not in run("--resume")


def test_the_workers_stop_too(tmp_path, folder, expected):
    """Where the run is killed; what was done is kept."""
    begun, killed = tmp_path / "begun", tmp_path / "killed"
    begun.mkdir()
    # All but two tiles wait until the run was killed, however slow this test is.
    wait = f"""for number in range(2):
    try:
        open(f'{begun}/{{number}}', 'x').close()
        break
    except FileExistsError:
        pass
else:
    while not os.path.exists({str(killed)!r}):
        time.sleep(0.05)"""
    stages = pipeline(folder, tmp_path / "o_#.laz", python_filter(wait))
    done = tmp_path / ".pdal-stages" / "kept"
    run = command(tmp_path / "job.json", stages, "--workers", str(WORKERS), start_new_session=True)
    until = time.monotonic() + _PATIENCE
    while len([note for note in done.glob("*_*.json") if "round" not in note.name]) < 2:
        assert run.poll() is None and time.monotonic() < until, run.communicate()
        time.sleep(0.02)
    workers = _workers(run.pid)
    run.kill()
    run.communicate(timeout=60)
    assert workers and not any(map(_lives, workers)) and not list(tmp_path.glob("o_*"))
    killed.touch()
    again = run_tiled(stages, 20, workers=0, resume=True, buffer=0.0)
    assert not again.failures and again.summary["states"]["kept"] >= 2
    check_same(tmp_path, expected)


def _workers(parent: int) -> list[int]:
    """Children that are workers, or about to become ones, not programs that were asked something."""
    results = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            inside = int(status.read_text().rpartition(")")[2].split()[1]) == parent
            if inside and b"base.processes" in (status.parent / "cmdline").read_bytes():
                results.append(int(status.parent.name))
    return results


def _lives(process: int) -> bool:
    """Whether a process still lives, after some grace: on a busy machine it needs a while to end."""
    for _ in range(600):
        try:
            if Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return False
        except OSError:
            return False
        time.sleep(0.1)
    return True


def test_two_runs_into_one_folder(tmp_path, folder):
    stages = pipeline(folder, tmp_path / "o_#.laz")
    with Store(tmp_path):
        with pytest.raises(StageError, match="another run") as caught:
            run_tiled(stages, 20, workers=0)
        assert str(os.getpid()) in str(caught.value)
    with Store(tmp_path):
        pass


def test_a_straggler_of_an_ended_run_changes_nothing(tmp_path, folder, monkeypatch):
    """What a cluster's worker still does for a run that was killed: it is refused when its file is to get its name."""
    stages = pipeline(folder, tmp_path / "o_#.laz")
    late = []
    monkeypatch.setattr(
        workers, "perform_task", lambda task: late.append(pickle.dumps(task)) or perform_task(task)
    )
    assert not run_tiled(stages, 40, workers=0).failures
    late = [task for task in map(pickle.loads, late) if not isinstance(task, partial)]
    monkeypatch.undo()
    assert not run_tiled(stages, 40, workers=0).failures  # the run after
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    for task in late:
        assert perform_task(task).reason
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()} == before


def test_the_command_says_what_is_missing(tmp_path, folder, capsys):
    job = tmp_path / "job.json"
    (tmp_path / "file").write_bytes(b"no folder")
    job.write_text(json.dumps(pipeline(folder, tmp_path / "file" / "none" / "o_#.laz")))
    assert main(["pipeline", str(job), "--tile", "20"]) == 1
    assert "the folder of the output cannot be created" in capsys.readouterr().err
    for flag in ("--resume", "--dry-run"):
        assert main(["pipeline", str(job), flag]) == 1
        assert f"{flag} needs --tile" in capsys.readouterr().err


# ---- workers and what they listen to ----------------------------------------------------------------------


def test_nothing_listens_and_nothing_is_imported_from_the_current_folder(
    tmp_path, folder, expected
):
    """Neither the run nor its workers open a port, and modules that lie about are not taken for Python's own."""
    here = tmp_path / "here"
    here.mkdir()
    for name in ("signal", "struct", "numpy", "laspy", "pickle", "pdal_stages"):
        (here / f"{name}.py").write_text(
            f"open({str(tmp_path / 'taken')!r}, 'a').write('{name} ')\n"
        )
    look = f"""
inodes = set()
for process in (os.getpid(), os.getppid()):
    for link in os.listdir(f'/proc/{{process}}/fd'):
        try:
            inodes.add(os.readlink(f'/proc/{{process}}/fd/{{link}}'))
        except OSError:
            pass
for table in ('tcp', 'tcp6', 'udp', 'udp6'):
    for line in open(f'/proc/self/net/{{table}}').readlines()[1:]:
        if f'socket:[{{line.split()[9]}}]' in inodes:
            open({str(tmp_path / "sockets")!r}, 'a').write(line)
open({str(tmp_path / "looked")!r}, 'a').write('x')"""
    stages = pipeline(folder, tmp_path / "o_#.laz", python_filter(look))
    (here / "job.json").write_text(json.dumps(stages))
    root = str(Path(__file__).resolve().parents[1])
    program = (
        f"import sys; sys.path[0] = {root!r}; from pdal_stages.cli import main; sys.exit(main())"
    )
    words = ["pipeline", "job.json", "--tile", "20", "--buffer", "0", "--workers", str(WORKERS)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", program, *words], cwd=here, env=environment)
    assert done.returncode == 0
    assert (tmp_path / "looked").read_text() == "x" * 8
    assert not (tmp_path / "sockets").exists() and not (tmp_path / "taken").exists()
    check_same(tmp_path, expected)


def test_stopped_while_workers_start(tmp_path, folder):
    run = command(
        tmp_path / "job.json",
        pipeline(folder, tmp_path / "o_#.laz", python_filter("time.sleep(5)")),
        *("--workers", str(WORKERS)),
        start_new_session=True,
    )
    until = time.monotonic() + _PATIENCE
    while not _workers(run.pid):
        assert run.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    time.sleep(0.2)
    workers = _workers(run.pid)
    os.killpg(run.pid, signal.SIGTERM)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 130 and "Traceback" not in err and len(err.splitlines()) < 5, err
    assert not any(map(_lives, workers)) and not clouds.hidden(tmp_path)


def test_a_name_that_is_not_utf8(tmp_path, folder, capsys):
    """It is told, and the report is written."""
    try:
        shutil.copy(folder / "west.laz", tmp_path / os.fsdecode(b"w\xe4st.laz"))
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    shutil.copy(folder / "east.laz", tmp_path)
    from pdal_stages.cli import main

    (tmp_path / "job.json").write_text(json.dumps(pipeline(tmp_path, tmp_path / "o_#.laz")))
    report = tmp_path / "r.json"
    words = ["--tile", "40", "--workers", "0", "--report", str(report)]
    assert main(["pipeline", str(tmp_path / "job.json"), *words]) == 1
    assert "the name of the file is not UTF-8" in capsys.readouterr().err
    assert "w\\udce4st" in report.read_text()


# ---- what a run keeps -------------------------------------------------------------------------------------


def test_damaged_results_are_made_anew(tmp_path, folder, expected, monkeypatch):
    stages = pipeline(folder, tmp_path / "o_#.laz")
    with monkeypatch.context() as patch:
        patch.setattr(plan_run, "write_file", lambda *_: 1 / 0)
        assert run_tiled(stages, 20, workers=0).failures
    result = min((tmp_path / ".pdal-stages" / "kept").glob("*.npz"))
    then, data = result.stat().st_mtime_ns, bytearray(result.read_bytes())
    with zipfile.ZipFile(result) as archive:
        largest = max(archive.infolist(), key=lambda member: member.file_size)
    data[largest.header_offset + largest.file_size] ^= 1
    result.write_bytes(data)
    os.utime(result, ns=(then, then))
    for note in result.parent.glob(
        "*.json"
    ):  # of inputs; those of tiles are held against their marks
        if "cells" in (data_values := json.loads(note.read_text())):
            note.write_text(json.dumps({**data_values, "count": "x"}))
    run = run_tiled(stages, 20, workers=0, resume=True)
    assert (
        run.failures and "cannot be read back" in run.failures[0][1]
    )  # found when it is read, not before
    assert not run_tiled(stages, 20, workers=0, resume=True).failures
    check_same(tmp_path, expected)


def test_links_in_place_of_the_runs_own_folders(tmp_path, folder):
    """Nothing is removed, locked or written where a link leads to."""
    precious = tmp_path / "precious"
    for name in ("kept", "scratch"):
        (precious / name).mkdir(parents=True)
        (precious / name / "file").write_text("mine")
    (precious / "lock").write_text("mine")
    before = {p: p.read_text() for p in precious.rglob("*") if p.is_file()}
    stages = pipeline(folder, tmp_path / "o_#.laz")
    store = tmp_path / ".pdal-stages"
    store.symlink_to(precious)
    with pytest.raises(StageError, match="is a link"):
        run_tiled(stages, 20, workers=0)
    assert {p: p.read_text() for p in precious.rglob("*") if p.is_file()} == before


# ---- what changes meanwhile, or between two runs ----------------------------------------------------------


def test_a_far_input_that_a_widened_tile_read(tmp_path, write_las):
    """A tile is done again when anything changed that was read for it, farther away than its usual surroundings too."""
    rng = np.random.default_rng(2)
    for name, x0 in (("a", 0.0), ("b", 60.0), ("c", 120.0)):
        xyz = rng.uniform(0, 1, (60, 3)) * (59.9, 60, 5) + (x0, 0, 0)
        write_las(tmp_path / f"{name}.las", dict(zip("XYZ", xyz.T, strict=True)))
    features = {
        "type": "filters.multiscalefeatures",
        "neighborhoods": "kopt(10,80)",
        "feature_set": "Linearity",
    }
    writer = {"type": "writers.las", "filename": str(tmp_path / "o_#.las"), "extra_dims": "all"}
    stages = [{"type": "readers.las", "filename": str(tmp_path / "?.las")}, features, writer]
    first = run_tiled(stages, 60, workers=0)
    wide = {job.name: job.record.halo_m for job in first.tiles}
    assert wide["0_0"] > 60, wide  # which reaches c
    xyz = rng.uniform(0, 1, (60, 3)) * (59.9, 60, 5) + (120, 0, 0)
    write_las(tmp_path / "c.las", dict(zip("XYZ", xyz.T, strict=True)))
    again = run_tiled(stages, 60, workers=0, resume=True)
    got = {path.name: path.read_bytes() for path in tmp_path.glob("o_*.las")}
    assert {job.name: job.state for job in again.tiles}["0_0"] == "done"
    run_tiled(stages, 60, workers=0)
    assert got == {path.name: path.read_bytes() for path in tmp_path.glob("o_*.las")}


def test_a_file_that_pdals_own_stages_read(tmp_path, folder):
    polygons = tmp_path / "p.geojson"
    overlay = {
        "type": "filters.overlay",
        "dimension": "Classification",
        "datasource": str(polygons),
        "column": "c",
    }
    stages = pipeline(folder, tmp_path / "o_#.laz", overlay)
    square = {
        "type": "Polygon",
        "coordinates": [[[-1, -1], [99, -1], [99, 99], [-1, 99], [-1, -1]]],
    }
    for code in (5, 6):
        feature = {"type": "Feature", "properties": {"c": code}, "geometry": square}
        polygons.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
        run = run_tiled(stages, 40, workers=0, resume=True)
        assert not run.failures and {o.state for o in run.outputs} == {"done"}
        assert (np.asarray(laspy.read(tmp_path / "o_west.laz").classification) == code).all()


def test_a_file_that_changes_during_the_run_is_told(tmp_path, folder):
    """Outputs may then be made of both; a later run makes them anew."""
    inputs = tmp_path / "in"
    inputs.mkdir()
    for path in folder.glob("*.laz"):
        (inputs / path.name).write_bytes(path.read_bytes())
    flag, east = tmp_path / "flag", inputs / "east.laz"
    change = f"""if not os.path.exists({str(flag)!r}):
    open({str(flag)!r}, 'w').close()
    os.utime({str(east)!r}, (1, 1))"""
    run = run_tiled(
        pipeline(inputs, tmp_path / "o_#.laz", python_filter(change)), 40, workers=0, buffer=0.0
    )
    assert [what for what, _ in run.failures] == [str(east)]
    assert "changed during the run" in run.failures[0][1] and "--resume" in run.failures[0][1]


# ---- clusters --------------------------------------------------------------------------------------------


def dask(what: str, folder: Path, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--no-dashboard", *words]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(
        [*command, "--scheduler-file", str(folder / "note.json")], cwd=folder, **quiet
    )


def test_a_cluster(tmp_path, folder, expected, monkeypatch):
    """Workers of another version, or that do not see the folder, are refused; the result is the same; a lost one is told."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(dask_cluster, "_ASK", 0.5)
    monkeypatch.setattr(dask_cluster, "_CONNECT", 1.0)
    stages = pipeline(folder, tmp_path / "o_#.laz")
    with pytest.raises(StageError, match="cannot be reached"):
        run_tiled(stages, 20, scheduler="tcp://127.0.0.1:9")
    # Whoever is waited for here comes, but on a busy machine late; Dask itself gives up after 30 s.
    for name in ("_CONNECT", "_WAIT"):
        monkeypatch.setattr(dask_cluster, name, _PATIENCE)
    late = {f"distributed.comm.timeouts.{each}": f"{_PATIENCE:.0f}s" for each in ("connect", "tcp")}
    config = pytest.importorskip("dask").config
    monkeypatch.setenv("DASK_INTERNAL_INHERIT_CONFIG", config.serialize(late))
    alone = ("--no-nanny", "--nthreads", "1", "--memory-limit", "0")
    scheduler = dask("scheduler", tmp_path, "--host", "127.0.0.1", "--port", "0")
    worker = dask("worker", tmp_path, *alone)
    try:
        until = time.monotonic() + _PATIENCE
        while not [n for n in tmp_path.glob("note.json") if n.stat().st_size]:
            assert scheduler.poll() is None and time.monotonic() < until
            time.sleep(0.1)
        address = json.loads((tmp_path / "note.json").read_text())["address"]
        with (
            monkeypatch.context() as patch,
            pytest.raises(StageError, match="other versions") as caught,
        ):
            patch.setattr(dask_cluster, "build", lambda: "0.0.9 (0)")
            run_tiled(stages, 20, scheduler=address)
        assert "0.0.9" in str(caught.value) and not list(tmp_path.glob("o_*"))
        run = run_tiled(stages, 20, scheduler=address)
        assert not run.failures and run.summary["workers"] == 1
        check_same(tmp_path, expected)
        flag = tmp_path / "working"
        slow = pipeline(
            folder,
            tmp_path / "o_#.laz",
            python_filter(f"open({str(flag)!r}, 'w').close(); time.sleep(0.3)"),
        )

        def kill(process: subprocess.Popen) -> None:
            while not flag.exists():
                time.sleep(0.05)
            monkeypatch.setattr(dask_cluster, "_WAIT", 1.0)
            process.kill()

        for process, lost in (
            (worker, "workers of the Dask scheduler are gone"),
            (scheduler, "any more"),
        ):
            monkeypatch.setattr(dask_cluster, "_WAIT", _PATIENCE)
            flag.unlink(missing_ok=True)
            threading.Thread(target=kill, args=(process,), daemon=True).start()
            with pytest.raises(StageError, match=lost) as caught:
                run_tiled(slow, 20, scheduler=address, buffer=0.0)
            assert "--resume" in str(caught.value)
            process.wait()
            if process is worker:
                worker = dask("worker", tmp_path, *alone)
        assert not run_tiled(slow, 40, workers=0, buffer=0.0).failures
        check_same(tmp_path, expected)
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()


def test_a_failure_on_another_host_names_it(tmp_path):
    task = pickle.dumps(failing)
    answer = dask_cluster.perform_for(dask_cluster._versions(), str(tmp_path), "another host", task)
    assert answer.reason == f"on {socket.gethostname()}: it failed."


def failing():
    raise StageError("it failed")


def test_large_tasks_that_no_worker_reads():
    """Whether a worker dies or the run is stopped, the process ends; Python before 3.11.5 would wait."""
    script = """if True:
        import os, signal, time
        from pdal_stages.pipeline.workers import WorkerProcesses
        with WorkerProcesses(1, 1) as workers:
            for killed in (True, False):
                task = workers.submit(bytes(10**7).hex)
                os.kill(workers._busy[task].pid, signal.SIGSTOP)
                time.sleep(0.5)
                if killed:
                    os.kill(workers._busy[task].pid, signal.SIGKILL)
                    workers.wait([task])
    """
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 0 and not ended.stderr, ended.stderr
