"""`classify` of a survey: seamless, resumable, within memory, and said in words."""

from __future__ import annotations

import json
import re
from pathlib import Path

import laspy
import numpy as np
import pytest
import tiling_clouds as clouds

from pdal_stages import TilingOptions
from pdal_stages.base.errors import OptionError
from pdal_stages.base.memory import parse_size
from pdal_stages.cli import main
from pdal_stages.synthetic.town import WKT
from pdal_stages.tiling.options import (
    PARENT,
    Density,
    Extent,
    choose_tiles,
    worker_bytes,
)

pytestmark = pytest.mark.pdal
OPTIONS = ("--filters.hag_minima.cell=5", "--no-progress")


@pytest.fixture(scope="module")
def survey(tmp_path_factory, write_las):
    """A town as one file, as four that meet inside it, and a model; one of the four has an extra dimension of its own."""
    base = tmp_path_factory.mktemp("survey")
    points, xyz, keep = clouds.town()
    arrays = {
        **dict(zip("XYZ", xyz[keep].T, strict=True)),
        "Classification": np.where(np.arange(keep.sum()) % 97, 1, 7).astype("u1"),
        "GpsTime": points.gps_time[keep],
    }
    how = {"point_format": 6, "wkt": WKT, "scale": 0.001, "offset": (499_000.0, 5_399_000.0, 0.0)}
    write_las(base / "town.laz", arrays, **how)
    (base / "in").mkdir()
    east, north = arrays["X"] >= 500_047.0, arrays["Y"] >= 5_400_041.0
    for number in range(4):
        inside = (east == bool(number & 1)) & (north == bool(number & 2))
        part = {name: values[inside] for name, values in arrays.items()}
        if number == 0:
            part["Amplitude"] = np.arange(inside.sum(), dtype="f4")
        write_las(base / "in" / f"t{number}.{'las' if number == 1 else 'laz'}", part, **how)
    clouds.model(base / "m.model", "c1,s2", "covariance")
    return base


def run(survey, *words):
    model = ("--model", str(survey / "m.model"), "--workers", "0")
    return main(["classify", *map(str, words), *model, *OPTIONS])


@pytest.fixture()
def classify(survey, capsys):
    return lambda *words: (run(survey, *words), *capsys.readouterr())


@pytest.fixture(scope="module")
def whole(survey):
    """The town in one piece."""
    assert run(survey, survey / "town.laz", survey / "whole.laz") == 0
    return survey / "whole.laz"


def values(*paths: Path) -> dict[str, np.ndarray]:
    """What was made of points, in an order of their own."""
    read = [laspy.read(path) for path in paths]
    xyz = np.concatenate(
        [np.column_stack([r.X, r.Y, r.Z, np.asarray(r.gps_time) * 1e6]) for r in read]
    )
    names = ("classification", "Reliability", "HeightAboveGround")
    order = np.lexsort(xyz.T)
    return {name: np.concatenate([np.asarray(r[name]) for r in read])[order] for name in names}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.la?"))}


def test_a_survey_has_no_seams_and_a_second_run_does_what_is_missing(
    survey, classify, whole, tmp_path
):
    target = tmp_path / "made" / "classified"
    code, out, err = classify(
        survey / "in", target, "--tile", 30, "--metadata", tmp_path / "m.json"
    )
    assert code == 0, err
    names = ["t0.laz", "t1.las", "t2.laz", "t3.laz"]
    assert sorted(path.name for path in target.glob("t*")) == names
    single = values(whole)
    other = values(*target.glob("t*"))
    for name in single:
        assert np.array_equal(single[name], other[name]), name
    for name in names:  # headers are the inputs' own
        before, after = laspy.read(survey / "in" / name), laspy.read(target / name)
        assert np.array_equal(before.header.scales, after.header.scales)
        assert np.array_equal(before.header.offsets, after.header.offsets)
        assert before.header.parse_crs() == after.header.parse_crs()
        for axis in ("X", "Y", "Z", "gps_time"):
            assert np.array_equal(before[axis], after[axis])
        extra = sorted(after.point_format.extra_dimension_names)
        assert extra == ["Amplitude"] * (name == "t0.laz") + ["HeightAboveGround", "Reliability"]
    # Every file is said when it is there, with its classes; the table has them all.
    output = dict(re.findall(r"(t\d)\.la.: ([\d,]+) points; ", out))
    assert {name: int(n.replace(",", "")) for name, n in output.items()} == {
        path.stem: len(laspy.read(path)) for path in target.glob("t*")
    }
    codes, counts = np.unique(single["classification"], return_counts=True)
    table = {
        int(c): int(n.replace(",", ""))
        for c, n in re.findall(r"^ +(\d+) .*?([\d,]+)$", out, re.MULTILINE)
    }
    assert table == dict(zip(codes.tolist(), counts.tolist(), strict=True))
    outputs = json.loads((tmp_path / "m.json").read_text())["outputs"]
    assert sum(o["written"] for o in outputs) == len(single["classification"])

    before = contents(target)
    (target / "t2.laz").unlink()
    code, out, err = classify(
        survey / "in", target, "--resume"
    )  # the tiles stay those of the first run
    assert code == 0 and "1 file written, 3 kept from an earlier run" in out, out + err
    assert contents(target) == before


def test_a_dry_run_writes_nothing_and_finds_what_is_wrong(survey, classify, tmp_path):
    code, out, err = classify(survey / "in", tmp_path / "out", "--dry-run")
    assert code == 0 and "4 inputs" in out and not list(tmp_path.iterdir()), err
    code, _, err = classify(
        survey / "in", tmp_path / "out", "--dry-run", "--where", "Classificaton == 2 &&"
    )
    assert code == 1 and "where" in err
    words = [
        "classify",
        str(survey / "in"),
        str(tmp_path / "out"),
        "--dry-run",
        "--model",
        "standart",
    ]
    assert main(words) == 1
    assert not list(tmp_path.iterdir())


def test_a_report_needs_no_tiles(survey, classify, whole, tmp_path):
    names = [str(tmp_path / name) for name in ("r.json", "m.json")]
    words = ("--report", names[0], "--metadata", names[1])
    town, target = survey / "town.laz", tmp_path / "out.laz"
    code, out, err = classify(town, target, *words, "--dry-run")
    dry = json.loads((tmp_path / "r.json").read_text())
    assert code == 0 and "in one piece" in out and not target.exists(), err
    assert dry["points"] == len(laspy.read(town)) and dry["states"] == {"waiting": 0}
    code, out, err = classify(town, target, *words)
    assert code == 0 and target.read_bytes() == whole.read_bytes(), err
    report = json.loads((tmp_path / "r.json").read_text())
    counted = np.bincount(laspy.read(whole).classification)
    assert report["classes"] == {str(code): int(counted[code]) for code in np.flatnonzero(counted)}
    assert report["tiles"] == [] and report["outputs"][0]["output"] == [str(target)]
    assert report["points"] == report["outputs"][0]["written"] == counted.sum()
    assert "filters.modelclassifier" in json.loads((tmp_path / "m.json").read_text())["metadata"]
    for extra in ("--report", "--metadata"):
        assert classify(town, target, extra, town)[0] == 1


def test_one_output_for_each_tile(survey, classify, whole, tmp_path):
    code, _, err = classify(survey / "in", tmp_path / "out/", "--tile", 45, "--per", "tile")
    assert code == 0, err
    outputs = list((tmp_path / "out").glob("*.laz"))
    assert len(outputs) == 6 and all(re.fullmatch(r"\d+_\d+\.laz", path.name) for path in outputs)
    for name, array in values(whole).items():
        assert np.array_equal(array, values(*outputs)[name]), name


def test_a_cloud_beyond_the_memory_is_cut(survey, classify, whole, tmp_path):
    code, out, err = classify(
        survey / "town.laz", tmp_path / "cut.laz", "--memory", "1.3GB", "--tile", 60
    )
    assert code == 0 and "tiles done" in out, err
    clouds.same_points(tmp_path / "cut.laz", whole)
    code, _, err = classify(survey / "town.laz", tmp_path / "cut.laz", "--memory", "0.2GB")
    assert code == 1 and "not enough memory" in err and "--memory" in err


# ---- memory, and time left -------------------------------------------------------------------------------


def test_amounts_of_memory():
    sizes = {"4GB": 4e9, "4 GiB": 4 * 2**30, "1.5g": 15e8, "500M": 5e8, "77000000": 77e6}
    assert {text: parse_size(text) for text in sizes} == sizes
    for text in ("", "GB", "-1GB", "0", "4", "4 apples", "1e9"):
        with pytest.raises(OptionError, match="a number and a unit"):
            parse_size(text)


@pytest.mark.parametrize("density", [0.5, 5.0, 40.0, 400.0])
@pytest.mark.parametrize("memory", [1.5e9, 4e9, 16e9, 64e9])
@pytest.mark.parametrize("halo", [0.0, 32.0, 368.0])
def test_the_side_of_tiles_keeps_to_the_memory(density, memory, halo):
    extents = [
        Extent(int(density * 10**6), (i * 1000.0, 0.0, (i + 1) * 1000.0, 1000.0))
        for i in range(100)
    ]
    result = Density.measure(extents)
    options = TilingOptions(memory=int(memory), workers=None)
    try:
        chosen, _ = choose_tiles(options, result, halo)
    except OptionError:
        least = worker_bytes(result.read_by(1.0, halo), result.largest) + PARENT
        assert least > memory  # nothing would have fitted
        return
    used = PARENT + chosen.workers * worker_bytes(result.read_by(chosen.tile, halo), result.largest)
    assert used <= memory and chosen.workers >= 1 and chosen.tile > 0
