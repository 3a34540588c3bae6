"""Outputs: devices, pipes and links in their place, files that must not be replaced, names given twice."""

from __future__ import annotations

import json
import os
import shutil
import stat
import threading
from pathlib import Path

import laspy
import pytest
from robustness_kit import job
from test_robust_models import repack

from pdal_stages.classifier import load_model
from pdal_stages.tiling import run_tiled

pytestmark = [pytest.mark.pdal, pytest.mark.skipif(os.name == "nt", reason="devices and links of Unix")]

HAG = {"type": "filters.hag_minima"}
GROUP = "Outputs"
SMALL = ["--neighborhoods", "c1", "--count", "20", "--writers.classifiermodel.trees=2",
         "--writers.classifiermodel.feature_set=covariance", "--writers.classifiermodel.dimensions=Intensity"]  # fmt: skip


def device(name):
    """What must not change of a device."""
    found = os.lstat(name)
    return found.st_ino, found.st_mode, found.st_rdev


# ---- devices, pipes, links -----------------------------------------------------------------------------------


def test_devices(cell, tmp_path, cloud, model):
    plain = job(tmp_path, str(cloud), HAG)
    watched = ["/dev/null", "/dev/stdout", "/dev/stderr"]
    before = [device(name) for name in watched]
    it = cell(GROUP, "--metadata /dev/stdout")
    done = it.runs(it.process("pipeline", plain, "--metadata", "/dev/stdout"), "the metadata is printed")
    assert "filters.hag_minima" in json.loads(done.out)["metadata"]
    it = cell(GROUP, "expand -o /dev/stderr")
    done = it.runs(it.process("expand", plain, "-o", "/dev/stderr"), "the pipeline goes to standard error")
    assert json.loads(done.err)["pipeline"]
    it = cell(GROUP, "train --model /dev/null")
    it.runs(it.process("train", cloud, "--model", "/dev/null", *SMALL), "a model is trained and thrown away")
    it = cell(GROUP, "output /dev/null")
    it.runs(it.process("pipeline", job(tmp_path, str(cloud), {"type": "writers.las", "filename": "/dev/null"})), "the device stays")  # fmt: skip
    it = cell(GROUP, "model --html /dev/stdout")
    assert "<html" in it.runs(it.process("model", model, "--html", "/dev/stdout"), "the page is printed").out  # fmt: skip
    assert [device(name) for name in watched] == before


def test_pipe(cell, tmp_path, cloud):
    pipe, read = tmp_path / "pipe.las", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    path = job(tmp_path, str(cloud), {"type": "writers.las", "filename": str(pipe)})
    it = cell(GROUP, "output into a named pipe")
    it.runs(it.process("pipeline", path), "the reader of the pipe gets the file; the pipe stays")
    reader.join()
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    (tmp_path / "got.las").write_bytes(read[0])
    assert len(laspy.read(tmp_path / "got.las")) == 600


def test_links(cell, tmp_path, cloud):
    (tmp_path / "there").mkdir()
    link, target = tmp_path / "out.las", tmp_path / "there" / "real.las"
    link.symlink_to(target)
    it = cell(GROUP, "output that is a link")
    it.runs(
        ["pipeline", job(tmp_path, str(cloud), HAG, str(link))],
        "the file it leads to is written; the link stays",
    )
    assert link.is_symlink() and len(laspy.read(target)) == 600


@pytest.mark.parametrize("mode", [0o600, 0o444])
def test_modes(cell, tmp_path, cloud, mode):
    out = tmp_path / "out.las"
    shutil.copy(cloud, out)
    out.chmod(mode)
    before = out.read_bytes()
    it = cell(GROUP, f"older output of mode 0{mode:o}")
    words = ["pipeline", job(tmp_path, str(cloud), HAG, {"type": "writers.las", "filename": str(out), "extra_dims": "all"})]  # fmt: skip
    if mode == 0o444:
        it.refused(words, "write-protected", "out.las")
        assert out.read_bytes() == before
    else:
        it.runs(words, "the new file has that mode too")
        assert out.read_bytes() != before
    assert stat.S_IMODE(out.stat().st_mode) == mode


def test_text_to_standard_output(cell, tmp_path, cloud):
    for case, stage in (("writers.text to STDOUT", {"type": "writers.text", "filename": "STDOUT"}),
                        ("a last stage named STDOUT", "STDOUT")):  # fmt: skip
        it = cell(GROUP, case)
        done = it.runs(
            it.process("pipeline", job(tmp_path, str(cloud), stage)), "the points are printed; no file"
        )
        assert done.out.count("\n") == 601 and '"X"' in done.out
        assert not (tmp_path / "STDOUT").exists()


# ---- what must not be replaced ---------------------------------------------------------------------------------


@pytest.fixture()
def files(tmp_path, cloud, model):
    """A cloud, another, a model and a page in the test's own folder, and a check that they are what they were."""
    for source, name in ((cloud, "a.las"), (cloud, "b.las"), (model, "m.model")):
        shutil.copy(source, tmp_path / name)
    (tmp_path / "page.html").write_text("<!DOCTYPE html>\n<p>mine</p>\n")
    (tmp_path / "link.las").symlink_to("a.las")
    os.link(tmp_path / "a.las", tmp_path / "hard.las")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    yield tmp_path
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path in before} == before


ACCURACY = ["accuracy", "a.las", "--reference", "b.las"]
REPLACING = [
    ("train --model *.las", ["train", "b.las", "--model", "a.las", *SMALL], "would replace a LAS or LAZ file"),
    ("train a.las --model a.las", ["train", "a.las", "--model", "a.las", *SMALL], "would replace a LAS or LAZ file"),
    ("train --model page.html", ["train", "a.las", "--model", "page.html", *SMALL], "would replace an HTML page"),
    ("classify onto its input", ["classify", "a.las", "a.las", "--model", "m.model"], "is one of the inputs"),
    ("classify onto a link to its input", ["classify", "a.las", "link.las", "--model", "m.model"], "is one of the inputs"),
    ("classify onto its input's other name", ["classify", "a.las", "hard.las", "--model", "m.model"], "is one of the inputs"),
    ("classify onto the model", ["classify", "a.las", "m.model", "--model", "m.model"], "is one of the inputs"),
    ("classify onto another model", ["classify", "a.las", "other.laz", "--model", "m.model"], "would replace a model file"),
    ("classify --metadata onto the input", ["classify", "a.las", "o.las", "--model", "m.model", "--metadata", "a.las"],
     "would replace a LAS or LAZ file"),
    ("classify --metadata onto the output", ["classify", "a.las", "o.las", "--model", "m.model", "--metadata", "o.las"],
     "the metadata file is the output file too"),
    ("accuracy --json onto the input", [*ACCURACY, "--json", "b.las"], "would replace a LAS or LAZ file"),
    ("accuracy --html onto a model", [*ACCURACY, "--html", "m.model"], "would replace a model file"),
    ("accuracy --json and --html onto one file", [*ACCURACY, "--json", "x", "--html", "x"], "is the json file too"),
    ("model --html onto the model", ["model", "m.model", "--html", "m.model"], "would replace a model file"),
    ("expand -o onto the pipeline", ["expand", "p.json", "-o", "p.json"], "is one of the inputs"),
    ("pipeline --metadata onto the pipeline", ["pipeline", "p.json", "--metadata", "p.json"], "is one of the inputs"),
    ("pipeline --metadata onto a page", ["pipeline", "p.json", "--metadata", "page.html"], "would replace an HTML page"),
    ("pipeline --metadata onto the bins it reads", ["pipeline", "bins.json", "--metadata", "thresholds.json"], "is one of the inputs"),
    ("pipeline that writes onto a polygon file it reads", ["pipeline", "overlay.json"], "is one of the inputs"),
    ("writer with '#' that may hit an input", ["pipeline", "split.json"], "is one of the inputs"),
    ("two writers of one file, named differently", ["pipeline", "twice.json"], "two output files are one"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "words", "says"), REPLACING, ids=[row[0] for row in REPLACING])
def test_files_that_must_not_be_replaced(cell, files, monkeypatch, case, words, says):
    monkeypatch.chdir(files)
    shutil.copy("m.model", "other.laz")
    shutil.copy("a.las", "t_1.las")
    job(files, "a.las", HAG, name="p.json")
    bins = {
        "type": "filters.multiscalefeatures",
        "neighborhoods": "c1",
        "bins": "thresholds.json",
        "feature_set": "D1",
    }
    job(files, "a.las", bins, name="first.json")
    job(files, "a.las", bins, name="bins.json")
    if "bins.json" in words:
        assert cell(GROUP, case).command("pipeline", "first.json").code == 0
    (files / "poly.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    overlay = {
        "type": "filters.overlay",
        "dimension": "Classification",
        "datasource": "poly.geojson",
        "column": "c",
    }
    job(files, "a.las", overlay, {"type": "writers.text", "filename": "poly.geojson"}, name="overlay.json")
    split = {"type": "filters.splitter", "length": 10}
    job(files, "t_1.las", split, {"type": "writers.las", "filename": "t_#.las"}, name="split.json")
    job(files, "a.las", "o.las", {"type": "writers.las", "filename": "./o.las"}, name="twice.json")
    text = (
        (files / "twice.json").read_text().replace('"o.las"', '{"type": "writers.las", "filename": "o.las"}')
    )
    (files / "twice.json").write_text(text)
    cell(GROUP, case).refused(words, says)


def test_files_of_the_same_kind_are_replaced(cell, files, monkeypatch):
    monkeypatch.chdir(files)
    shutil.copy("m.model", "n.model")
    shutil.copy("a.las", "o.las")
    (files / "m.json").write_text("{}")
    it = cell(GROUP, "older model, output and metadata of the same kinds")
    it.runs(["train", "a.las", "--model", "n.model", *SMALL], "are replaced")
    assert load_model("n.model").plan.names != load_model("m.model").plan.names
    it.runs(["classify", "a.las", "o.las", "--model", "m.model", "--metadata", "m.json"], "are replaced")
    assert json.loads((files / "m.json").read_text())["metadata"]


# ---- folders that others may write to --------------------------------------------------------------------------

#: A user that is neither the superuser nor anybody here.
STRANGER = 54_321


def test_a_lock_that_only_writers_can_hold(tmp_path, cloud):
    job_ = job(tmp_path, str(cloud), HAG, str(tmp_path / "o.las"))
    before = os.umask(0o022)
    try:
        run_tiled(job_, 20, workers=0, progress=False)
        assert stat.S_IMODE((tmp_path / ".pdal-stages" / "lock").stat().st_mode) == 0o600
        os.umask(0o002)
        (tmp_path / ".pdal-stages" / "lock").unlink()
        run_tiled(job_, 20, workers=0, progress=False)
        assert stat.S_IMODE((tmp_path / ".pdal-stages" / "lock").stat().st_mode) == 0o660
        (tmp_path / ".pdal-stages" / "lock").chmod(0o644)  # of an older release
        run_tiled(job_, 20, workers=0, progress=False)
        assert stat.S_IMODE((tmp_path / ".pdal-stages" / "lock").stat().st_mode) == 0o600
    finally:
        os.umask(before)


# ---- names that would pass for lines of ours -------------------------------------------------------------------


def test_names_in_logs_and_pages(cell, tmp_path, cloud, model):
    """A log has one line of what was asked for; a page holds no control characters."""
    odd = tmp_path / "a\n2026-01-01 00:00:00 exit code 0 after 1.0 s\x1b[2J.las"
    odd.write_bytes(Path(cloud).read_bytes())
    log = tmp_path / "run.log"
    it = cell(GROUP, "file name of two lines in a log")
    it.runs(
        ["classify", odd, tmp_path / "o.las", "--model", model, "--log", log],
        "one line, with codes such as \\n",
    )
    text = log.read_text()
    assert "\\n2026-01-01 00:00:00 exit code 0" in text and "\x1b" not in text
    assert sum("exit code" in line and "\\n" not in line for line in text.splitlines()) == 1


def test_names_in_what_is_said_of_a_model(cell, tmp_path, model):
    def edit(head, _):
        head["training"]["clouds"][0]["name"] = "a\noverall accuracy 100 %\x1b[2J"
        head["classes"][0]["name"] = "Ground\n  6 Roof"

    target = repack(model, tmp_path / "odd.model", edit)
    it = cell("Models", "names of two lines in a model")
    done = it.runs(["model", target, "--html", tmp_path / "m.html"], "one line, with codes such as \\n")
    assert "a\\noverall accuracy 100 %\\x1b[2J" in done.out and "Ground\\n  6 Roof" in done.out
    assert "\x1b" not in (tmp_path / "m.html").read_text()
