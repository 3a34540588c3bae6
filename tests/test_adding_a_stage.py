"""The stage of docs/adding-a-stage.md, added as the page says: one module here, or one of another package."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import laspy
import numpy as np
import processes
import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "adding-a-stage.md"
#: Vegetation, ground and the height of each; what the stage makes of them.
CODES = [5, 5, 5, 2, 3]
HEIGHTS = [0.1, 1.0, 9.0, 9.0, 2.5]
BANDS = [3, 4, 5, 2, 5]

pytestmark = pytest.mark.pdal


def block(language: str) -> str:
    """Return the page's only block of a language."""
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return text


def in_this_package(folder: Path) -> None:
    """Make a package of links to ours, with one module more."""
    for part in (ROOT / "pdal_stages").iterdir():
        inside = part.name == "stages"
        for path in part.iterdir() if inside else [part]:
            link = folder / path.relative_to(ROOT)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)
    module = folder / "pdal_stages" / "stages" / "heightband.py"
    module.unlink(missing_ok=True)  # else the link to one that is there would be written through
    module.write_text(block("python"))


def in_another_package(folder: Path) -> None:
    """Make an installed package with the entry point of the page."""
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").write_text("")
    (folder / "my_package" / "heightband.py").write_text(block("python"))
    section, entry = block("toml").splitlines()
    group = section.removeprefix('[project.entry-points."').removesuffix('"]')
    about = folder / "my_package-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[{group}]\n{entry.replace(chr(34), '')}\n")


@pytest.fixture
def env(tmp_path):
    """Return an environment in which Python finds packages in the folder site."""
    (tmp_path / "site").mkdir()
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    packages = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    return {"PYTHONPATH": packages, "PATH": programs}


@pytest.fixture(params=[in_this_package, in_another_package])
def run(request, tmp_path, env):
    """Run a program that finds the stage; what it printed."""
    request.param(tmp_path / "site")
    return lambda *words: processes.printed(*words, cwd=tmp_path, env=env)


@pytest.fixture
def cloud(tmp_path, write_las):
    """Write the five points 40 times, 20 m apart, with a height in each."""
    x = np.repeat(np.arange(40) * 20.0, 5) + np.tile(np.arange(5.0), 40)
    values = {"X": x, "Y": np.full(200, 1.0), "Z": np.zeros(200), "Classification": CODES * 40}
    path = tmp_path / "in.laz"
    heights = {"HeightAboveGround": np.tile(np.float32(HEIGHTS), 40)}
    write_las(path, values | heights, point_format=6)
    return path


def classes(path: Path) -> list[int]:
    return np.asarray(laspy.read(path).classification).tolist()


def test_it_works_at_all_doors_and_in_tiles(run, cloud, tmp_path, pdal_program):
    command = ("python", "-m", "pdal_stages.cli")
    assert "filters.heightband" in run(*command, "drivers")
    assert "Upper edge of medium vegetation" in run(*command, "options", "filters.heightband")
    stages = ["in.laz", {"type": "filters.heightband", "medium": 2}, "out.laz"]
    (tmp_path / "job.json").write_text(json.dumps(stages))
    run(*command, "pipeline", "job.json")
    assert classes(tmp_path / "out.laz") == BANDS * 40
    words = (
        "--tile",
        "50",
        "--workers",
        "0",
        "--report",
        "run.json",
        "--writers.las.filename=tiled.laz",
    )
    run(*command, "pipeline", "job.json", *words)
    assert classes(tmp_path / "tiled.laz") == BANDS * 40
    report = json.loads((tmp_path / "run.json").read_text())
    assert report["point_counts"] == {"filters.heightband.changed": 3 * 40}
    (tmp_path / "plain.json").write_text(
        run(*command, "expand", "job.json").replace("out.laz", "stock.laz")
    )
    run(pdal_program, "pipeline", "plain.json")
    assert classes(tmp_path / "stock.laz") == BANDS * 40
    run(
        "python",
        "-c",
        "import pdal, pdal_stages as ps\n"
        "from pdal_stages.plugin.declarations import header\n"
        "from pdal_stages.stages.preprocessing import check\n"
        "from pdal_stages.base.errors import ModelError\n"
        "job = pdal.Reader.las('in.laz') | ps.Filter.heightband(medium=2) | pdal.Writer.las('object.laz')\n"
        "assert job.execute() == 200 and 'heightband' in dir(ps.Filter)\n"
        "assert 'filters.heightband' in header()\n"  # for stock PDAL
        "assert check([{'type': 'filters.heightband', 'low': '0.4'}])[0]['low'] == 0.4\n"  # in models
        "try: check([{'type': 'filters.heightband', 'threads': 1}])\n"
        "except ModelError: pass\n"
        "else: raise AssertionError\n",
    )
    assert classes(tmp_path / "object.laz") == BANDS * 40


def test_a_package_whose_stage_is_broken_is_named(tmp_path, env):
    in_another_package(tmp_path / "site")
    (tmp_path / "site" / "my_package" / "heightband.py").write_text("import not_there\n")
    command = ("python", "-m", "pdal_stages.cli", "options")
    done = processes.ended(*command, "filters.heightband", cwd=tmp_path, env=env)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "of the package my-package cannot be loaded" in done.stderr
    assert "not_there" in done.stderr
    assert "coarse" in processes.printed(*command, "filters.hag_minima", cwd=tmp_path, env=env)
