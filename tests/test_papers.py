"""benchmarks/papers: the tables, the cache, ``.pts`` input through PDAL, tiny experiments on the generated town."""

from __future__ import annotations

import glob
import importlib
import json
import re
import shlex
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks" / "papers"
if str(FOLDER) not in sys.path:
    sys.path.insert(0, str(FOLDER))

import b16_experiments  # noqa: E402
import clouds  # noqa: E402
import h17_oakland  # noqa: E402
import kit  # noqa: E402
import maps  # noqa: E402
import pts_input  # noqa: E402
import scenes  # noqa: E402
import w18  # noqa: E402

from pdal_stages.classifier.training_options import RECIPES  # noqa: E402
from pdal_stages.features import compute_features  # noqa: E402

#: The town's ASPRS codes -> labels of the Vaihingen files that they stand in for.
LABELS = {2: 2, 3: 1, 5: 8, 6: 5}


@pytest.fixture(scope="module")
def town():
    from pdal_stages.synthetic import make_town

    points = make_town(size=60, density=4, seed=3)
    labels = np.full(len(points), 7)
    for code, label in LABELS.items():
        labels[points.classification == code] = label
    dimensions = {
        "Intensity": points.intensity.astype(float),
        "ReturnNumber": points.return_number.astype(float),
        "NumberOfReturns": points.number_of_returns.astype(float),
    }
    return clouds.Cloud("town", points.xyz, labels, dimensions)


@pytest.fixture(scope="module")
def folder(town, tmp_path_factory):
    """A scene of two ``.pts`` files, west and east."""
    root = tmp_path_factory.mktemp("papers")
    (root / "town").mkdir()
    west = town.xyz[:, 0] < np.median(town.xyz[:, 0])
    pts_input.write_pts(root / "town" / "train.pts", town.only(west))
    pts_input.write_pts(root / "town" / "test.pts", town.only(~west))
    return root


# ---- .pts ------------------------------------------------------------------------------------------------


@pytest.mark.pdal
def test_pts_through_pdal(folder, tmp_path, monkeypatch):
    """The commands of docs/papers.md for clouds that cannot be had, on a stand-in with the same format."""
    from pdal_stages.pipeline.json_source import parse_overrides
    from pdal_stages.pipeline.run import Pipeline

    monkeypatch.chdir(tmp_path)

    def run(name, *words):
        overrides, rest = parse_overrides(words)
        assert not rest
        Pipeline(FOLDER / f"{name}.json", overrides).execute()

    quick = [
        "--stage.model.neighborhoods=c2,s2",
        "--stage.model.count=200",
        "--stage.model.trees=10",
    ]
    # The files' nine labels, with each class of the town cut into parts by squares of 10 m: parts of a class look alike.
    parts = {2: (2, 0, 3), 1: (1, 7), 8: (8, 4), 5: (5, 6)}
    for name in ("train", "test"):
        cloud = pts_input.read_pts([folder / "town" / f"{name}.pts"], name)
        square = np.floor(cloud.xyz[:, :2] / 10).sum(axis=1).astype(int)
        labels = cloud.labels.copy()
        for label, into in parts.items():
            members = cloud.labels == label
            labels[members] = np.array(into)[square[members] % len(into)]
        nine = clouds.Cloud(name, cloud.xyz, labels, cloud.dimensions)
        pts_input.write_pts(tmp_path / f"{name}.pts", nine)
    run("vaihingen-train", f"--stage.input.filename={tmp_path / 'train.pts'}", *quick)
    run("vaihingen-evaluate", f"--stage.input.filename={tmp_path / 'test.pts'}")
    report = json.loads((tmp_path / "vaihingen-accuracy.json").read_text())
    codes = [entry["code"] for entry in report["classes"]]
    assert sorted(codes) == [3, 4, 5, 6, 11, 14, 64, 65, 67]
    test = pts_input.read_pts([tmp_path / "test.pts"], "test")
    matrix = np.array(report["confusion"]["counts"])
    assert matrix.sum() == len(test)
    # What was cut apart joined again: impervious surface, low vegetation, tree, roof.
    whole = {11: 0, 14: 0, 64: 0, 3: 1, 4: 1, 5: 2, 65: 2, 6: 3, 67: 3}
    joined = np.zeros((4, 4), int)
    at = [whole[code] for code in codes]
    np.add.at(joined, np.ix_(at, at), matrix)
    assert np.trace(joined) / joined.sum() > 0.7


# ---- experiments -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(folder, tmp_path_factory):
    cache = kit.Cache(tmp_path_factory.mktemp("cache"))
    return scenes.load(
        folder, "town", cache, classes=(1, 2, 5, 8), neighborhoods="c1,c2,c3,c5,kopt"
    )


def test_b16_searches_the_trees_of_the_recipe():
    assert b16_experiments.TREES is RECIPES["blomley2016"]["trees_grid"]


def test_w18_run(scene):
    trainer = w18.Trainer(scene, trees=10, threads=1)
    full = trainer.run(100, 0)
    best = w18.best_tenth(full)
    assert len(best) == round(full["features"] / 10)
    assert sum(full["importance"].values()) == pytest.approx(1, abs=1e-3)
    runs = [
        {"scene": "town", "kind": "all", "count": 100, "target": None, "seed": 0, **full},
        {
            "scene": "town", "kind": "best tenth", "count": 100, "target": None, "seed": 0,
            **trainer.run(100, 0, chosen=best),
        },
        {"scene": "town", "kind": "all", "count": 100, "target": "5", "seed": 0, **trainer.run(100, 0, target=(5,))},
    ]  # fmt: skip
    assert runs[2]["classes"] == [0, 5]
    assert runs[1]["oa"] > 60
    text = w18.report(runs)
    (row,) = [line for line in text.splitlines() if "binary" in line]
    cells = [cell.strip() for cell in row.strip("|").split("|")][3:]
    binary = runs[2]
    both = [f"{binary[key][code]:.2f}" for code in ("5", "0") for key in w18.OF_CLASS]
    assert cells == [*both, *(f"{binary[key]:.2f}" for key in w18.OF_RUN)]
    assert "Background recall | Background precision | Background F1 | OA | Kappa" in text
    assert scenes.name_of("vaihingen", 8) == "Tree"  # not "Model key-point"
    assert "best tenth" in text
    assert "HeightAboveGround" in text


def test_the_maps_of_figure_4(folder, capsys, monkeypatch):
    """[W18 Figure 4]: the multi-class result and one of each target against "Background"."""
    monkeypatch.setitem(
        maps.SCENES, "town", ("town/train.pts", "town/test.pts", {"1": 3, "2": 11, "5": 6, "8": 5})
    )
    monkeypatch.setitem(maps.TARGETS, "town", ((5,), (8,)))
    quick = {
        "neighborhoods": "c2,s2",
        "feature_set": "covariance,geometric",
        "count": 200,
        "trees": 10,
    }
    picture = maps.figure_4(folder, "town", quick)
    printed = capsys.readouterr().out
    assert printed.count("(Background ") == 2 and "kappa" in printed and "Building" in printed
    half = picture.shape[0] // 2, picture.shape[1] // 2
    colors = [picture[: half[0], half[1] :], picture[half[0] :, : half[1]]]
    assert not np.array_equal(*colors) and len(picture) > 100


def test_h17_thresholds_are_a_choice_between_two_tables(town):
    """The command takes together from two tables is what the engine computes at that threshold."""
    cloud = clouds.with_height(clouds.Cloud("town", town.xyz, town.labels))
    part = h17_oakland.compute([cloud], kit.Cache(None), 1)
    words = (*h17_oakland.SIX, "Radius")
    direct = compute_features(
        town.xyz, neighborhoods="copt", feature_set=words, copt_threshold=0.05
    )
    np.testing.assert_array_equal(
        part.adaptive(0.05), np.column_stack([direct[f"{w}_copt"] for w in words])
    )
    direct = compute_features(town.xyz, neighborhoods="rdim", feature_set=words)
    rdim = part.table(h17_oakland.BY_DIMENSIONALITY, 0.03)
    np.testing.assert_array_equal(rdim, np.column_stack([direct[f"{w}_rdim"] for w in words]))
    assert len(h17_oakland.CURVE) == 9  # [H17 3.3, Figure 4]: 0.01 to 0.05 by 0.005
    assert 0.05 < (part.curvature >= 0.05).mean() < 0.95
    shares = h17_oakland.shares(part.labels, part.curvature, 0.0)
    assert all(share["points"] == share["scattered"] for share in shares.values())


# ---- the page's commands -----------------------------------------------------------------------------------

ROOT = FOLDER.parent.parent
#: What makes a command quick; maps.py draws the pictures of forests, as PyTorch is not everywhere.
QUICK = {
    "b16_experiments.py": "--seeds 1",
    "w18.py": "--seeds 1 --count 30 --trees 3",
    "maps.py": "--only blomley2016 weinmann2018 weinmann2018-binary he2017",
    "pdal-stages train": "--writers.classifiermodel.count=60 --writers.classifiermodel.trees=3 --neighborhoods k10",
    "vaihingen-train.json": "--stage.model.neighborhoods=c2 --stage.model.count=60 --stage.model.trees=3",
}
#: Numbers of samples and trees that are no options, and their quick values.
SMALL = {
    "h17_oakland": {"COUNT": 20, "TREES": 3, "CURVE": (0.03,), "HEIGHTS": ("range",), "OTHERS": ()},
    "b16_experiments": {"COUNT": 20, "TREES": (3,)},
}


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A folder with clouds under the names of the papers' data, and the repository's commands."""
    from pdal_stages.synthetic import make_town, write_town

    monkeypatch.chdir(tmp_path)
    write_town(make_town(size=40, density=3, seed=5, progress=False), tmp_path / "town.laz")
    las = laspy.read("town.laz")
    las = las[np.isin(las.classification, (2, 3, 5, 6))]
    other = {"delft": {3: 1, 5: 1}, "montpellier": {}, "oakland": {3: 14}}
    parts = {"delft": ("train.laz", "test.laz"), "montpellier": ("train_a.laz", "test_a.laz")}
    parts["oakland"] = ("train/a.laz", "test/oakland_part2_ac.laz", "val/a.laz")
    west = np.asarray(las.x) < np.median(las.x)
    for scene, names in parts.items():
        for number, name in enumerate(names):
            part = las[west if number % 2 == 0 else ~west]
            for code, label in other[scene].items():
                part.classification[part.classification == code] = label
            labels = np.asarray(part.classification).copy()
            labels[::7] = {"oakland": 15, "montpellier": 4}.get(scene, 1)
            part.classification = labels
            (tmp_path / "DIR" / scene / name).parent.mkdir(parents=True, exist_ok=True)
            part.write(tmp_path / "DIR" / scene / name)
    cloud = clouds.read_cloud(["town.laz"], "town")
    nine = clouds.Cloud("town", cloud.xyz, np.arange(len(cloud)) % 9, {})
    for name in ("Vaihingen3D_Traininig.pts", "Vaihingen3D_EVAL_WITH_REF.pts"):
        pts_input.write_pts(tmp_path / name, nine)
    (tmp_path / "benchmarks").symlink_to(ROOT / "benchmarks")
    (tmp_path / "docs" / "pictures").mkdir(parents=True)
    return tmp_path


@pytest.mark.pdal
@pytest.mark.slow
def test_commands_of_the_page_run_as_printed(stand_in, monkeypatch, capsys):
    from pdal_stages.cli import main

    for module, values in SMALL.items():
        for name, value in values.items():
            monkeypatch.setattr(importlib.import_module(module), name, value)
    for recipe, (scene, more) in maps.MAPS.items():
        quick = {"trees_grid": (3,)} if recipe == "blomley2016" else {"trees": 3}
        monkeypatch.setitem(maps.MAPS, recipe, (scene, {**more, **quick, "count": 30}))
    page = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
    text = "\n".join(re.findall(r"^```sh\n(.*?)^```", page, re.DOTALL | re.MULTILINE))
    lines = [*filter(None, text.replace("\\\n", " ").splitlines())]
    assert len(lines) == 9, lines
    for line in lines:
        words = [name for word in shlex.split(line) for name in (sorted(glob.glob(word)) or [word])]
        words += [word for key, more in QUICK.items() if key in line for word in shlex.split(more)]
        if words[0] == "python":
            monkeypatch.setattr(sys, "argv", words[1:])
            importlib.import_module(Path(words[1]).stem).main()
        else:
            assert main(words[1:]) == 0, (words, capsys.readouterr().err)
    assert {path.name for path in (stand_in / "docs" / "pictures").iterdir()} == {
        f"paper-{name}.png" for name in QUICK["maps.py"].split()[1:]
    }
    report = json.loads((stand_in / "vaihingen-accuracy.json").read_text())
    assert len(report["classes"]) == 9
