"""Rounds of tiles: stages that look far, one of another package too, and runs that are interrupted."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest
from processes import printed
from test_adding_a_stage import in_another_package

from pdal_stages.cli import main

pytestmark = pytest.mark.pdal
CITY = Path(__file__).parent / "data" / "city.laz"

#: Height above the lowest point of the square of 200 m that a point lies in: seen from a tile of
#: 50 m, that may be far away.
STAGE = '''
import numpy as np

from pdal_stages.stages.base import Blocks, FarReaching, inside_block

SIDE = 200.0


def lowest(x, y, z):
    """Return square -> its lowest point."""
    squares = np.column_stack([x // SIDE, y // SIDE]).astype(int)
    out = {}
    for square in np.unique(squares, axis=0):
        inside = (squares == square).all(axis=1)
        row = np.flatnonzero(inside)[z[inside].argmin()]
        out[tuple(square.tolist())] = np.array([[x[row], y[row], z[row]]])
    return out


class LowestFar(FarReaching):
    type = "filters.lowestfar"
    summary = "Height above the lowest point of a large square"

    def creates(self):
        return {"HeightAboveLowest": "double", "ByBlocks": "uint8_t"}

    def blocks(self):
        return Blocks(side=SIDE, reach=0.0, margin=0.0, overhang=0.0)

    def reduce_points(self, points):
        low = lowest(*points.axes)
        return {"around": np.empty((0, 3))} | {inside_block(at): low[at] for at in low}

    def compute_block(self, far_points, inside, block):
        points = np.concatenate([np.empty((0, 3)), *inside])
        rows = [[*block, points[:, 2].min()]] if len(points) else np.empty((0, 3))
        return {"lowest": np.array(rows)}

    def run(self, points, context):
        x, y, z = points.axes
        low = {at: xyz[0, 2] for at, xyz in lowest(x, y, z).items()}
        for block in context.blocks or ():
            low |= {(int(i), int(j)): z for i, j, z in block["lowest"]}
        squares = zip((x // SIDE).astype(int).tolist(), (y // SIDE).astype(int).tolist())
        heights = z - np.array([low[at] for at in squares])
        return {
            "HeightAboveLowest": heights,
            "ByBlocks": np.full(points.count, context.blocks is not None, np.uint8),
        }
'''


def test_a_stage_of_another_package_takes_part_in_a_first_round(tmp_path, write_las):
    site = tmp_path / "site"
    site.mkdir()
    in_another_package(site)
    (site / "my_package" / "lowestfar.py").write_text(STAGE)
    entry = "[pdal_stages.stages]\nfilters.lowestfar = my_package.lowestfar:LowestFar\n"
    (site / "my_package-1.dist-info" / "entry_points.txt").write_text(entry)
    xyz = np.round(np.random.default_rng(0).uniform(0, 1, (4_000, 3)) * (390, 210, 30), 3)
    for name, rows in (("a", xyz[:, 0] < 170), ("b", xyz[:, 0] >= 170)):
        write_las(tmp_path / f"{name}.las", dict(zip("XYZ", xyz[rows].T, strict=True)))
    writer = {"type": "writers.las", "filename": "o_#.las", "extra_dims": "all"}
    (tmp_path / "tiles.json").write_text(
        json.dumps(["?.las", {"type": "filters.lowestfar"}, writer])
    )
    whole = ["a.las", "b.las", {"type": "filters.lowestfar"}, {**writer, "filename": "whole.las"}]
    (tmp_path / "whole.json").write_text(json.dumps(whole))
    command = (sys.executable, "-m", "pdal_stages.cli", "pipeline")
    places = {"cwd": tmp_path, "env": {"PYTHONPATH": str(site)}}
    printed(*command, "whole.json", **places)
    printed(*command, "tiles.json", "--tile", 50, "--workers", 1, **places)
    expected = laspy.read(tmp_path / "whole.las")
    tiles = [laspy.read(tmp_path / f"o_{name}.las") for name in "ab"]
    heights = np.concatenate([las["HeightAboveLowest"] for las in tiles])
    assert np.array_equal(heights, expected["HeightAboveLowest"]) and heights.max() > 20
    assert all((las["ByBlocks"] == 1).all() for las in tiles) and not expected["ByBlocks"].any()


def columns(path: Path) -> list[np.ndarray]:
    las = laspy.read(path)
    return [np.asarray(las[n]) for n in ("classification", "Reliability", "HeightAboveGround")]


def test_an_interrupted_run_of_the_shipped_model_goes_on(tmp_path, capsys):
    """With bridges, which look farther than a tile is wide."""
    words = ["classify", str(CITY), "--bridges", "--no-progress"]
    assert main([*words, str(tmp_path / "whole.laz")]) == 0
    out = tmp_path / "out"
    out.mkdir()
    words += [str(out / "o.laz"), "--tile", "8", "--workers", "0"]
    command = [sys.executable, "-m", "pdal_stages.cli", *words]
    kept = out / ".pdal-stages" / "kept"
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        end = time.monotonic() + 300
        while len([p for p in kept.glob("*_*.json") if p.stem.count(".") == 0]) < 2:
            assert run.poll() is None and time.monotonic() < end
            time.sleep(0.01)
        run.send_signal(signal.SIGINT)
        _, err = run.communicate(timeout=120)
    done, tiles = map(int, re.findall(r"(\d+) of (\d+) tiles done", err)[0])
    assert run.returncode == 130 and 2 <= done < tiles, err
    assert not (out / "o.laz").exists()
    capsys.readouterr()
    assert main([*words, "--resume"]) == 0
    assert f"{tiles - done} tiles done, {done} kept from an earlier run" in capsys.readouterr().out
    for resumed, expected in zip(
        *map(columns, (out / "o.laz", tmp_path / "whole.laz")), strict=True
    ):
        assert np.array_equal(resumed, expected)
