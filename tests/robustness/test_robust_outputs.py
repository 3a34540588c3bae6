"""Outputs: devices and pipes in their place, files that must not be replaced, names given twice."""

from __future__ import annotations

import json
import os
import shutil
import stat
import threading

import laspy
import pytest
from robustness_kit import HAG, job

from pdal_stages import load_model, run_tiled
from pdal_stages.base.errors import StageError

pytestmark = [
    pytest.mark.pdal,
    pytest.mark.skipif(os.name == "nt", reason="devices and links of Unix"),
]

SMALL = ["--neighborhoods", "c1", "--count", "20", "--writers.classifiermodel.trees=2",
         "--writers.classifiermodel.feature_set=covariance", "--writers.classifiermodel.dimensions=Intensity"]  # fmt: skip


def test_devices(command, tmp_path, cloud):
    """Devices stay what they are, for a superuser too."""
    watched = ["/dev/null", "/dev/stdout"]
    before = [(status.st_ino, status.st_mode, status.st_rdev) for status in map(os.lstat, watched)]
    done = command.runs(
        command.process("pipeline", job(tmp_path, cloud, HAG), "--metadata", "/dev/stdout")
    )
    assert "filters.hag_minima" in json.loads(done.out)["metadata"]
    command.runs(["train", cloud, "--model", "/dev/null", *SMALL])
    command.runs(
        ["pipeline", job(tmp_path, cloud, {"type": "writers.las", "filename": "/dev/null"})]
    )
    assert [
        (status.st_ino, status.st_mode, status.st_rdev) for status in map(os.lstat, watched)
    ] == before
    done = command.runs(command.process("pipeline", job(tmp_path, cloud, "STDOUT")))
    assert done.out.count("\n") == 601 and '"X"' in done.out and not (tmp_path / "STDOUT").exists()


def test_pipe(command, tmp_path, cloud):
    pipe, read = tmp_path / "pipe.las", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    path = job(tmp_path, cloud, {"type": "writers.las", "filename": str(pipe)})
    os.mkfifo(tmp_path / "job")
    threading.Thread(target=lambda: (tmp_path / "job").write_bytes(path.read_bytes())).start()
    command.runs(command.process("pipeline", tmp_path / "job"))
    reader.join()
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    (tmp_path / "got.las").write_bytes(read[0])
    assert len(laspy.read(tmp_path / "got.las")) == 600


DASHED = [
    ["model", "--", "-m.model"],
    ["validate", "--", "-p.json"],
    ["expand", "--", "-p.json"],
    ["pipeline", "--filters.hag_minima.cell=30", "--", "-p.json"],
    ["classify", "--model", "m.model", "--", "-a.las", "-o.las"],
    ["classify", "--model", "m.model", "--workers", "0", "b.las", "--", "-a.las", "--folder/"],
    ["accuracy", "--reference", "b.las", "--", "-a.las"],
    ["train", "--model", "n.model", *SMALL, "--", "-a.las"],
    ["objects", "--", "-a.las", "-t.gpkg"],
]  # fmt: skip


@pytest.mark.parametrize("words", DASHED, ids=" ".join)
def test_names_with_a_leading_dash(command, files, words):
    """After ``--`` a word is a name, of an input or an output, whatever it begins with."""
    shutil.copy("a.las", "-a.las")
    shutil.copy("m.model", "-m.model")
    job(files, "./-a.las", HAG, name="-p.json")
    command.runs(words)
    outputs = {"-o.las": "-o.las", "-t.gpkg": "-t.gpkg", "--folder/": "--folder/b.las"}
    assert words[-1] not in outputs or (files / outputs[words[-1]]).is_file()


@pytest.mark.parametrize("door", ["files", "folder", "pattern", "index", "pipeline"])
def test_a_pipe_among_several_inputs(command, files, door):
    """It is refused; a pipe without a writer would be waited for without end."""
    (files / "in").mkdir()
    shutil.copy("a.las", "in/a.las")
    os.mkfifo("in/pipe.las")
    os.mkfifo("pipe.geojson")
    named = {
        "files": ["a.las", "pipe.las"],
        "folder": ["in"],
        "pattern": ["in/*.las"],
        "index": ["pipe.geojson"],
    }
    classify = ["classify", *named.get(door, []), "o/", "--model", "m.model", "--workers", "0"]
    many = [
        "pipeline",
        job(files, {"type": "readers.las", "filename": "in/*.las"}, HAG, "o_#.las"),
        "--tile",
        "50",
    ]
    command.refused(many if door == "pipeline" else classify, "the input is a pipe")


# ---- what must not be replaced ---------------------------------------------------------------------------------


def index(path, *names):
    """Write a tile index of files."""
    square = [[[0, 0], [1, 0], [1, 1], [0, 0]]]
    shape = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": square}}
    tiles = [{**shape, "properties": {"location": name}} for name in names]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": tiles}))
    return path


@pytest.fixture()
def files(tmp_path, cloud, model, monkeypatch):
    """A cloud, another, a model and a page in the test's own folder, and a check that they are what
    they were."""
    monkeypatch.chdir(tmp_path)
    for source, names in (
        (cloud, ("a.las", "b.las", "t_1.las")),
        (model, ("m.model", "other.laz")),
        (index(tmp_path / "ti.geojson", "a.las"), ()),
        (index(tmp_path / "two.geojson", "a.las", "b.las"), ()),
    ):
        for name in names:
            shutil.copy(source, tmp_path / name)
    (tmp_path / "page.html").write_text("<!DOCTYPE html>\n<p>mine</p>\n")
    (tmp_path / "poly.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    (tmp_path / "points.txt").write_text("X,Y,Z\n1,2,3\n")
    for name in ("a.las", "m.model"):
        (tmp_path / f"link.{name[2:]}").symlink_to(name)
        os.link(tmp_path / name, tmp_path / f"hard.{name[2:]}")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    os.mkfifo("pipe.las")
    yield tmp_path
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path in before} == before


WRITE = {"type": "writers.las"}
BINS = {
    "type": "filters.multiscalefeatures",
    "neighborhoods": "c1",
    "bins": "b.json",
    "feature_set": "D1",
}
PIPELINES = {
    "p.json": ["a.las", HAG],
    "bins.json": ["a.las", BINS],
    "overlay.json": ["a.las", {"type": "filters.overlay", "dimension": "Classification", "datasource": "poly.geojson", "column": "c"},
                     {"type": "writers.text", "filename": "poly.geojson"}],
    "split.json": ["t_1.las", {"type": "filters.splitter", "length": 10}, {**WRITE, "filename": "t_#.las"}],
    "pipe.json": ["pipe.las", HAG],
    "base.json": ["a.las", HAG, {"type": "writers.classifiermodel", "filename": "m.model", "base": "m.model"}],
    "index.json": [{"type": "readers.tindex", "filename": "ti.geojson"}, {**WRITE, "filename": "a.las"}],
    "tiled.json": [{"type": "readers.tindex", "filename": "two.geojson"}, HAG, {**WRITE, "filename": "o_#.las"}],
    "twice.json": ["a.las", {**WRITE, "filename": "o.las"}, {**WRITE, "filename": "./o.las"}],
}  # fmt: skip
CLASSIFY = ["classify", "a.las", "--model", "m.model"]
ACCURACY = ["accuracy", "a.las", "--reference", "b.las"]
INPUT = "is one of the inputs"
OTHER = "would replace a LAS or LAZ file"
REPLACING = [
    (["train", "b.las", "--model", "a.las", *SMALL], OTHER),
    (["train", "a.las", "--model", "page.html", *SMALL], "would replace an HTML page"),
    ([*CLASSIFY, "a.las"], INPUT),
    ([*CLASSIFY, "link.las"], INPUT),
    ([*CLASSIFY, "hard.las"], INPUT),
    ([*CLASSIFY, "other.laz"], "would replace a model file"),
    ([*CLASSIFY, "o.las", "--metadata", "o.las"], "the metadata file is the output file too"),
    ([*ACCURACY, "--json", "b.las"], OTHER),
    ([*ACCURACY, "--json", "x", "--html", "x"], "is the json file too"),
    (["objects", "a.las", "t.gpkg", "--metadata", "a.las"], OTHER),
    (["objects", "a.las", "t.gpkg", "--metadata", "t.gpkg"], "the metadata file is the objects file too"),
    *((["train", "a.las", "--base", "m.model", "--model", name], INPUT) for name in ("m.model", "link.model", "hard.model")),
    (["train", "a.las", "--base", "link.model", "--model", "m.model"], INPUT),
    (["pipeline", "base.json"], INPUT),
    *((["classify", name, "o/", "--model", "m.model", "--metadata", name], INPUT) for name in ("ti.geojson", "two.geojson")),
    (["classify", "two.geojson", "o/", "--model", "m.model", "--report", "b.json", "--metadata", "two.geojson"], INPUT),
    *((["classify", *names, "o/", "--model", "m.model", "--polygons", "poly.geojson=9", "--metadata", "poly.geojson"], INPUT)
      for names in (["a.las"], ["a.las", "b.las"])),
    (["accuracy", "ti.geojson", "--reference", "ti.geojson", "--json", "ti.geojson"], INPUT),
    (["accuracy", "a.las", "--reference", "ti.geojson", "--json", "ti.geojson"], INPUT),
    (["objects", "ti.geojson", "t.gpkg", "--metadata", "ti.geojson"], INPUT),
    (["review", "ti.geojson", "t.gpkg", "--json", "ti.geojson"], INPUT),
    (["review", "ti.geojson", "ti.geojson"], INPUT),
    (["pipeline", "index.json"], INPUT),
    (["pipeline", "index.json", "--metadata", "ti.geojson"], INPUT),
    (["pipeline", "tiled.json", "--tile", "50", "--metadata", "two.geojson"], INPUT),
    (["expand", "p.json", "-o", "p.json"], INPUT),
    (["pipeline", "p.json", "--metadata", "p.json"], INPUT),
    (["pipeline", "bins.json", "--metadata", "b.json"], INPUT),
    (["pipeline", "overlay.json"], INPUT),
    (["pipeline", "split.json"], INPUT),
    (["pipeline", "twice.json"], "two output files are the same file"),
    *(([*words, "pipe.las"], "the input is a pipe") for words in (["train", "--model", "o.model"], ["accuracy", "a.las", "--reference"])),
    (["pipeline", "pipe.json"], "the input is a pipe"),
    (["pipeline", "/dev/zero"], "64 MB or more, too much for a pipeline"),
    ([*CLASSIFY, "\udce9.las"], "rename the file"),
    *(([*words, ""], f"what follows '{words[-1]}' is empty") for words in (CLASSIFY, ["review", "a.las"], ["demo"], ["plugin", "--check", "--folder"])),
    ([*CLASSIFY, "o.las", "--metadata="], "what follows '--metadata=' is empty"),
    *((["objects", "a.las", name], "UTF-8, without '!' and ';'") for name in ("\udce9.gpkg", "!b.gpkg", "a;b.shp")),
    ([*ACCURACY, "--json", "a\0b"], "has no name"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "says"), REPLACING, ids=[" ".join(words[:6]) for words, _ in REPLACING]
)
def test_files_that_must_not_be_replaced(command, files, words, says):
    for name, stages in PIPELINES.items():
        job(files, *stages, name=name)
    if "bins.json" in words:
        command.runs(["pipeline", "bins.json"])  # writes them
    command.refused(words, says)


def test_files_of_the_same_kind_are_replaced(command, files):
    shutil.copy("m.model", "n.model")
    shutil.copy("a.las", "o.las")
    (files / "m.json").write_text("{}")
    command.runs(["train", "a.las", "--model", "n.model", *SMALL])
    assert load_model("n.model").plan.names != load_model("m.model").plan.names
    command.runs([*CLASSIFY, "o.las", "--metadata", "m.json"])
    assert json.loads((files / "m.json").read_text())["metadata"]


def test_a_run_works_in_a_folder_of_its_own(tmp_path, cloud):
    """Only its owner can enter it; one of another user's, or that others may write to, is refused
    and left alone."""
    path, notes = job(tmp_path, cloud, HAG, tmp_path / "o.las"), tmp_path / ".pdal-stages"

    def run(mode: int, owner: int = -1) -> None:
        notes.chmod(mode)
        os.chown(notes, owner, -1)
        run_tiled(path, 20, workers=0, progress=False)

    before = os.umask(0)
    try:
        run_tiled(path, 20, workers=0, progress=False)
        assert stat.S_IMODE(notes.stat().st_mode) == 0o700
        run(0o755)  # of an older release
        assert stat.S_IMODE(notes.stat().st_mode) == 0o700
        (notes / "kept" / "mine").write_text("mine")
        cases = [(0o777,), (0o775,)] + [(0o700, 65534)] * (os.geteuid() == 0)
        for case in cases:
            with pytest.raises(StageError, match="another user's or open to others"):
                run(*case)
            assert (notes / "kept" / "mine").read_text() == "mine"
    finally:
        os.umask(before)


@pytest.mark.parametrize("door", ["classify", "pipeline", "objects", "review"])
def test_names_that_begin_with_a_tilde(command, tmp_path, cloud, model, monkeypatch, door):
    """PDAL takes it for somebody's home."""
    monkeypatch.chdir(tmp_path)
    las = laspy.read(cloud)
    las.classification[:] = 2
    las.write("~in.las")
    (tmp_path / "job.json").write_text('["~in.las", {"type": "filters.hag_minima"}, "~out.las"]')
    words = {
        "classify": ["classify", "~in.las", "~out.las", "--model", model],
        "pipeline": ["pipeline", "job.json"],
        "objects": ["objects", "~in.las", "~out.gpkg"],
        "review": ["review", "~in.las", "~out.gpkg", "--model", model],
    }[door]
    command.runs(words)
    assert [path.name for path in tmp_path.glob("~out.*")]
