"""Training that generalizes: copies, surveys that weigh alike, surveys left out, noise, clouds one at a time, densities."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_classifier_training import SMALL, scene

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.base.errors import OptionError
from pdal_stages.base.messages import Topic
from pdal_stages.classifier.sampling import draw_samples, share_out
from pdal_stages.classifier.training_clouds import prepared
from pdal_stages.features.cell_means import density

FEW = {**SMALL, "feature_set": "covariance", "neighborhoods": "s1", "trees": 6}


def clouds(n=3, **more):
    scenes = [scene(seed, 3000, (2000.0 * seed, 0.0, 0.0)) for seed in range(n)]
    return [
        TrainingCloud(*each, name=f"{seed}.laz", survey=f"flight {seed}", **more)
        for seed, each in enumerate(scenes)
    ]


def learned(these, **more):
    return train(these, TrainingOptions(**{**FEW, **more}), progress=False)


def written(model, folder, name="m"):
    model.save(folder / name)
    return (folder / name).read_bytes()


# ---- density and copies --------------------------------------------------------------------------------


def test_density_is_robust_and_knows_no_order():
    random = np.random.default_rng(0)
    xyz = random.random((20_000, 3)) * (50, 40, 9)
    assert density(xyz) == pytest.approx(10.0, rel=0.05)
    strays = np.vstack([xyz, [[1e9, -1e9, 0.0]] * 5, random.normal(20, 0.01, (900, 3))])
    assert density(strays) == pytest.approx(10.0, rel=0.05)
    assert density(strays[random.permutation(len(strays))]) == density(strays)
    for thin in (0.2, 0.048, 0.03, 0.001):  # cells of 2 m hold a point each where they hold any
        xyz = np.column_stack(
            [random.uniform(0, 500, (2, round(thin * 500**2))).T, np.zeros(round(thin * 500**2))]
        )
        assert density(xyz) == pytest.approx(0.25 if thin == 0.2 else thin, rel=0.25)
        assert density(xyz - 250.0) == pytest.approx(0.25 if thin == 0.2 else thin, rel=0.25)
    assert density(np.zeros((0, 3))) == 0.0 and density(np.zeros((7, 3))) == 7 / 4


def copies(xyz, *wanted, seed=0):
    """The thinned copies of a cloud."""
    options = TrainingOptions(thin=wanted, seed=seed, dimensions=(), voxel=0)
    return list(prepared([TrainingCloud(xyz, np.zeros(len(xyz), int))], options))[1:]


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.5, 2.0, 7.0]))
def test_a_copy_has_its_density_in_any_order_and_tile(seed, wanted):
    random = np.random.default_rng(seed)
    xyz = random.random((30_000, 3)) * (50, 40, 9) + (6e5, 6e6, 0)
    (single,) = copies(xyz, wanted, 14.0, 1e5, seed=seed)  # none that would hardly be sparser
    assert len(single) / 2000 == pytest.approx(wanted, rel=0.15)
    (other,) = copies(xyz[random.permutation(len(xyz))], wanted, seed=seed)
    assert np.array_equal(np.unique(single.xyz, axis=0), np.unique(other.xyz, axis=0))
    assert not copies(xyz[:0], 1.0) and len(copies(xyz, wanted, seed=seed + 1)[0].xyz) > 0


def test_copies_are_trained_on_as_clouds_of_the_same_survey():
    single = clouds(1)
    model = learned(single, thin=[0.3, 0.1, 50.0], passes=2, context=["own"])
    names = [(c["name"], c["points"]) for c in model.info["training"]["clouds"]]
    copies = ("", " thinned to 0.3 per m2", " thinned to 0.1 per m2")
    assert [name for name, _ in names] == [f"0.laz{copy}" for copy in copies]
    assert names[0][1] > names[1][1] > names[2][1] > 0
    assert model.info["densities"]["low"] < 0.5 < model.info["densities"]["high"]
    assert "0.25 to " in str(model) and "points/m2" in str(model)


def test_a_cloud_of_another_density_is_told():
    model = learned(clouds(1))
    xyz, _, dimensions = scene(5, 3000)
    report = model.predict(xyz, dimensions).report
    assert not report.warnings and report.figures["density"] == pytest.approx(3000 / 3600, rel=0.3)
    subset = slice(None, None, 9)
    report = model.predict(xyz[subset], {k: v[subset] for k, v in dimensions.items()}).report
    (warning,) = report.warnings
    assert "points/m2, the model was trained on" in warning.text
    assert warning.topic is Topic.OTHER_DENSITY


# ---- surveys -------------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 500), min_size=1, max_size=6).filter(any), st.integers(1, 900))
def test_shares_are_exact_and_as_even_as_can_be(available, count):
    available = np.array(available)
    quota = share_out(available, count)
    assert quota.sum() == count and (quota[available == 0] == 0).all()
    if count < available.sum():
        assert (quota <= available).all()
        short = quota < available
        if short.any():
            assert np.ptp(quota[short]) <= 1
            assert (quota[~short] <= quota[short].min() + 1).all()
    else:
        there = available[available > 0]
        assert np.ptp(quota[available > 0] / there) <= 1 / there.min() + 1e-9


def test_surveys_weigh_alike():
    big, small = scene(0, 9000), scene(1, 900, (3000.0, 0.0, 0.0))
    pair = [TrainingCloud(*big, name="big"), TrainingCloud(*small, name="small")]
    position = [np.searchsorted((2, 5, 6), cloud.labels).astype(np.int16) for cloud in pair]
    inputs = [(cloud.xyz, where) for cloud, where in zip(pair, position, strict=True)]
    even = draw_samples(inputs, 3, 60, 0, ["a", "b"])
    assert np.array_equal(np.bincount(even.cloud, even.weight), [90, 90])
    assert np.array_equal(np.bincount(even.label, even.weight), [60, 60, 60])
    alike = draw_samples(inputs, 3, 60, 0)
    assert np.bincount(alike.cloud, alike.weight)[0] > 150
    single = draw_samples(inputs, 3, 60, 0, ["a", "a"])  # tiles of one survey are one
    for name in ("cloud", "row", "label", "weight"):
        assert np.array_equal(getattr(single, name), getattr(alike, name))


# ---- noise, one at a time ------------------------------------------------------------------------------


def test_noise_is_not_even_a_neighbor(tmp_path):
    xyz, label, dimensions = scene()
    random = np.random.default_rng(0)
    extra = np.column_stack([random.random((500, 2)) * 60, random.random(500) * 20])
    noisy = np.vstack([xyz, extra])
    labels = np.concatenate([label, np.full(500, 7)])
    more = {"HeightAboveGround": noisy[:, 2]}
    clean = learned([TrainingCloud(xyz, label, {"HeightAboveGround": xyz[:, 2]}, "a")])
    with_noise = learned([TrainingCloud(noisy, labels, more, "a")])
    assert written(clean, tmp_path, "a") == written(with_noise, tmp_path, "b")
    named = learned([TrainingCloud(noisy, labels, more, "a")], classes=[2, 5, 6, 7])
    assert [code for code, _ in named.classes] == [2, 5, 6, 7]

    gone = labels == 7
    whole = clean.predict(xyz, dimensions, probabilities=True, margin=True)
    current = np.full(len(noisy), 9)
    p = random.permutation(len(noisy))
    how = {"current": current, "ignore": gone[p], "probabilities": True, "margin": True}
    prediction = clean.predict(noisy[p], {"HeightAboveGround": noisy[p, 2]}, **how)
    at = np.argsort(p)[: len(xyz)]
    for name in ("classification", "reliability", "margin", "probabilities"):
        assert np.array_equal(getattr(prediction, name)[at], getattr(whole, name)), name
    assert (prediction.classification[gone[p]] == 9).all()
    assert not prediction.reliability[gone[p]].any()
    assert prediction.report.figures["ignored"] == 500
    with pytest.raises(OptionError, match="ignore"):
        clean.predict(xyz, dimensions, ignore=np.zeros(3, bool))


def test_clouds_made_one_at_a_time(tmp_path):
    at_hand = learned(clouds(3), passes=2, context=["own", "box1"], thin=[0.3])
    streamed = learned(iter(clouds(3)), passes=2, context=["own", "box1"], thin=[0.3])
    assert written(at_hand, tmp_path, "a") == written(streamed, tmp_path, "b")


@pytest.mark.pdal
@pytest.mark.parametrize(("thin", "said"), [(0.3, False), (0.048, True), (0.03, True)])
def test_a_cloud_thinner_than_any_that_was_learned_from_is_said(
    tmp_path, run, write_las, thin, said
):
    count = round(thin * 300**2)
    x, y = np.random.default_rng(0).uniform(0, 300, (2, count))
    arrays = {"X": x, "Y": y, "Z": 0.01 * x, "ReturnNumber": np.ones(count, np.uint8)}
    arrays["NumberOfReturns"] = arrays["ReturnNumber"]
    source = write_las(tmp_path / "thin.laz", arrays, point_format=6)
    code, _, err = run("classify", source, tmp_path / "o.laz", "--no-progress")
    assert code == 0 and ("points/m2, the model was trained on" in err) == said, err
