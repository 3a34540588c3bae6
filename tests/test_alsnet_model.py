"""Networks in model files and on clouds: averaging, order, tiles, files that lie. No PyTorch."""

import dataclasses

import numpy as np
import pytest
from alsnet_scenes import TINY, coverage, model_of, random_net, scene

from pdal_stages import load_model
from pdal_stages.alsnet.batches import Batches, build_pyramid
from pdal_stages.alsnet.classifier import AlsNet, make_pyramid, normalize_inputs
from pdal_stages.base.errors import ModelError, OptionError
from pdal_stages.classifier import model_file
from pdal_stages.classifier.interface import PredictRequest

INPUTS = ("Z", "HeightAboveGround", "Intensity")


def net_with(**changes):
    return dataclasses.replace(
        random_net(INPUTS), mean=(0.0, 1.0, 90.0), scale=(1.0, 2.0, 50.0), **changes
    )


# ---- the network ------------------------------------------------------------------------------------------


def test_a_level_equals_a_computation_by_hand():
    """One level, one layer each, one ball: every number checked with loops."""
    from pdal_stages.alsnet.configuration import Configuration, Level

    single = Configuration("one", 16, (Level(2, 5.0, 3, (4,), (3,)),), head=(2,), dropout=0.0)
    net = random_net(("Z",), 2, single)
    xyz = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 2.0, 0.5], [3.0, 3.0, 0.0]])
    values = xyz[:, 2:].astype(np.float32)
    pyramid = build_pyramid(xyz, values, single)
    (step,) = pyramid.steps

    def layer(name, row):
        array = net.weights[name].astype(float)
        scale, shift, mean, variance = array[:, -4:].T
        return np.maximum(
            (array[:, :-4] @ row - mean) / np.sqrt(variance + 1e-5) * scale + shift, 0.0
        )

    balls = []
    for ball in range(2):
        described = [
            layer("sa1_1", np.concatenate([step.offsets[ball, k], values[step.groups[ball, k]]]))
            for k in range(3)
        ]
        balls.append(np.max(described, axis=0))
    expected = []
    for i in range(4):
        carried = sum(step.weights[i, k] * balls[step.nearest[i, k]] for k in range(3))
        row = layer("head_1", layer("fp1_1", np.concatenate([carried, values[i]])))
        scores = net.weights["scores"][:, :-1] @ row + net.weights["scores"][:, -1]
        expected.append(np.exp(scores) / np.exp(scores).sum())
    np.testing.assert_allclose(net.network(pyramid), expected, rtol=1e-4)


# ---- clouds -----------------------------------------------------------------------------------------------


def test_averages_equal_a_hand_computation():
    xyz, _, dimensions = scene(1500, 20.0)
    net = net_with()
    request = PredictRequest(xyz, dimensions)
    ((_, mean, variance),) = net.predict(request)
    columns = normalize_inputs(xyz, dimensions, net.inputs, net.mean, net.scale)
    np.testing.assert_allclose(
        columns[:, 1], (dimensions["HeightAboveGround"] - 1.0) / 2.0, rtol=1e-5
    )
    batches = Batches(xyz, TINY.points, net.spacing, columns)
    each = [[] for _ in xyz]
    for number in range(len(batches)):
        members = batches.members(number)
        order, pyramid = make_pyramid(xyz, columns, members, batches.centers[number], INPUTS, TINY)
        for row, p in zip(members[order], net.network(pyramid), strict=True):
            each[row].append(p)
    assert [len(part) for part in each] == coverage(batches).tolist()
    for i, part in enumerate(each):
        np.testing.assert_allclose(mean[i], np.mean(part, axis=0), rtol=1e-9)
        np.testing.assert_allclose(variance[i], np.var(part, axis=0).mean(), rtol=1e-6, atol=1e-12)
    assert request.report.figures["batches"] == len(batches)
    assert request.report.figures["batches_per_point"]["least"] == coverage(batches).min()


def test_order_of_points_threads_and_rows_do_not_matter():
    xyz, _, dimensions = scene(2500, 20.0)
    model = model_of(net_with())
    whole = model.predict(xyz, dimensions, threads=1, probabilities=True, margin=True)
    shuffled = np.random.default_rng(5).permutation(len(xyz))
    other = model.predict(
        xyz[shuffled],
        {k: v[shuffled] for k, v in dimensions.items()},
        threads=2,
        probabilities=True,
    )
    assert np.array_equal(whole.probabilities[shuffled], other.probabilities)
    where = xyz[:, 0] < 7
    part = model.predict(xyz, dimensions, where, current=np.full(len(xyz), 9), probabilities=True)
    assert np.array_equal(part.probabilities[where], whole.probabilities[where])
    assert not part.probabilities[~where].any()
    assert (part.classification[~where] == 9).all()
    assert part.report.figures["batches"] < whole.report.figures["batches"]
    top = np.sort(whole.probabilities, axis=1)
    np.testing.assert_allclose(whole.margin, top[:, -1] - top[:, -2], atol=1e-6)


def test_a_tile_with_its_halo_gets_the_labels_of_the_whole():
    xyz, _, dimensions = scene(12_000, 60.0, origin=(620000.0, 6270000.0, 100.0))
    model = model_of(net_with())
    whole = model.predict(xyz, dimensions, probabilities=True)
    assert model.halo_m == pytest.approx((3.0 + 0.5**0.5) * 3.0)
    low = xyz.min(axis=0)[:2] + 20.0
    ours = ((xyz[:, :2] >= low) & (xyz[:, :2] < low + 12.0)).all(axis=1)
    near = ((xyz[:, :2] >= low - model.halo_m) & (xyz[:, :2] < low + 12.0 + model.halo_m)).all(
        axis=1
    )
    tile = model.predict(
        xyz[near], {k: v[near] for k, v in dimensions.items()}, ours[near], probabilities=True
    )
    assert np.array_equal(tile.probabilities[ours[near]], whole.probabilities[ours])


def test_the_reach_of_batches_is_part_of_the_model(tmp_path):
    xyz, _, values = scene(n=2000, side=20.0)
    near, far = (model_of(dataclasses.replace(random_net(), reach=reach)) for reach in (1.5, 4.0))
    assert far.halo_m == pytest.approx((8.0 + 0.5**0.5) * 3.0)
    far.save(tmp_path / "far.model")
    again = load_model(tmp_path / "far.model")
    assert again.halo_m == far.halo_m
    p = [
        next(model.algorithm.predict(PredictRequest(xyz, values))).probabilities
        for model in (near, far, again)
    ]
    assert not np.array_equal(p[0], p[1]) and np.array_equal(p[1], p[2])


def test_small_and_empty_clouds():
    model = model_of(random_net(("Z",)))
    assert len(model.predict(np.zeros((0, 3)), {}).classification) == 0
    single = model.predict(np.array([[5.0, 5.0, 5.0]]), {})
    assert single.report.figures["classified"] == 1
    same = model.predict(np.ones((700, 3)), {})  # more than a batch at one place
    assert same.report.figures["batches_per_point"]["least"] >= 1


def test_absurd_weights_give_an_error_not_nan():
    net = net_with()
    weights = {name: array * np.float32(1e30) for name, array in net.weights.items()}
    xyz, _, dimensions = scene(300, 8.0)
    with np.errstate(all="ignore"), pytest.raises(ModelError, match="not numbers"):
        next(dataclasses.replace(net, weights=weights).predict(PredictRequest(xyz, dimensions)))


# ---- files ------------------------------------------------------------------------------------------------


def test_saved_and_loaded_gives_the_same_labels(tmp_path):
    xyz, _, dimensions = scene(2000, 18.0)
    model = model_of(net_with())
    model.save(tmp_path / "a.model")
    again = load_model(tmp_path / "a.model")
    again.save(tmp_path / "b.model")
    assert (tmp_path / "a.model").read_bytes() == (tmp_path / "b.model").read_bytes()
    assert isinstance(again.algorithm, AlsNet) and again.halo_m == model.halo_m
    first, other = (m.predict(xyz, dimensions, probabilities=True) for m in (model, again))
    assert np.array_equal(first.probabilities, other.probabilities)
    assert (
        "alsnet" in str(again)
        and again.manifest()["passes"][0]["parameters"]["configuration"]["name"] == "test"
    )


def rewritten(path, weights=None, **parameters):
    """A model file with some weights or parameters changed, checksums right."""
    net = net_with()
    model = model_of(net)
    arrays = {**net.arrays(), **(weights or {})}
    arrays = {name: array for name, array in arrays.items() if array is not None}
    manifest = model.manifest()
    manifest["passes"][0]["parameters"] = {**net.to_file([])["parameters"], **parameters}
    model_file.write(path, manifest, [arrays])
    return path


def spoiled(name, value, at=(0, 0)):
    array = net_with().weights[name].copy()
    array[at] = value
    return {name: array}


@pytest.mark.parametrize(
    "weights, text",
    [
        (spoiled("sa1_1", np.nan), "finite"),
        ({"sa2_1": None}, "not those of its configuration"),
        ({"sa2_1": np.zeros((32, 9), np.float32)}, r"must be \(32, "),
        ({"scores": np.zeros(3, np.float32)}, "not a model"),
    ],
)
def test_hostile_weights_are_refused(weights, text, tmp_path):
    with pytest.raises(ModelError, match=text):
        load_model(rewritten(tmp_path / "bad.model", weights))


def test_a_network_is_no_second_pass(tmp_path):
    net = net_with()
    manifest = model_of(net).manifest()
    manifest["passes"] *= 2
    model_file.write(tmp_path / "two.model", manifest, [net.arrays()] * 2)
    with pytest.raises(ModelError, match="none follows a network"):
        load_model(tmp_path / "two.model")


def shallow(**changes):
    return {**TINY.to_dict(), **changes}


def greedy():
    level = {**TINY.to_dict()["levels"][0], "centers": 10**6, "samples": 1024}
    return shallow(points=10**6, levels=[level, TINY.to_dict()["levels"][1]])


@pytest.mark.parametrize(
    "parameters, text",
    [
        ({"configuration": 7}, "is not of type .object."),
        ({"configuration": shallow(points=10**9)}, "points"),
        (
            {"configuration": shallow(levels=TINY.to_dict()["levels"][:1])},
            "not those of its configuration|must be",
        ),
        ({"configuration": greedy()}, "too much memory"),
        ({"inputs": [{"name": n, "mean": 0, "scale": 0} for n in INPUTS]}, "scale"),
        ({"more": 1}, "more"),
    ],
)
def test_hostile_parameters_are_refused(parameters, text, tmp_path):
    with pytest.raises(ModelError, match=text):
        load_model(rewritten(tmp_path / "bad.model", **parameters))


def test_where_no_torch_is_training_says_what_to_install(monkeypatch):
    import sys

    from pdal_stages import TrainingCloud, TrainingOptions, train
    from pdal_stages.base.errors import DependencyError

    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "pdal_stages.alsnet.torch_network", raising=False)
    xyz, labels, dimensions = scene(300, 8.0)
    monkeypatch.setattr(sys, "prefix", "/usr")  # not the environment that scripts/setup made
    with pytest.raises(
        DependencyError, match=r"Install it with: pip install 'pdal-stages\[deep\]'"
    ):
        train(
            [TrainingCloud(xyz, labels, dimensions)],
            TrainingOptions(algorithm="alsnet"),
            progress=False,
        )
    model_of(net_with()).predict(xyz, dimensions)  # applying needs none


@pytest.mark.parametrize(
    "values, text",
    [
        ({"algorithm": "alsnett"}, "must be one of"),
        ({"alsnet": {"epochs": 3}}, "for the algorithm"),
        ({"algorithm": "alsnet", "alsnet": {"epoch": 3}}, "Did you mean 'epochs'"),
        ({"algorithm": "alsnet", "alsnet": {"configuration": "tinny"}}, "tiny"),
        ({"algorithm": "alsnet", "alsnet": [1]}, "mapping"),
        ({"algorithm": "alsnet", "alsnet": {"augment": 1}}, "augment"),
    ],
)
def test_options_are_checked(values, text):
    from pdal_stages import TrainingOptions

    with pytest.raises(OptionError, match=text):
        TrainingOptions(**values)
