"""Every kind of output, and every way in which writing it may fail: the file is right, or there is an error and no file.

Kinds are listed from the code (calls that write, options and flags that name files, PDAL's writers), so a new one that
has no case fails the first test.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from writing_faults import CASES, OLDER

from pdal_stages.stages import registry

HERE = Path(__file__).resolve().parent
PACKAGE = HERE.parents[1] / "pdal_stages"

#: Functions that write, and a case that has them write; or why there is none.
_OWN = "a hidden folder or lock, which is empty"
_SCRATCH = "a file that only this process reads; tests of tiles and of training fill its disk"
_WHOLE = "through write_whole, of which other cases are"
SITES = {
    "alsnet/checkpoint:save": _WHOLE,
    "alsnet/epochs:_Session._save": _WHOLE,
    "base/complete:check_complete": "opens for fsync",
    "base/extrabytes:describe": "overwrites a few bytes of a hidden file; test_compact",
    "base/files:_locked_folder": _OWN,
    "base/files:_pour": "writes into devices and pipes; test_robust_outputs",
    "base/files:_remove_dead": _OWN,
    "base/files:write_whole": "metadata",
    "base/files:open_to_append": "adds lines to a log, and the run goes on without it; a test here",
    "base/las:supersede_copc": "overwrites a few bytes of a file already checked; test_newer_pdal",
    "classifier/clouds:_mapped.kept": _SCRATCH,
    "classifier/estimator:PointClassifier.save": "through classifier/modelfile:write",
    "classifier/modelfile:write": "model",
    "classifier/tiledcloud:TiledCloud.put": "train in tiles",
    "commands/pipelines:_expand": "expanded pipeline",
    "commands/running:ran": "metadata",
    "pipeline/las_output:_compress": "writers.las .laz 1.4",
    "commands/models:_compare_objects": _WHOLE,
    "pipeline/correcting:_write": _WHOLE,
    "pipeline/reviewing:write_review": _WHOLE,
    "pipeline/run:Pipeline._execute": "writers.las .las",
    "plugin/building:install": "a shared library, by the compiler; test_plugin",
    "plugin/declarations:write": "a header that a compiler reads; test_plugin",
    "plugin/doctor:_program.run": _SCRATCH,
    "reports/objectlayers:write_layers": "objects .geojson",
    "reports/accuracypage:write_accuracy_report": "accuracy html",
    "reports/modelpage:write_model_report": "model page",
    "reports/pictures:png": "writes into memory",
    "reports/pictures:write_png": _WHOLE,
    "reports/runpage:write_run_report": "tiles: report .html",
    "stages/accuracy:AccuracyStage.compare": "accuracy json",
    "stages/classifiermodel:ClassifierModel.finish": "model",
    "stages/multiscalefeatures:_write_bins": "thresholds",
    "synthetic/demo:_results": _WHOLE,
    "synthetic/demo:_work": _WHOLE,
    "synthetic/demo:run_demo": _WHOLE,
    "synthetic/townfile:write_town": "town",
    "tiling/adapting:AdaptTask.run": "adapted model",
    "tiling/classify:classify_file": "metadata of classify",
    "tiling/command:_classify_each": "metadata of classify",
    "tiling/objects:_write": _WHOLE,
    "tiling/command:_write_json": "tiles: report .json",
    "tiling/inparts:_Joined.add": "tiles: output of a file",
    "tiling/inparts:write_in_parts": "tiles: output of a file",
    "tiling/index:sort_points": "tiles: what a run keeps",
    "tiling/lasfiles:write_records": _SCRATCH,
    "tiling/objects:keep_cells": "objects: what a run keeps",
    "tiling/kept:save_arrays": "tiles: what a run keeps",
    "tiling/store:_keep": "tiles: what a run keeps",
    "tiling/store:_open_own": "tiles: what a run keeps",
    "tiling/tail:run_tail": "tiles: output of a tile",
    "tiling/tile_task:TileTask.run": "tiles: what a run keeps",
    "pipeline/worker:serve": "opens pipes",
}
#: PDAL's writers without a case.
LEFT_OUT = {
    "writers.null": "writes nothing",
    "writers.ept_addon": "writes into an EPT source, in place",
    "writers.raster": "writes what other stages made; as writers.gdal",
}
_WRITING = {"write_whole", "whole_files"}
_METHODS = {
    "write_text",
    "write_bytes",
    "savez",
    "save",
    "savetxt",
    "tofile",
    "mkstemp",
    "mkdtemp",
    "NamedTemporaryFile",
}


def writing_sites() -> set[str]:
    """Functions of the package that open or replace files."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        module = path.relative_to(PACKAGE).with_suffix("").as_posix()
        stack: list[str] = []

        def visit(node: ast.AST, module=module, stack=stack) -> None:
            named = isinstance(node, ast.FunctionDef | ast.ClassDef)
            if named:
                stack.append(node.name)
            if isinstance(node, ast.Call) and _writes(node):
                found.add(f"{module}:{'.'.join(stack)}")
            for child in ast.iter_child_nodes(node):
                visit(child)
            if named:
                stack.pop()

        visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


def _writes(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name in _WRITING or name in _METHODS:
        return True
    if name not in ("open", "fdopen", "ZipFile"):
        return False
    words = [*call.args, *(keyword.value for keyword in call.keywords if keyword.arg in (None, "mode"))]
    modes = [w.value for w in words if isinstance(w, ast.Constant) and isinstance(w.value, str)]
    return any(set(mode) <= set("rwaxbt+") and set(mode) & set("wax+") for mode in modes) or any(
        isinstance(w, ast.BinOp)
        for w in words  # flags of os.open
    )


def test_every_place_that_writes_is_known():
    assert writing_sites() == set(SITES), (
        "give a new place a case in writing_faults.py, or say here why it has none"
    )


@pytest.mark.pdal
def test_every_writer_of_pdal_has_a_case(pdal_program):
    drivers = json.loads(
        subprocess.run([pdal_program, "--drivers", "--showjson"], capture_output=True, check=True).stdout
    )
    writers = {driver["name"] for driver in drivers if driver["name"].startswith("writers.")}
    writers -= set(registry.stages())  # where the native stages are installed
    tested = {case.split()[0] for case in CASES}
    known = {"writers.copc", "writers.draco", "writers.e57", "writers.fbi", "writers.gdal", "writers.matlab", "writers.nitf",
             "writers.pgpointcloud", "writers.rdb", "writers.tiledb", "writers.arrow", "writers.ept_addon", "writers.numpy"}  # fmt: skip
    assert not writers - tested - set(LEFT_OUT) - known, "PDAL has a writer that no case and no reason names"


@pytest.fixture(scope="module")
def results(tmp_path_factory, pdal_program):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("failing writes are made by a small C library, on Linux")
    folder = tmp_path_factory.mktemp("faulty")
    shim = folder / "faulty.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", shim, HERE / "faulty.c", "-ldl"], check=True)
    environment = {**os.environ, "LD_PRELOAD": str(shim), "PDAL_STAGES_PROGRESS": "0"}
    words = [sys.executable, HERE / "writing_faults.py", folder]
    with open(folder / "errors", "w") as errors:
        done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True)
    assert done.returncode == 0, (
        done.returncode,
        done.stdout[-2000:],
        (folder / "errors").read_text()[-2000:],
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.pdal
@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_writes_that_fail(results, case):
    mine = [row for row in results if row["case"] == case]
    good, *tries = mine
    if "Couldn't create writer stage" in good["said"]:
        pytest.skip(f"{case.split()[0]} was left out of this build")
    assert good["code"] == 0 and good["content"], good["said"]
    suffix = Path(CASES[case].output).suffix
    for row in tries:
        where = (case, row["kind"], row["after"], row["said"])
        assert "Traceback" not in row["said"], where
        assert not row["left"], where
        older = OLDER.get(suffix, b"").hex() if row["kind"] == "disk full" and CASES[case].older else None
        if row["code"] == 0:
            assert same(row["content"], good["content"], suffix, good["exact"]), where
        else:
            assert row["hits"] and row["code"] == 1 and "pdal-stages" in row["said"], where
            assert row["content"] == older or same(row["content"], good["content"], suffix, good["exact"]), (
                where
            )
    assert any(row["hits"] for row in tries), "no write was caught"


def same(content: str | None, good: str, suffix: str, exact: bool) -> bool:
    """Whether a file is what the undisturbed command writes, but for what takes its time or has its date."""
    if content is None:
        return False
    mine, theirs = bytes.fromhex(content), bytes.fromhex(good)
    if exact or mine == theirs:
        return mine == theirs
    if suffix == ".json":
        return shape(json.loads(mine)) == shape(json.loads(theirs))
    if suffix == ".html":
        return mine.rstrip().endswith(b"</html>") and abs(len(mine) - len(theirs)) < 200
    return len(mine) == len(theirs)


def shape(value):
    if isinstance(value, dict):
        return {key: shape(inner) for key, inner in value.items()}
    return [shape(inner) for inner in value] if isinstance(value, list) else type(value).__name__


@pytest.mark.pdal
def test_a_log_that_cannot_be_written(cell, tmp_path, cloud):
    path = tmp_path / "job.json"
    path.write_text(json.dumps([str(cloud), {"type": "filters.hag_minima"}, str(tmp_path / "o.las")]))
    it = cell("Outputs", "--log onto a cloud")
    (tmp_path / "other.las").write_bytes(cloud.read_bytes())
    it.refused(
        ["pipeline", path, "--log", tmp_path / "other.las"], "the log would be added to a LAS or LAZ file"
    )
    it = cell("Outputs", "--log and the output onto one file")
    done = it.command("pipeline", path, "--log", tmp_path / "o.las")
    assert done.code == 1 and "the log file is the output file too" in done.err
    if os.path.exists("/dev/full"):
        it = cell("Outputs", "--log on a full disk")
        done = it.runs(
            ["pipeline", path, "--log", "/dev/full"], "the run goes on, and says that its log does not"
        )
        assert "the log cannot be written any more: No space left on device" in done.err
