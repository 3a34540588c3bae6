"""The QGIS plugin: packed, installed into a profile of its own, run by `qgis_process` and QGIS's Python, without a screen.

What needs no QGIS (finding the program, running and canceling it) is tested everywhere.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
import time
import zipfile
from pathlib import Path

import laspy
import numpy as np
import pytest
from processes import ended, printed

from pdal_stages.base.version import __version__
from pdal_stages.cli import main

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "qgis" / "pdal_stages"
#: Debian's wrapper hands on an option that the program does not know.
PROCESS = next(filter(None, map(shutil.which, ("qgis_process.bin", "qgis_process"))), None)
needs_qgis = pytest.mark.skipif(PROCESS is None, reason="QGIS is not installed (no qgis_process)")


@pytest.fixture(scope="module")
def package():
    """The plugin's modules that need no QGIS."""
    spec = importlib.util.spec_from_file_location(
        "qgis_plugin", SOURCE / "__init__.py", submodule_search_locations=[str(SOURCE)]
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules["qgis_plugin"] = module
    spec.loader.exec_module(module)
    yield module
    for name in [name for name in sys.modules if name.startswith("qgis_plugin")]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def environment(package):
    return importlib.import_module("qgis_plugin.environment")


@pytest.fixture(scope="module")
def running(package):
    return importlib.import_module("qgis_plugin.running")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """This checkout's pdal-stages, as an environment of its own would hold it."""
    path = tmp_path_factory.mktemp("environment") / "bin" / "pdal-stages"
    path.parent.mkdir()
    path.write_text(
        f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m pdal_stages.cli "$@"\n'
    )
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def zipped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    packing = {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    return Path(printed(ROOT / "scripts" / "qgis-plugin", folder, env=packing).strip())


class Feedback:
    def __init__(self, cancel_after=None):
        self.lines, self.progress = [], []
        self.cancel_at = None if cancel_after is None else time.monotonic() + cancel_after

    def isCanceled(self):
        return self.cancel_at is not None and time.monotonic() > self.cancel_at

    def pushInfo(self, text):
        self.lines.append(text)

    pushCommandInfo = pushWarning = setProgressText = pushInfo

    def setProgress(self, value):
        self.progress.append(value)


def script(folder, text):
    path = folder / "pdal-stages"
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return str(path)


# ---- without QGIS ----------------------------------------------------------------------------------------


def test_found_by_itself(environment, program, tmp_path, monkeypatch):
    monkeypatch.delenv("PDAL_STAGES_PROGRAM", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("PATH", "/usr/bin")
    with pytest.raises(environment.Missing, match=r"was not found.*Install pdal-stages"):
        environment.find()
    assert environment.find(str(program)) == str(program)
    assert environment.find(str(program.parent.parent)) == str(program)  # the environment's folder
    inside = tmp_path / "miniforge3" / "envs" / "lidar" / "bin"
    inside.mkdir(parents=True)
    shutil.copy(program, inside)
    assert environment.find() == str(inside / "pdal-stages")
    elsewhere = tmp_path / "elsewhere" / "bin"
    elsewhere.mkdir(parents=True)
    shutil.copy(program, elsewhere)
    (tmp_path / ".conda").mkdir()
    (tmp_path / ".conda" / "environments.txt").write_text(
        f"{tmp_path / 'gone'}\n{elsewhere.parent}\n"
    )
    assert environment.find() == str(elsewhere / "pdal-stages")
    monkeypatch.setenv("PATH", str(program.parent))
    assert environment.find() == str(program)
    with pytest.raises(environment.Missing, match="no program pdal-stages at /nowhere"):
        environment.find("/nowhere")


def test_forms_follow_the_command(capsys):
    """Arguments stand in the JSON with the words of --help."""
    assert main(["commands", "--showjson"]) == 0
    description = json.loads(capsys.readouterr().out)
    arguments = {
        argument["name"]: argument for argument in description["commands"]["classify"]["arguments"]
    }
    assert arguments["inputs"]["many"] and arguments["inputs"]["required"]
    assert arguments["noise"] | {"help": ""} == {
        "name": "noise", "flag": "--noise", "off": "--no-noise", "kind": "boolean", "help": "", "default": True,
        "choices": [], "required": False, "many": False, "value": "",
    }  # fmt: skip
    assert arguments["per"]["choices"] == ["file", "tile"]
    assert "1/32 (3 cm" in arguments["dimensions"]["help"]
    options = {
        argument["name"]: argument
        for argument in description["stages"]["filters.hag_morphological"]["options"]
    }
    assert options["window"]["default"] == 18.0 and options["window"]["exclusive"]


def test_run_tells_progress_and_messages(running, tmp_path):
    program = script(
        tmp_path,
        "import sys\nprint('filters.x: 1,200 of 4,800 points (25 %), 10 points/s', file=sys.stderr)\n"
        "print('pdal-stages: mind this', file=sys.stderr)\nprint(sys.stdin.read())\n",
    )
    feedback = Feedback()
    assert running.run(program, ["a b"], feedback, "grüße") == "grüße"
    assert feedback.progress == [25.0] and "filters.x" in feedback.lines
    assert feedback.lines[0] == "pdal-stages 'a b'" and "pdal-stages: mind this" in feedback.lines


def test_run_fails_with_the_message(running, tmp_path):
    program = script(
        tmp_path, "import sys\nprint('pdal-stages: no such file', file=sys.stderr)\nsys.exit(1)"
    )
    with pytest.raises(running.Failed, match=r"^no such file$"):
        running.run(program, [], Feedback())
    with pytest.raises(running.Failed, match="exit code 3"):
        running.run(script(tmp_path, "raise SystemExit(3)"), [], Feedback())
    with pytest.raises(running.Failed, match="cannot be run"):
        running.run(str(tmp_path / "gone"), [], Feedback())


def runs(stat):
    """Return whether the process is there, and not only its entry in the table."""
    try:
        return stat.read_text().split(")")[-1].split()[0] != "Z"
    except OSError:
        return False


def test_cancel_ends_it_and_its_workers(running, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "PATIENCE", 1.0)
    pid = tmp_path / "pid"
    stubborn = (
        "import signal, subprocess, sys, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "worker = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        f"open({str(pid)!r}, 'w').write(str(worker.pid))\ntime.sleep(60)\n"
    )
    begun = time.monotonic()
    with pytest.raises(running.Failed, match="Canceled"):
        running.run(script(tmp_path, stubborn), [], Feedback(cancel_after=1.0))
    assert time.monotonic() - begun < 20
    worker = Path("/proc", pid.read_text(), "stat")
    while runs(worker) and time.monotonic() - begun < 20:  # what is killed ends a little later
        time.sleep(0.05)
    assert not runs(worker)


def test_zip_is_the_same_twice_and_complete(zipped):
    with zipfile.ZipFile(zipped) as packed:
        names = set(packed.namelist())
        forms = json.loads(packed.read("pdal_stages/commands.json"))
        about = packed.read("pdal_stages/metadata.txt").decode()
    files = {f"pdal_stages/{path.name}" for path in SOURCE.iterdir() if path.is_file()}
    assert names == files | {"pdal_stages/commands.json"}
    assert "pdal_stages/LICENSE" in names and "pdal_stages/icon.svg" in names
    assert forms["version"] == __version__ and f"version={__version__}\n" in about
    assert "hasProcessingProvider=yes" in about and "qgisMinimumVersion=3.22" in about
    before = zipped.read_bytes()
    packing = {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    printed(ROOT / "scripts" / "qgis-plugin", zipped.parent, env=packing)
    assert zipped.read_bytes() == before


# ---- with QGIS -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def profile(zipped, tmp_path_factory):
    """A profile of QGIS's with the plugin from the zip."""
    folder = tmp_path_factory.mktemp("profile")
    plugins = folder / "profiles" / "default" / "python" / "plugins"
    plugins.mkdir(parents=True)
    with zipfile.ZipFile(zipped) as packed:
        packed.extractall(plugins)
    return folder


@pytest.fixture(scope="module")
def clean_machine(profile, program):
    """QGIS's environment: a clean machine's, which knows where the program is."""
    runtime = profile / "runtime"
    runtime.mkdir(mode=0o700, exist_ok=True)
    return {
        "HOME": str(profile), "PATH": "/usr/bin:/bin", "LC_ALL": "C.UTF-8", "QT_QPA_PLATFORM": "offscreen",
        "XDG_RUNTIME_DIR": str(runtime), "QGIS_CUSTOM_CONFIG_PATH": str(profile), "PDAL_STAGES_PROGRAM": str(program),
    }  # fmt: skip


@pytest.fixture(scope="module")
def qgis(clean_machine):
    """Run qgis_process; what it printed."""

    def run(*words, code=0, **more):
        done = ended(PROCESS, *words, env={**clean_machine, **more})
        output = done.stdout + done.stderr
        assert (done.returncode == 0) == (code == 0), output
        return output

    run("plugins", "enable", "pdal_stages")
    return run


@pytest.fixture(scope="module")
def session(clean_machine, profile):
    """Run tests/qgis_session.py in QGIS's own Python."""

    def run(*words, **more):
        plugins = profile / "profiles/default/python/plugins"
        command = "/usr/bin/python3", ROOT / "tests" / "qgis_session.py", plugins
        return json.loads(printed(*command, *words, env={**clean_machine, **more}).splitlines()[-1])

    return run


@needs_qgis
def test_algorithms_are_listed(qgis):
    output = qgis("list")
    names = "classify classifysurvey heights terrainmodels surfaces report train accuracy review explain corrections objects check"
    for name in names.split():
        assert f"pdalstages:{name}\t" in output


@needs_qgis
def test_check_tells_what_is_there_and_what_is_missing(qgis):
    output = qgis("run", "pdalstages:check")
    assert f"VERSION:\t{__version__}" in output and "ok      shipped model" in output
    output = qgis("run", "pdalstages:check", code=1, PDAL_STAGES_PROGRAM="/nowhere")
    assert "no program pdal-stages at /nowhere" in output and "Install pdal-stages" in output


@needs_qgis
def test_parameters_are_the_commands_own(session, capsys):
    assert main(["commands", "--showjson"]) == 0
    forms = json.loads(capsys.readouterr().out)
    shown = session("parameters", "classifysurvey")["parameters"]
    for argument in forms["commands"]["classify"]["arguments"]:
        if argument["name"] in ("where", "memory", "workers", "polygons", "per"):
            assert shown[argument["name"].upper()][3] == argument["help"]
    assert shown["PER"][1] and not shown["MEMORY"][1]  # advanced, and not
    for name in ("BRIDGES", "VEGETATION_HEIGHTS"):
        assert name in shown and not shown[name][1]
    heights = session("parameters", "heights")["parameters"]
    assert heights["WINDOW"][2] == "18.0" and heights["WINDOW"][3].startswith(
        "Radius of the largest window"
    )


@pytest.fixture
def algorithm(qgis):
    """Run one of ours with parameters; what was printed."""

    def run(name, code=0, **parameters):
        words = [f"{key}={value}" for key, value in parameters.items()]
        return qgis("run", f"pdalstages:{name}", "--", *words, code=code)

    return run


@pytest.mark.pdal
@needs_qgis
def test_the_way_of_a_tile(algorithm, session, ready_town, run_job, tmp_path):
    """Classified, with heights, as rasters, as objects, judged: the same bytes as the commands give."""
    out = tmp_path / "with blanks ü"
    out.mkdir()
    cloud, heights = out / "c.laz", out / "h.laz"
    output = algorithm("classify", INPUT=ready_town, OUTPUT=cloud, MAP=out / "c.tif", NOISE=0)
    assert "pdal-stages classify --no-noise" in output and "6 Building" in output
    assert main(["classify", str(ready_town), str(tmp_path / "c.laz"), "--no-noise"]) == 0
    assert cloud.read_bytes() == (tmp_path / "c.laz").read_bytes()
    algorithm("heights", INPUT=ready_town, OUTPUT=heights, MAP=out / "h.tif", WINDOW=40)
    job = [
        str(ready_town),
        {"type": "filters.hag_morphological", "window": 40},
        str(tmp_path / "h.laz"),
    ]
    assert run_job(job, "--writers.las.extra_dims=all", "--writers.las.forward=all")[0] == 0
    ours, theirs = (laspy.read(path)["HeightAboveGround"] for path in (tmp_path / "h.laz", heights))
    assert np.array_equal(ours, theirs) and ours.max() > 3
    rasters = {"TERRAIN": out / "t.tif", "SURFACE": out / "s.tif", "HEIGHTS": out / "a.tif"}
    algorithm("terrainmodels", INPUT=cloud, GROUND_FROM=1, **rasters)
    output = algorithm("accuracy", INPUT=cloud, REFERENCE=ready_town, PAGE=out / "a.html")
    assert "Overall accuracy" in output and (out / "a.html").read_text().startswith("<!")
    pytest.importorskip("pyogrio")
    pytest.importorskip("rasterio")
    output = algorithm("surfaces", INPUTS=cloud, OUTPUT=out / "rasters", RESOLUTION=2)
    assert "% known" in output and len(list((out / "rasters").glob("*.tif"))) == 3
    algorithm("report", INPUTS=cloud, PAGE=out / "report.html", DENSITY=2)
    assert "Signature" in (out / "report.html").read_text()
    assert "1 building, " in algorithm("objects", INPUTS=cloud, OUTPUT=out / "o.gpkg")
    shown = session(
        "styles", out / "o.gpkg", out / "t.tif", heights.with_suffix(".tif"), out / "c.tif"
    )
    layers = {"terrain": "hillshade", "heights": "singlebandpseudocolor", "classes": "paletted"}
    assert shown["building"] == [214, 78, 60] and shown["layers"] | layers == shown["layers"]
    assert shown["layers"]["buildings"] == "RuleRenderer"
    output = algorithm("review", INPUTS=cloud, OUTPUT=out / "r.gpkg")
    assert (out / "r.gpkg").is_file(), output
    place = laspy.read(cloud).xyz[100]
    asked = {"INPUT": cloud, "POINT": f"{place[0]},{place[1]}", "PAGE": out / "why.html"}
    output = algorithm("explain", **asked, NOISE=0)
    assert "WHAT THE MODEL SEES" in output and "computed now" in (out / "why.html").read_text()
    marked = {"BEFORE": cloud, "AFTER": ready_town, "OUTPUT": out / "k.laz", "AROUND": 2}
    output = algorithm("corrections", code=1, **marked, AREA=out / "r.gpkg")
    assert "no patch is marked as checked" in output and not (out / "k.laz").exists()
    output = algorithm("corrections", **marked)
    words = ["corrections", str(cloud), str(ready_town), "--around", "2"]
    assert main([*words, "--out", str(tmp_path / "k.laz")]) == 0
    assert (out / "k.laz").read_bytes() == (tmp_path / "k.laz").read_bytes()
    assert np.count_nonzero(laspy.read(out / "k.laz")["Checked"]), output


@pytest.mark.pdal
@needs_qgis
def test_many_files_and_training(algorithm, ready_halves, ready_town, tmp_path):
    out, model = tmp_path / "out", tmp_path / "m.model"
    output = algorithm(
        "classifysurvey", FOLDER=ready_halves, OUTPUT=out, REPORT=tmp_path / "r.json", WORKERS=0
    )
    assert sorted(path.name for path in out.glob("*.laz")) == ["east.laz", "west.laz"], output
    assert (tmp_path / "r.json").is_file()
    few = {"COUNT": 50, "TREES": 5, "NEIGHBORHOODS": "k10"}
    output = algorithm("train", INPUTS=ready_town, MODEL=model, **few)
    assert output.count("blocks held out  overall accuracy") == 1
    algorithm("classify", INPUT=ready_town, MODEL=model, OUTPUT=tmp_path / "m.laz")
    assert (tmp_path / "m.laz").is_file()
