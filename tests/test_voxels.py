"""One point for each voxel of dense clouds: an obvious reference, any order, any tile, and models that use it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages import TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.features.voxels import represent


def crowd(seed=0, n=6000, side=12.0, dense=4.0):
    """A cloud that is ten times as dense in a corner, some points twice."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(0, side, (n, 2)), rng.normal(0, 0.3, n)])
    xyz[: n // 2, :2] *= dense / side
    xyz[:50] = xyz[50:100]
    return np.round(xyz, 3) + np.array([600_000.0, 5_000_000.0, 100.0])


@pytest.mark.parametrize("side", [0.25, 0.3, 1.0, 2.5])
def test_one_of_each_voxel(side):
    xyz = crowd(n=2500)
    voxels = represent(xyz, side)
    voxel = [tuple(np.floor(p * (1.0 / side))) for p in xyz]
    assert voxels is not None
    points, place = voxels.members.take(np.arange(len(voxels.rows)))
    assert sorted(points) == list(range(len(xyz)))
    assert all(voxel[p] == voxel[r] for p, r in zip(points, voxels.rows[place], strict=True))
    assert len(voxels.rows) == len(set(voxel))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31), st.sampled_from([0.2, 0.25, 1.0]))
def test_any_order_and_any_tile(seed, side):
    xyz = crowd(seed % 7)
    value = np.random.default_rng(seed).integers(0, 3, len(xyz))
    whole = represent(xyz, side, [value])
    order = np.random.default_rng(seed).permutation(len(xyz))
    other = represent(xyz[order], side, [value[order]])
    if whole is None:
        assert other is None
        return
    rows = lambda points, v, kept: sorted(map(tuple, np.column_stack([points[kept], v[kept]])))  # noqa: E731
    assert rows(xyz, value, whole.rows) == rows(xyz[order], value[order], other.rows)
    core = (xyz[:, 0] < 600_003.1) & (xyz[:, 1] < 5_000_003.7)
    near = np.flatnonzero((xyz[:, 0] < 600_003.1 + side) & (xyz[:, 1] < 5_000_003.7 + side))
    tile = represent(xyz[near], side, [value[near]])
    kept = np.arange(len(near)) if tile is None else tile.rows
    inside = lambda chosen: {r for r in chosen if core[r]}  # noqa: E731
    assert {tuple(xyz[r]) for r in inside(near[kept])} == {
        tuple(xyz[r]) for r in inside(whole.rows)
    }


def test_points_asked_for():
    xyz = crowd()
    rows = np.flatnonzero(np.arange(len(xyz)) % 5 == 0)
    voxels = represent(xyz, 0.25, (), rows)
    points, _ = voxels.members.take(voxels.members.wanted())
    assert np.array_equal(np.sort(points), rows)


def test_sparse_clouds_stay():
    assert represent(np.unique(crowd(), axis=0), 1e-4) is None
    assert represent(crowd(), 0.0) is None


@pytest.fixture(scope="module")
def model():
    xyz = crowd(n=9000)
    labels = np.where(xyz[:, 2] > 100.1, 5, 2)
    options = TrainingOptions(
        neighborhoods="s1,k10", dimensions=(), trees=8, count=200, voxel=0.25, threads=2
    )
    return train(TrainingCloud(xyz, labels), options, progress=False)


@pytest.mark.parametrize("how", [{"reject_below": 0.7}, {"margin": True, "probabilities": True}])
def test_members_get_the_same(model, how, tmp_path):
    xyz = crowd(3)
    where = xyz[:, 0] < 600_006.0
    old = np.full(len(xyz), 9)
    prediction = model.predict(xyz, {}, where, current=old, **how)
    few = represent(xyz, 0.25)
    thin = model.predict(xyz[few.rows], {}, where[few.rows], current=old[few.rows], **how)
    assert (prediction.classification[~where] == 9).all()
    stands = few.rows
    both = where[stands]
    for name in ("classification", "reliability", "margin", "probabilities"):
        a, b = getattr(prediction, name), getattr(thin, name)
        if a is not None:
            assert np.array_equal(a[stands][both], b[both])
    points, place = few.members.take(np.arange(len(few.rows)))
    inside = where[points] & where[stands[place]]
    assert np.array_equal(
        prediction.reliability[points][inside], prediction.reliability[stands[place]][inside]
    )
    assert prediction.report.figures["representatives"] == len(few.rows)
    assert prediction.report.figures["classified"] + len(prediction.unsure) == where.sum()
    model.save(tmp_path / "m.model")
    again = load_model(tmp_path / "m.model")
    assert again.voxel == 0.25
    assert np.array_equal(
        again.predict(xyz, {}, where, current=old, **how).classification, prediction.classification
    )
    order = np.random.default_rng(0).permutation(len(xyz))
    shuffled = model.predict(xyz[order], {}, where[order], current=old, **how)
    assert np.array_equal(shuffled.classification, prediction.classification[order])


def test_tile_is_the_whole(model):
    xyz = crowd(5, n=20_000, side=60.0, dense=25.0)
    whole = model.predict(xyz, {})
    near = (xyz[:, 0] < 600_010.0 + model.halo_m) & (xyz[:, 1] < 5_000_010.0 + model.halo_m)
    core = (xyz[:, 0] < 600_010.0) & (xyz[:, 1] < 5_000_010.0)
    assert not near.all()
    tile = model.predict(xyz[near], {})
    assert np.array_equal(tile.reliability[core[near]], whole.reliability[core])
