"""Clouds in parts: what is trained on them is, to the last bit, what is trained on the whole."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.context import Context
from pdal_stages.classifier.parts import CloudParts, prepared_parts
from pdal_stages.classifier.samplefeatures import SHORT
from pdal_stages.classifier.surroundings import Looks, Seen
from pdal_stages.classifier.thinning import DensityOfParts, density
from pdal_stages.classifier.training import train_parts
from pdal_stages.features import FeaturePlan

QUICK = {
    "count": 120,
    "trees": 4,
    "threads": 1,
    "voxel": 0.25,
    "block_size": 10.0,
    "dimensions": ("Intensity",),
}


def scene(n=6000, size=60.0, seed=0, **more):
    """Ground and boxes on it, noise above, strays; some of the labels are not to be used."""
    random = np.random.default_rng(seed)
    xy = random.random((n, 2)) * size + (1000.0, -20.0)
    roof = ((xy // 7).sum(axis=1) % 3) == 0
    z = np.where(roof, 5.0, 0.0) + random.normal(0, 0.05, n)
    labels = np.where(roof, 6, 2)
    bush = random.random(n) < 0.15
    z, labels = z + bush * random.random(n) * 3, np.where(bush, 5, labels)
    noise = random.random(n) < 0.01
    z, labels = np.where(noise, 60.0, z), np.where(noise, 7, labels)
    labels = np.where(random.random(n) < 0.05, 1, labels)
    xyz = np.column_stack([xy, z])
    dimensions = {
        "Intensity": random.integers(0, 99, n).astype(np.uint16),
        "Flight": (xy[:, 0] // 20).astype(int),
    }
    return TrainingCloud(xyz, labels, dimensions, "scene", **more)


def cut(cloud, side, folder, most=np.inf, seed=1):
    """The cloud in squares, the points of each in any order."""
    parts = CloudParts(folder, side, most)
    tiles = np.floor(cloud.xyz[:, :2] / side).astype(int)
    random = np.random.default_rng(seed)
    for tile in np.unique(tiles, axis=0):
        rows = random.permutation(np.flatnonzero((tiles == tile).all(axis=1)))
        part = cloud.part(rows)
        parts.put(
            tuple(tile.tolist()), TrainingCloud(part.xyz, part.labels, part.dimensions, cloud.name, part.mask)
        )
    return parts


def files_of(cloud, options, side, folder, **more):
    """The model of the whole and that of the parts, as files."""
    train([cloud], options, progress=False).save(folder / "whole.model")
    (folder / "parts").mkdir()
    found = train_parts([cut(cloud, side, folder / "raw", **more)], options, folder / "parts", progress=False)
    found.save(folder / "parts.model")
    assert not (folder / "raw").exists()
    return (folder / "whole.model").read_bytes(), (folder / "parts.model").read_bytes()


@pytest.mark.parametrize("side", [9.7, 25.0, 1000.0])
def test_defaults(tmp_path, side):
    whole, parts = files_of(scene(), TrainingOptions(**QUICK), side, tmp_path)
    assert whole == parts


@pytest.mark.parametrize(
    "more",
    [
        {"voxel": 0.3, "thin": (0.8, 0.2)},
        {"voxel": 0.0, "passes": 1, "groups": "Flight", "prior_weight": 0.5},
        {"passes": 3, "context": ("own", "box2"), "balance": False},
        {"neighborhoods": "s2,kopt(5,12)", "feature_set": ("covariance", "D1", "A3"), "passes": 1},
        {"neighborhoods": "k20", "feature_set": ("covariance", "surfaces"), "trees": (2, 4), "folds": 2},
        {"strategy": "binary", "target": 6, "classes": {"2": 2, "5": 5, "6": 6, "7": 7}},
        {"dimensions": ("returns",)},
    ],
    ids=["thin", "groups", "three", "shapes", "surfaces", "binary", "returns"],
)
def test_other_options(tmp_path, more):
    cloud = scene()
    random = np.random.default_rng(5)
    number = random.integers(1, 4, len(cloud)).astype(np.uint8)
    returns = {"ReturnNumber": number, "NumberOfReturns": np.maximum(number, 2)}
    cloud = TrainingCloud(
        cloud.xyz, cloud.labels, {**cloud.dimensions, **returns}, "scene", random.random(6000) < 0.8
    )
    whole, parts = files_of(cloud, TrainingOptions(**{**QUICK, **more}), 17.0, tmp_path)
    assert whole == parts


def test_on_top_of_a_model(tmp_path):
    base = train([scene(seed=8)], TrainingOptions(**QUICK), progress=False)
    options = TrainingOptions(**{**QUICK, "base": base, "classes": {"2": 2, "6": 6}})
    whole, parts = files_of(scene(), options, 17.0, tmp_path)
    assert whole == parts


def test_nearest_neighbors_may_lie_several_parts_away(tmp_path):
    """At one point on 40 m2 the fifty nearest lie 25 m around, and those of a stray farther yet."""
    cloud = scene(900, 190.0)
    xyz = np.concatenate([cloud.xyz, [[1095.0, 75.0, 70.0]]])
    dimensions = {name: np.append(values, values[:1]) for name, values in cloud.dimensions.items()}
    cloud = TrainingCloud(xyz, np.append(cloud.labels, 5), dimensions, "scene")
    options = TrainingOptions(**{**QUICK, "block_size": 40.0, "neighborhoods": "k50"})
    whole, parts = files_of(cloud, options, 21.0, tmp_path)
    assert whole == parts


def test_what_the_memory_does_not_allow_to_see_is_counted(tmp_path):
    options = TrainingOptions(**{**QUICK, "block_size": 40.0, "neighborhoods": "k50"})
    (tmp_path / "parts").mkdir()
    parts = cut(scene(900, 190.0), 21.0, tmp_path / "raw", most=100)
    model = train_parts([parts], options, tmp_path / "parts", progress=False)
    assert model.info["training"][SHORT] > 0


def test_clouds_of_which_each_is_in_parts(tmp_path):
    """Surveys that lie in one another do not see each other."""
    options = TrainingOptions(**QUICK)
    named = {"north": scene(seed=2), "south": scene(3000, 40.0, seed=3)}
    clouds = [TrainingCloud(c.xyz, c.labels, c.dimensions, name) for name, c in named.items()]
    train(clouds, options, progress=False).save(tmp_path / "whole.model")
    (tmp_path / "parts").mkdir()
    cuts = [cut(cloud, 15.0, tmp_path / cloud.name) for cloud in clouds]
    train_parts(cuts, options, tmp_path / "parts", progress=False).save(tmp_path / "parts.model")
    assert (tmp_path / "whole.model").read_bytes() == (tmp_path / "parts.model").read_bytes()


@settings(deadline=None, max_examples=60)
@given(
    arrays(
        np.float64,
        st.tuples(st.integers(0, 60), st.just(3)),
        elements=st.integers(-40, 40).map(lambda n: n / 4),
    ),
    st.sampled_from([1.0, 2.5, 6.0, 50.0]),
)
def test_density_of_parts(xyz, side):
    found = DensityOfParts()
    tiles = np.floor(xyz[:, :2] / side).astype(int)
    for i, j in np.unique(tiles, axis=0):
        mine = (tiles == (i, j)).all(axis=1)
        found.add(xyz[mine], (i * side, j * side, (i + 1) * side, (j + 1) * side))
    assert found.density() == density(xyz)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1000), st.sampled_from(["k5", "k9"]), st.booleans())
def test_who_has_neighbors_beyond_what_is_seen_is_told(seed, token, context):
    """Never fewer than those whose neighbors, or the neighbors of what their context looks at, change with more points."""
    random = np.random.default_rng(seed)
    xyz = random.random((300, 3)) * (30, 30, 2) + random.integers(0, 2, (300, 1)) * (0, 0, 9)
    box = (8.0, 8.0, 22.0, 22.0)
    here = ((xyz[:, :2] >= box[:2]) & (xyz[:, :2] <= box[2:])).all(axis=1)
    seen = xyz[here]
    rows = np.flatnonzero(((seen[:, :2] >= 12) & (seen[:, :2] <= 18)).all(axis=1))
    if not len(rows) or len(seen) < 12:
        return
    contexts = [Context(("box1",))] if context else []
    narrow, more = Looks(FeaturePlan.parse(token, "covariance", ()), contexts).too_narrow(
        Seen(seen, {}, rows, box), 1
    )
    k = int(token[1:])
    to_all = np.sort(np.linalg.norm(seen[:, None] - xyz[None], axis=2), axis=1)[:, k]
    to_seen = np.sort(np.linalg.norm(seen[:, None] - seen[None], axis=2), axis=1)[:, k]
    wrong = to_all < to_seen
    if context:
        cells = np.floor(seen[:, :2])
        near = (np.abs(cells[rows][:, None] - cells[None]) <= 1).all(axis=2)
        wrong_rows = (near & wrong[None]).any(axis=1)
    else:
        wrong_rows = wrong[rows]
    assert not (wrong_rows & ~narrow).any()
    assert (more > 0) == narrow.any()


def test_parts_hold_each_point_once_and_one_of_each_voxel(tmp_path):
    cloud = scene()
    options = TrainingOptions(**{**QUICK, "voxel": 0.9})
    (tmp_path / "parts").mkdir()
    made = prepared_parts(cut(cloud, 8.1, tmp_path / "raw"), options, tmp_path / "parts", progress=False)
    xyz = np.concatenate([part.xyz for part in made])
    voxels = np.unique(np.floor(cloud.xyz[~np.isin(cloud.labels, 7)] * (1 / 0.9)), axis=0)
    assert len(xyz) == len(voxels) == sum(map(len, made))
    assert len(np.unique(np.floor(xyz * (1 / 0.9)), axis=0)) == len(xyz)
