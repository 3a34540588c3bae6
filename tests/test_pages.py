"""The commands that the pages show, run as printed, one page after the other, on a generated town."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import laspy
import numpy as np
import pytest
from test_plugin import environment, plugin  # noqa: F401  fixtures

import pdal_stages
from pdal_stages.cli import main
from pdal_stages.synthetic import write_town

pytestmark = [pytest.mark.pdal, pytest.mark.slow]
ROOT = Path(__file__).resolve().parent.parent
#: Commands that need what is not here: other computers, programs, the papers' data, an installation.
ELSEWHERE = re.compile(r"benchmarks/|--scheduler|plugin --install|warmup|drivers \|")
#: What makes a training quick: fewer samples and trees.
QUICK = [f"--writers.classifiermodel.{o}" for o in ("count=60", "trees=3", "neighborhoods=k10")]
PAGES = {
    "README.md": 7,
    "docs/deliverables.md": 2,
    "docs/first-result.md": 6,
    "docs/how-to.md": 7,
    "docs/large-areas.md": 4,
    "docs/models.md": 2,
    "docs/objects.md": 1,
    "docs/pipelines.md": 4,
    "docs/train.md": 5,
    "docs/why.md": 6,
}


def commands(page):
    """Return the commands of a page as words, without comments; what follows ``cd`` and ``||`` is left out."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    for line in blocks.replace("\\\n", " ").splitlines():
        line = re.sub(r"^cd \S+ && ", "", line).partition(" ||")[0]
        if line.startswith(("pdal-stages ", "pdal ")) and not ELSEWHERE.search(line):
            yield shlex.split(line, comments=True)


@pytest.fixture(scope="module")
def town():
    return pdal_stages.make_town(60.0, 6.0, seed=4, progress=False)


@pytest.fixture
def folder(town, tmp_path, monkeypatch):
    """A folder with what the pages' commands read."""
    pyogrio, shapely = pytest.importorskip("pyogrio"), pytest.importorskip("shapely")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipelines").symlink_to(ROOT / "pipelines")
    write_town(town, tmp_path / "truth.laz")
    las = laspy.read("truth.laz")
    for name in ("labeled.laz", "edited.laz", "mine.laz"):
        las.write(name)
    east = np.asarray(las.x) > np.median(las.x)
    for name in ("survey", "tiles", "classified"):
        os.makedirs(name)
    for number, part in enumerate((east, ~east)):
        las[part].write(f"tiles/{number}.laz")
    las.classification[:] = 0
    las.classification[::2] = 1
    las.write("raw.laz")
    for number, part in enumerate((east, ~east)):
        las[part].write(f"survey/{number}.laz")
    Path("doubts.csv").write_text(f"{np.median(las.x)},{np.median(las.y)}\n")
    Path("control.csv").write_text(f"{np.median(las.x)},{np.median(las.y)},0\n")
    laspy.convert(las, point_format_id=1, file_version="1.2").write("old.laz")
    (x, y), where = (
        (np.median(v) for v in (las.x, las.y)),
        [shapely.to_wkb(shapely.box(0, 0, 1, 1))],
    )
    where[0] = shapely.to_wkb(shapely.box(x, y, x + 9, y + 9))
    for name, layer in (("lakes.gpkg", "lakes"), ("bridges.gpkg", "decks"), ("roof.gpkg", "roof")):
        how = {"geometry_type": "Polygon", "crs": "EPSG:25832", "layer": layer}
        pyogrio.raw.write(name, np.array(where, object), [np.zeros(1)], ["id"], **how)
    page = (ROOT / "docs" / "pipelines.md").read_text(encoding="utf-8")
    train, classify = re.findall(r"^```json\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    Path("train.json").write_text(train)
    Path("classify.json").write_text(classify)
    return tmp_path


def prepare_why(folder):
    """Make what docs/why.md reads: a classified cloud, and one that a person corrected."""
    for name in ("hamlet.laz", "classified.laz"):
        assert main(["classify", "raw.laz", name]) == 0
    assert main(["classify", "survey/", "classified/"]) == 0
    las = laspy.read("hamlet.laz")
    codes = np.asarray(las.classification)
    codes[np.flatnonzero(codes == 5)[:30]] = 6
    las.classification = codes
    las.write("corrected.laz")
    x, y = float(np.median(las.x)), float(np.median(las.y))
    pyogrio, shapely = pytest.importorskip("pyogrio"), pytest.importorskip("shapely")
    point = np.array([shapely.to_wkb(shapely.Point(x, y))], object)
    how = {"geometry_type": "Point", "crs": "EPSG:25832"}
    pyogrio.raw.write("doubts.gpkg", point, [np.zeros(1)], ["id"], **how)
    return {"652034.2": f"{x:.2f}", "6862010.8": f"{y:.2f}"}


@pytest.mark.parametrize("page", PAGES)
def test_commands_run_as_printed(page, folder, environment, capsys, pdal_program):  # noqa: F811
    lines = [*commands(page)]
    assert len(lines) == PAGES[page], lines
    if page in ("docs/objects.md", "docs/deliverables.md"):
        assert main(["classify", "survey/", "classified/"]) == 0
    if page == "docs/large-areas.md":  # its pipeline of your own
        stages = json.loads(Path("classify.json").read_text())
        stages[0], stages[2]["model"] = "survey/*.laz", "standard"
        stages[3]["filename"] = "own/c_#.laz"
        Path("classify.json").write_text(json.dumps(stages))
    places = prepare_why(folder) if page == "docs/why.md" else {}
    for words in lines:
        if words[0] == "pdal":
            words[0] = str(pdal_program)
            done = subprocess.run(words, env=environment, capture_output=True, text=True)
            assert done.returncode == 0, (words, done.stderr)
            continue
        words = words[1:]
        if page == "docs/train.md" and words[:2] == ["train", "tiles/*.laz"]:  # by the shell
            words[1:2] = ["tiles/0.laz", "tiles/1.laz"]
        words += QUICK if words[0] == "train" else []
        words = [places.get(word, "64" if word == "500" else word) for word in words]
        assert main(words) == 0, (words, capsys.readouterr().err)


def test_a_pipeline_in_tiles_from_python(folder):
    """As docs/large-areas.md has it."""
    text = (ROOT / "docs" / "large-areas.md").read_text(encoding="utf-8")
    (call,) = re.findall(r"In\s+Python:\s+`(pdal_stages\.run_tiled\(.*?\))`", text)
    stages = json.loads(Path("classify.json").read_text())
    stages[0], stages[2]["model"] = "survey/*.laz", "standard"
    stages[3]["filename"] = "own/c_#.laz"
    Path("classify.json").write_text(json.dumps(stages))
    run = eval(call, {"pdal_stages": pdal_stages})
    assert not run.failures and len([*Path("own").glob("c_*.laz")]) == 2
