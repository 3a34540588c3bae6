"""What tiles share along their edges: fewer points are computed, and not a bit changes."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from tiling_clouds import CELL, same_points, town

import pdal_stages as ps
from pdal_stages.classifier.model import Model
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.terrain.minima import hag_minima
from pdal_stages.tiling import edges, run_tiled
from pdal_stages.tiling.pool import Here
from pdal_stages.tiling.tileplan import SharedEdges, make_plan

SIDE = 30


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model of two passes, trained on another town."""
    made = ps.make_town(60.0, 4.0, seed=9)
    options = ps.TrainingOptions(
        neighborhoods="s1,k10",
        feature_set=["covariance"],
        dimensions=("HeightAboveGround",),
        classes={"2": 2, "3,4,5": 5, "6": 6},
        context=["own", "box1", "columnvotes2"],
        passes=2,
        voxel=0.25,
        count=150,
        trees=8,
    )
    heights = hag_minima(*made.xyz.T, cell=CELL)
    cloud = ps.TrainingCloud(made.xyz, made.classification, {"HeightAboveGround": heights})
    path = tmp_path_factory.mktemp("model") / "two.model"
    ps.train([cloud], options, progress=False).save(path)
    return str(path)


@pytest.fixture(scope="module")
def survey(tmp_path_factory, write_las):
    """Two files that do not end where tiles do, as their points come in no order."""
    folder = tmp_path_factory.mktemp("survey")
    _, xyz, there = town()
    rng = np.random.default_rng(3)
    paths = []
    for name, mine in (("west", xyz[:, 0] < 500_047.0), ("east", xyz[:, 0] >= 500_047.0)):
        rows = rng.permutation(np.flatnonzero(mine & there))
        arrays = {axis: xyz[rows, n] for n, axis in enumerate("XYZ")}
        codes = np.where(rng.random(len(rows)) < 0.02, 7, 1).astype(np.uint8)
        paths.append(str(write_las(folder / f"{name}.las", {**arrays, "Classification": codes})))
    return paths


def pipeline(survey, model, folder, **options):
    folder.mkdir(exist_ok=True)
    return [
        *survey,
        {"type": "filters.hag_minima", "cell": CELL},
        {"type": "filters.modelclassifier", "model": model, **options},
        {"type": "filters.consistency"},
        {"type": "writers.las", "filename": str(folder / "#.las"), "extra_dims": "all", "forward": "all"},
    ]


@pytest.fixture
def computed(monkeypatch):
    """How many points each prediction was asked for, and of how many the votes were known."""
    found = []
    predict = Model.predict

    def noted(self, xyz, dimensions, where, **more):
        votes = more.get("votes")
        found.append((np.count_nonzero(where), 0 if votes is None else len(votes.rows)))
        return predict(self, xyz, dimensions, where, **more)

    monkeypatch.setattr(Model, "predict", noted)
    return found


def in_tiles(stages, **options):
    run = run_tiled(stages, SIDE, workers=0, progress=False, **options)
    assert not run.failures
    return run


@pytest.fixture(scope="module")
def alone(tmp_path_factory, survey, model):
    """What tiles give that share nothing, by the options of the classifier."""
    made = {}

    def given(**options):
        key = repr(options)
        if key not in made:
            folder = tmp_path_factory.mktemp("alone")
            with pytest.MonkeyPatch.context() as patched:
                patched.setattr(edges.TileEdges, "save", lambda self: None)
                in_tiles(pipeline(survey, model, folder, **options))
            made[key] = folder
        return made[key]

    return given


def test_the_plan_says_how_wide(survey, model, tmp_path):
    plan = make_plan(Pipeline(pipeline(survey, model, tmp_path), whole=False))
    assert plan.shares == SharedEdges(1, plan.later[1], plan.later[1] + 4.0)
    for options in ({"smooth": 1.0}, {"reject_below": 0.5}):
        assert make_plan(Pipeline(pipeline(survey, model, tmp_path, **options), whole=False)).shares is None


@pytest.mark.pdal
@pytest.mark.parametrize("options", [{}, {"margin": True, "probabilities": True}])
def test_points_along_edges_are_computed_once(tmp_path, survey, model, alone, computed, options):
    for name in ("west", "east"):
        assert (alone(**options) / f"{name}.las").exists()
    every = sum(number for number, _ in computed)
    computed.clear()
    in_tiles(pipeline(survey, model, tmp_path / "out", **options))
    for name in ("west", "east"):
        same_points(alone(**options) / f"{name}.las", tmp_path / "out" / f"{name}.las")
    assert sum(known for _, known in computed) > 0
    if every:  # otherwise they were made for another test
        assert sum(number for number, _ in computed) < 0.8 * every
    assert not list((tmp_path / "out").rglob("*.edges.npz"))


@pytest.mark.pdal
@pytest.mark.parametrize("order", ["backward", "shuffled"])
def test_the_order_of_tiles_does_not_matter(tmp_path, survey, model, alone, monkeypatch, order):
    run = Here.run

    def ordered(self, waiting, task_of):
        items = list(waiting)
        waiting.clear()
        rng = np.random.default_rng(1)
        waiting.extend(
            items[::-1] if order == "backward" else [items[n] for n in rng.permutation(len(items))]
        )
        assert isinstance(waiting, deque)
        return run(self, waiting, task_of)

    monkeypatch.setattr(Here, "run", ordered)
    in_tiles(pipeline(survey, model, tmp_path / "out"))
    for name in ("west", "east"):
        same_points(alone() / f"{name}.las", tmp_path / "out" / f"{name}.las")


@pytest.mark.pdal
def test_files_that_are_cut_or_of_an_earlier_run_are_not_believed(
    tmp_path, survey, model, alone, computed, monkeypatch
):
    save = edges.TileEdges.save

    def cut(self):
        save(self)
        path = self._path(self._tile)
        with open(path, "r+b") as file:
            file.truncate(1000)

    monkeypatch.setattr(edges.TileEdges, "save", cut)
    folder = tmp_path / "out"
    in_tiles(pipeline(survey, model, folder))
    assert not sum(known for _, known in computed)
    for name in ("west", "east"):
        same_points(alone() / f"{name}.las", folder / f"{name}.las")

    def wrong(self):  # as of other inputs
        self._left = {
            key: np.zeros_like(values) if key.endswith(("values", "classification")) else values
            for key, values in self._left.items()
        }
        save(self)

    monkeypatch.setattr(edges.TileEdges, "save", wrong)
    monkeypatch.setattr("pdal_stages.tiling.store.Store.forget_edges", lambda self: None)
    in_tiles(pipeline(survey, model, folder))
    monkeypatch.undo()
    assert list(folder.rglob("*.edges.npz"))
    for path in folder.glob("*.las"):
        path.unlink()
    for note in (folder / ".pdal-stages" / "tiles").glob("*.json"):
        note.unlink()
    in_tiles(pipeline(survey, model, folder), resume=True)
    for name in ("west", "east"):
        same_points(alone() / f"{name}.las", folder / f"{name}.las")


@pytest.mark.pdal
def test_a_tile_that_saw_too_little_leaves_nothing(tmp_path, survey, model, monkeypatch):
    saved = []
    monkeypatch.setattr(edges.TileEdges, "save", lambda self: saved.append(self._tile))
    run = in_tiles(pipeline(survey, model, tmp_path / "out"), most_points=10)
    short = {job.tile for job in run.tiles if job.record.get("short")}
    assert not short & set(saved)
    assert {job.tile for job in run.tiles if job.record.get("points")} <= short | set(saved)
