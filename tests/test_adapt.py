"""`adapt`: a model for a survey without labels, of what another is sure of there."""

from __future__ import annotations

import functools

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.cli import main
from pdal_stages.tiling import train_survey as adapting
from pdal_stages.tiling.train_survey import spread, sure_points

pytestmark = pytest.mark.pdal

MADE = functools.cache(lambda: ps.make_town(64.0, 4.0, seed=5, progress=False))


def run(capsys, *words):
    """Exit code, and all that was said."""
    code = main([*map(str, words), "--no-progress"])
    return code, "".join(capsys.readouterr())


@pytest.fixture(scope="module")
def town(tmp_path_factory, write_las):
    """A town in two files with classes of its own, and the same without any."""
    folder = tmp_path_factory.mktemp("town")
    random = np.random.default_rng(0)
    east = MADE().xyz[:, 0] > 500_033.0
    for name, codes in (
        ("labeled", random.choice([0, 1, 2, 5, 6], len(east))),
        ("bare", np.zeros(len(east))),
    ):
        (folder / name).mkdir()
        for number, inside in enumerate((east, ~east)):
            points = dict(zip("XYZ", MADE().xyz[inside].T, strict=True))
            points["Classification"] = codes[inside].astype(np.uint8)
            write_las(folder / name / f"t{number}.laz", points, point_format=6)
    return folder


@pytest.fixture(scope="module", autouse=True)
def few_samples():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adapting, "SAMPLES_OF_A_CLASS", 500)
        yield


@pytest.fixture(scope="module")
def model(town):
    """Adapted to the town."""
    path = town / "town.model"
    assert main(["adapt", str(town / "bare"), "--model", str(path), "--no-progress"]) == 0
    return path


def test_is_a_model_that_says_what_it_is_of(model, town, tmp_path, capsys):
    loaded = ps.load_model(model)
    assert loaded.codes.tolist() == [2, 5, 6] and len(loaded.passes) == 2
    standard = ps.load_model("standard")
    assert (
        loaded.voxel == standard.voxel
        and loaded.info["preparation"] == standard.info["preparation"]
    )
    assert (
        loaded.info["teacher"]["name"] == "standard"
        and loaded.info["teacher"]["sure"] == adapting.LEAST_RELIABILITY
    )
    assert "what standard is sure of (0.7 and more)" in str(loaded)
    assert "not scored" in str(loaded) and "overall accuracy" not in str(loaded)
    source, target = town / "bare" / "t0.laz", tmp_path / "o.laz"
    code, output = run(capsys, "classify", source, target, "--model", model, "--keep-sure", "0.9")
    assert (
        code == 1
        and "it was never scored" in output
        and "Its labels are another model's answers" in output
    )
    assert run(capsys, "classify", source, target, "--model", model)[0] == 0
    truth = MADE().classification[MADE().xyz[:, 0] > 500_033.0]
    predicted = np.asarray(laspy.read(target).classification)
    known = np.isin(truth, (2, 5, 6))
    assert (predicted == truth)[known].mean() > 0.9


def test_tiles_and_classes_that_are_there_change_nothing(model, town, tmp_path, capsys):
    other, tiles = tmp_path / "o.model", ("--tile", "40", "--workers", "0")
    assert run(capsys, "adapt", town / "labeled", "--model", other, *tiles)[0] == 0
    assert other.read_bytes() == model.read_bytes()
    assert [entry.name for entry in tmp_path.iterdir()] == ["o.model"]


def test_only_what_is_sure_is_learned(tmp_path, write_las):
    random = np.random.default_rng(0)
    points = dict(zip("XYZ", random.random((3, 500)), strict=True))
    sure = points["Reliability"] = random.random(500).astype(np.float32)
    codes = points["Classification"] = random.choice([1, 2, 6], 500).astype(np.uint8)
    files = [str(write_las(tmp_path / f"{name}.laz", points, point_format=6)) for name in "ab"]
    counts = {code: 2 * int((codes[sure >= 0.9] == code).sum()) for code in (2, 6)}
    assert sure_points(files, 0.9, (2, 6)) == counts


def test_a_class_that_is_not_there(town, tmp_path, write_las, capsys):
    wood = (MADE().classification != 6) & (MADE().classification != 1)
    write_las(
        tmp_path / "wood.laz", dict(zip("XYZ", MADE().xyz[wood].T, strict=True)), point_format=6
    )
    code, output = run(capsys, "adapt", tmp_path / "wood.laz", "--model", tmp_path / "o.model")
    assert code == 0 and "too few points of a class" in output and "class 6" in output
    assert ps.load_model(tmp_path / "o.model").codes.tolist() == [2, 5]
    flat = np.random.default_rng(0).uniform(0, 60, (3, 9000)) * [[1], [1], [0.001]]
    write_las(tmp_path / "flat.laz", dict(zip("XYZ", flat, strict=True)), point_format=6)
    code, output = run(capsys, "adapt", tmp_path / "flat.laz", "--model", tmp_path / "p.model")
    assert code == 1 and "fewer than two of its classes" in output and "of class 2" in output
    assert {entry.name for entry in tmp_path.iterdir()} == {"wood.laz", "flat.laz", "o.model"}


@pytest.mark.parametrize(
    "words, said",
    [
        (("nix.laz", "--model", "o.model"), "there is no such file"),
        (("{town}/bare", "--model", "nix/o.model"), "does not exist"),
        (
            ("{town}/bare", "--model", "o.model", "--sure", "1.5"),
            "'--sure' must be a number from 0 to 1",
        ),
        (("{town}/bare", "--model", "o.model", "--teacher", "standart"), "standart"),
        (("{town}/bare/t0.laz", "--model", "{town}/bare/t0.laz"), "t0.laz"),
        (("cut.laz", "--model", "o.model"), "cut.laz"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_is_left(
    town, tmp_path, capsys, monkeypatch, words, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cut.laz").write_bytes((town / "bare" / "t0.laz").read_bytes()[:9000])
    before = (town / "bare" / "t0.laz").read_bytes()
    code, reported = run(capsys, "adapt", *(word.format(town=town) for word in words))
    assert code != 0 and said in reported
    assert (town / "bare" / "t0.laz").read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["cut.laz"]


def test_of_many_files_some_are_looked_at(town):
    files = [str(town / "bare" / f"t{number % 2}.laz") for number in range(9)]
    assert spread(files) == (files, [])
    points = sum(len(laspy.read(file)) for file in files)
    chosen, reported = spread(files, points // 3)
    assert chosen == files[1::3] and "3 of 9 files" in reported[0]
    chosen, _ = spread(files[:2], 10)
    assert len(chosen) == 1
    assert spread(["a.ply"], 10) == (["a.ply"], [])
