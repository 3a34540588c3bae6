"""Training networks: PyTorch against NumPy, overfitting, resuming, transfer, held out ground."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alsnet_scenes import TINY, model_of, random_net, scene
from hypothesis import given, settings
from hypothesis import strategies as st

import pdal_stages
from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.alsnet.batches import JITTER, THIN, Batches, augment, build_pyramid
from pdal_stages.alsnet.training_data import (
    class_weights,
    cover,
    histogram_deviation,
    hold_out,
    join_clouds,
    select_batches,
)
from pdal_stages.base.errors import DependencyError, ModelError, OptionError
from pdal_stages.classifier.interface import PredictRequest

needs_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None,
    reason="PyTorch is not installed (extra 'deep'): training alsNet is not tested",
)


def fit(clouds=None, progress=False, dimensions=("HeightAboveGround",), **network):
    if clouds is None:
        xyz, labels, values = scene()
        clouds = [TrainingCloud(xyz, labels, values, name="scene")]
    network = {
        "configuration": TINY,
        "validation": 0,
        "epochs": 2,
        "histogram_threshold": 100,
        **network,
    }
    options = TrainingOptions(
        algorithm="alsnet", alsnet=network, dimensions=dimensions, seed=3, threads=1, voxel=0.0
    )
    return train(clouds, options, progress=progress)


# ---- which batches (no PyTorch) ------------------------------------------------------------------------------


def test_batches_of_one_class_are_passed_over_unless_a_class_would_be_lost():
    random = np.random.default_rng(0)
    xyz = random.random((4000, 3)) * [80.0, 20.0, 1.0]
    labels = np.where(
        xyz[:, 0] < 40, 0, random.integers(0, 2, 4000)
    )  # left: one class; right: two, mixed
    lonely = (xyz[:, 0] < 4) & (xyz[:, 1] < 4)
    labels[lonely] = 2
    batches = Batches(xyz, 200, 6.0)
    chosen, added = select_batches(batches, labels, 3, 30.0)
    assert added == 1  # for the class 2
    shares = [np.bincount(labels[batches.members(k)], minlength=3) for k in chosen]
    assert 1 < len(chosen) < len(batches)
    assert sum(histogram_deviation(s) >= 30.0 for s in shares) == 1
    assert sum(shares)[2] > 0
    assert select_batches(batches, labels, 3, 100.0) == (list(range(len(batches))), 0)


def test_ground_held_out_is_whole_blocks_with_all_classes():
    xyz, labels, _ = scene(4000, 60.0)
    position = np.searchsorted([2, 5, 6], labels)
    mask = hold_out(xyz, position, 0.2, 12.0)
    block = np.floor(xyz[:, :2] / 12.0).astype(int) @ [1, 1000]
    assert all(len(set(mask[block == b])) == 1 for b in np.unique(block))
    assert 0.1 < mask.mean() < 0.3
    assert set(position[mask]) == {0, 1, 2}
    assert not hold_out(xyz, position, 0.0, 12.0).any()
    with pytest.raises(OptionError, match="smaller blocks"):
        hold_out(xyz, position, 0.2, 1000.0)


def test_no_batch_holds_points_of_two_clouds():
    clouds = [scene(n, 12.0)[0] for n in (500, 700, 0, 300)]  # all in one place
    joined, part = (
        join_clouds(clouds, 3.0),
        np.repeat(np.arange(4), [len(entry) for entry in clouds]),
    )
    batches = Batches(joined, 100, 3.0)
    assert all(len(set(part[batches.members(k)])) == 1 for k in range(len(batches)))
    for k in (0, 1, 3):
        away = joined[part == k] - clouds[k]
        assert (
            np.allclose(away, away[0], atol=1e-9)
            and abs(away[0, 0] / 3.0 - round(away[0, 0] / 3.0)) < 1e-9
        )


def test_covering_batches_hold_every_wanted_point():
    xyz, _, _ = scene()
    batches = Batches(xyz, 256, 4.0)
    wanted = xyz[:, 0] > 15
    numbers = cover(batches, wanted)
    seen = np.zeros(len(xyz), bool)
    for number in numbers:
        seen[batches.members(number)] = True
    assert seen[wanted].all() and len(numbers) < len(batches)


def test_class_weights():
    count = np.array([100, 25, 400])
    assert class_weights(count, "none").tolist() == [1, 1, 1]
    root = class_weights(count, "sqrt")
    np.testing.assert_allclose(root[1] / root[2], 4.0)
    np.testing.assert_allclose((root * count).sum() / count.sum(), 1.0)
    even = class_weights(count, "balanced")
    np.testing.assert_allclose(even * count, (even * count)[0])


@given(st.integers(0, 2**32), st.integers(1, 300))
@settings(max_examples=20, deadline=None)
def test_augmentation_turns_shakes_and_thins(seed, n):
    xyz = np.random.default_rng(seed).normal(size=(n, 3)) * 10
    out, kept = augment(xyz, np.random.default_rng(seed))
    assert len(out) == len(kept) == len(set(kept.tolist()))
    assert len(kept) >= max(min(n, 16), int((1 - THIN) * n) - 1)
    away = 3 * JITTER * 3**0.5 + 1e-9
    assert (
        np.abs(np.linalg.norm(out[:, :2], axis=1) - np.linalg.norm(xyz[kept, :2], axis=1)).max()
        <= away
    )
    assert np.abs(out[:, 2] - xyz[kept, 2]).max() <= away


# ---- PyTorch --------------------------------------------------------------------------------------------------


@needs_torch
def test_torch_and_numpy_agree():
    from pdal_stages.alsnet.torch_network import Network, apply_on_device

    net = random_net(("Z", "Intensity"), 4)
    xyz, _, values = scene(256, 7.0)
    inputs = np.column_stack([xyz[:, 2], values["Intensity"] / 100.0]).astype(np.float32)
    pyramid = build_pyramid(xyz, inputs, TINY)
    network = Network(TINY, 2, 4).load(net.weights)
    result = apply_on_device("cpu", net.weights, TINY, 2, 4)(pyramid)
    np.testing.assert_allclose(result, net.network(pyramid), atol=2e-6)
    again = network.dump()
    assert list(again) == list(net.weights)
    assert all(np.array_equal(again[name], net.weights[name]) for name in again)


@needs_torch
@pytest.mark.parametrize("device", ["auto", "cuda"])
def test_a_device_for_applying(device):
    """Without a GPU auto is NumPy, and cuda says what is missing."""
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    xyz, _, values = scene(600, 12.0)
    net = random_net(("Z", "Intensity"), 4)
    request = PredictRequest(xyz, values, device=device)
    if device == "cuda":
        with pytest.raises(DependencyError, match="no CUDA device"):
            list(net.predict(request))
        return
    ((_, prediction, _),) = net.predict(request)
    ((_, expected, _),) = net.predict(PredictRequest(xyz, values))
    assert np.array_equal(prediction, expected)


@needs_torch
def test_a_tiny_network_overfits_a_tiny_scene():
    """Without heights above ground: from the points' positions alone."""
    xyz, labels, _ = scene(1200, 12.0)
    model = fit(
        [TrainingCloud(xyz, labels)],
        dimensions=(),
        configuration=replace(TINY, points=600),
        epochs=25,
        learning_rate=0.01,
        augment=False,
    )
    prediction = model.predict(xyz, {})
    assert np.mean(prediction.classification == labels) > 0.97
    curve = model.info["training"]["curve"]
    assert len(curve) == 25 and curve[-1]["loss"] < 0.3 * curve[0]["loss"]


@needs_torch
def test_early_stop_keeps_the_best_epoch():
    xyz, labels, values = scene(2500, 40.0)
    model = fit(
        [TrainingCloud(xyz, labels, values)],
        validation=0.25,
        block_size=6.0,
        epochs=30,
        patience=1,
        learning_rate=0.05,
    )
    training = model.info["training"]
    assert training["epochs"] < 30
    assert training["epochs"] - training["best_epoch"] == 1
    assert training["points_held_out"] > 0


@needs_torch
def test_transfer_starts_from_the_other_model(tmp_path):
    xyz, labels, values = scene()
    first = fit(epochs=6, learning_rate=0.01)
    first.save(tmp_path / "first.model")
    two = np.where(labels == 5, 1, labels)  # the tree is another class now
    model = fit(
        [TrainingCloud(xyz, two, values)], start_from=str(tmp_path / "first.model"), epochs=1, learning_rate=1e-8,
        patience=0,
    )  # fmt: skip
    fresh = fit([TrainingCloud(xyz, labels, values)], epochs=1, learning_rate=1e-8)
    old, new = first.algorithm, model.algorithm
    np.testing.assert_allclose(new.weights["sa1_1"][:, :4], old.weights["sa1_1"][:, :4], atol=1e-6)
    assert not np.allclose(fresh.algorithm.weights["sa1_1"], old.weights["sa1_1"], atol=1e-3)
    assert (new.mean, new.scale) == (old.mean, old.scale)
    assert [code for code, _ in model.classes] == [2, 6]  # 1 is left out unless it is named
    np.testing.assert_allclose(new.weights["scores"], old.weights["scores"][[0, 2]], atol=1e-6)
    assert model.info["training"]["network"]["start_from"] == "first.model"


@needs_torch
def test_transfer_from_something_else_is_refused(tmp_path):
    model_of(random_net(("Z", "Intensity"))).save(tmp_path / "other.model")
    with pytest.raises(ModelError, match="inputs Z, Intensity"):
        fit(start_from=str(tmp_path / "other.model"))
    with pytest.raises(ModelError, match="other inputs or another network"):
        fit(start_from=str(tmp_path / "other.model"), configuration="tiny")
    forest = Path(pdal_stages.__file__).parent / "models" / "standard.model"
    with pytest.raises(ModelError, match="network only"):
        fit(start_from=str(forest))
