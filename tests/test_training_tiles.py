"""`train` of a survey that does not fit into the memory: in tiles, and the forests are the same."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.cli import main
from pdal_stages.tiling import train_survey as training
from pdal_stages.tiling.options import TilingOptions

pytestmark = pytest.mark.pdal

WORDS = [
    "--count",
    "150",
    "--trees",
    "4",
    "--neighborhoods",
    "s2,k9",
    "--no-progress",
    "--classes",
    "2,5,6",
]
MADE = functools.cache(lambda: ps.make_town(56.0, 4.0, seed=5, progress=False))
#: LAS 1.2 and 1.4, as they come; not one scale and offset.
FORMATS = (1, 6, 6, 3)


@pytest.fixture(scope="module")
def town(tmp_path_factory, write_las):
    """Four files that adjoin, with odd offsets."""
    folder = tmp_path_factory.mktemp("town")
    xyz, random = MADE().xyz, np.random.default_rng(0)
    east, north = xyz[:, 0] > 500_028.0, xyz[:, 1] > 5_400_033.0
    number = random.integers(1, 3, len(xyz)).astype(np.uint8)
    for k, point_format in enumerate(FORMATS):
        inside = (east * 2 + north) == k
        points = {axis: xyz[inside, n] for n, axis in enumerate("XYZ")}
        points |= {
            "Classification": np.where(
                random.random(inside.sum()) < 0.02, 7, MADE().classification[inside]
            )
        }
        points |= {
            "ReturnNumber": number[inside],
            "NumberOfReturns": np.full(inside.sum(), 2, np.uint8),
        }
        points |= {"PointSourceId": random.integers(1, 4, inside.sum()).astype(np.uint16)}
        points["Classification"] = points["Classification"].astype(np.uint8)
        write_las(
            folder / f"t{k}.laz",
            points,
            point_format=point_format,
            offset=(500_000 + k, 5_400_000, k),
        )
    return folder


def both(town, tmp_path, run, *more, files=("",)):
    """The forests of one run in one piece and one in tiles, and what the two said."""
    models, output = [], []
    for name, tiles in (("whole", ()), ("tiles", ("--tile", "23.5", "--workers", "0"))):
        words = ["train", *(town / entry for entry in files), "--model", tmp_path / f"{name}.model"]
        code, *reported = run(*words, *WORDS, *tiles, *more)
        assert code == 0, reported
        model = ps.load_model(tmp_path / f"{name}.model")
        arrays = [array.tolist() for entry in model.passes for array in entry.arrays().values()]
        models.append(
            (arrays, model.classes, model.info["classes"], model.info["training"]["clouds"])
        )
        output.append(reported)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    return models, output


@pytest.fixture(scope="module")
def base(town):
    path = town.parent / "base.model"
    assert main(["train", str(town / "t0.laz"), "--model", str(path), *WORDS]) == 0
    return str(path)


def test_on_top_of_a_model(town, base, tmp_path, run):
    (whole, tiles), _ = both(town, tmp_path, run, "--base", base)
    assert whole == tiles
    assert len(ps.load_model(tmp_path / "tiles.model").passes) == 3


def test_the_forests_are_the_same(town, tmp_path, run):
    (whole, tiles), ((out, _), _) = both(town, tmp_path, run)
    assert whole == tiles
    assert "files held out" in out and "t0.laz, t1.laz, t2.laz, t3.laz" in out
    model = ps.load_model(tmp_path / "tiles.model")
    assert model.info["preparation"][0]["type"] == "filters.hag_morphological"
    assert "EarlierReturn_box2" in model.plan.names


def test_octrees_are_read_in_tiles_too(tmp_path, run):
    data = Path(__file__).parent / "data"
    (whole, tiles), _ = both(data, tmp_path, run, "--classes", "2,4,6", files=("town.copc.laz",))
    assert whole == tiles


def test_with_other_options_too(town, tmp_path, run):
    (whole, tiles), _ = both(
        town,
        tmp_path,
        run,
        "--writers.classifiermodel.groups=PointSourceId",
        "--writers.classifiermodel.where=HeightAboveGround < 9",
    )
    assert whole == tiles


def test_surveys_that_do_not_see_each_other(town, tmp_path, run):
    (whole, tiles), _ = both(town, tmp_path, run, "--surveys", "west=*t[01].laz")
    assert whole == tiles
    info = ps.load_model(tmp_path / "tiles.model").info
    assert info["accuracy"]["cross_validation"]["by"] == "surveys"
    assert [entry["name"] for entry in info["training"]["clouds"]] == ["west", "t2", "t3"]


def test_one_file_and_feet(tmp_path, run, write_las):
    pyproj = pytest.importorskip("pyproj")
    xyz = (MADE().xyz - (499_000.0, 5_399_000.0, 0.0)) / 0.3048
    points = {axis: xyz[:, n] for n, axis in enumerate("XYZ")} | {
        "Classification": MADE().classification
    }
    wkt = pyproj.CRS("EPSG:2994").to_wkt("WKT1_GDAL")
    write_las(tmp_path / "feet.laz", points, point_format=6, wkt=wkt)
    words = ["train", tmp_path / "feet.laz", *WORDS]
    assert run(*words, "--model", tmp_path / "whole.model")[0] == 0
    assert (
        run(*words, "--model", tmp_path / "tiles.model", "--tile", "90", "--workers", "0")[0] == 0
    )
    assert (tmp_path / "whole.model").read_bytes() == (tmp_path / "tiles.model").read_bytes()


def test_tiles_where_the_points_do_not_fit(town, tmp_path, monkeypatch):
    files = [str(path) for path in sorted(town.iterdir())]

    def in_one_piece(**options):
        return training.TrainTask(
            files, str(tmp_path / "m.model"), options=TilingOptions(**options)
        ).in_one_piece()

    assert in_one_piece() and in_one_piece(memory=10**9) and not in_one_piece(tile=30.0)
    monkeypatch.setattr(training, "TRAIN_POINT", 10**6)
    assert not in_one_piece(memory=2 * 10**9)
    network = {"algorithm": "alsnet", "dimensions": []}
    assert training.TrainTask(
        files, str(tmp_path / "m.model"), (), network, TilingOptions(tile=30.0)
    ).in_one_piece()


def test_what_is_wrong_is_said_and_no_model_is_written(town, tmp_path, run, write_las):
    words = ["--model", tmp_path / "m.model", *WORDS, "--tile", "23.5", "--workers", "0"]
    for name in ("t0.laz", "t1.laz"):
        (tmp_path / name).write_bytes((town / name).read_bytes())
    data = (tmp_path / "t1.laz").read_bytes()
    (tmp_path / "t1.laz").write_bytes(data[: len(data) // 2])
    code, _, err = run("train", tmp_path / "t0.laz", tmp_path / "t1.laz", *words)
    assert code == 1 and "nothing was trained" in err and "t1.laz" in err
    code, _, err = run("train", town, *words, "--writers.classifiermodel.dimensions=Nowhere")
    assert code == 1 and "'Nowhere' is missing" in err
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"t0.laz", "t1.laz"}


@pytest.fixture(scope="module")
def corrected(tmp_path_factory, write_las):
    """Four files that adjoin; of one nobody looked at any point, and it does not say so. Some points are there twice."""
    folder = tmp_path_factory.mktemp("corrected")
    random = np.random.default_rng(3)
    twice = random.permutation(len(MADE().xyz))[:400]
    xyz = np.concatenate([MADE().xyz, MADE().xyz[twice]])
    codes = np.concatenate([MADE().classification, MADE().classification[twice]]).astype(np.uint8)
    codes[random.random(len(codes)) < 0.02] = 7
    east, north = xyz[:, 0] > 500_028.0, xyz[:, 1] > 5_400_033.0
    near = np.hypot(xyz[:, 0] - 500_025.0, xyz[:, 1] - 5_400_030.0) < 22.0
    for k in range(4):
        inside = (east * 2 + north) == k
        points = {axis: xyz[inside, n] for n, axis in enumerate("XYZ")} | {
            "Classification": codes[inside]
        }
        points["Reliability"] = random.choice([0.5, 0.96, 1.0], inside.sum()).astype(np.float32)
        if k < 3:
            points["Checked"] = near[inside].astype(np.uint8)
        write_las(folder / f"c{k}.laz", points, point_format=6, offset=(500_000 + k, 5_400_000, k))
    return folder


def test_corrections_are_trained_on_in_one_piece(corrected, base, tmp_path, run):
    words = ["train", corrected, *WORDS, "--model", tmp_path / "m.model", "--base", base]
    code, out, err = run(*words)
    assert code == 0 and "were checked by a person" in out + err
    (tmp_path / "m.model").unlink()
    code, _, err = run(*words, "--tile", "23.5", "--workers", "0")
    assert code == 1 and "are trained on in one piece" in err and not list(tmp_path.iterdir())
    code, _, err = run(*words, "--writers.classifiermodel.where=X > 500070")
    assert code == 1 and "no checked point lies inside 'where'" in err
    both(corrected, tmp_path, run, "--writers.classifiermodel.checked_only=false")
