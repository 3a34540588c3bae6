"""A few labels on top of a trained model: nothing is forgotten, and a file holds all of it."""

import json
import shutil
import zipfile

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_classifier_modelfile import changed
from test_classifier_passes import FEW
from test_classifier_training import scene

import pdal_stages as ps
from pdal_stages import TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.base.errors import ModelError, OptionError, StageError
from pdal_stages.classifier import model_file
from pdal_stages.classifier.feature_forest import Blend
from pdal_stages.classifier.training_clouds import label_classes

BEFORE = (2, 5, 6)


def shares(classes):
    """(4, classes) rows that sum to 1, among them rows sure of one class."""
    whole = arrays(np.float64, (4, classes), elements=st.floats(0.0, 1.0))
    return whole.filter(lambda a: (a.sum(axis=1) > 1e-6).all()).map(
        lambda a: a / a.sum(axis=1, keepdims=True)
    )


def by_hand(said, grown, before, labeled, trusted):
    """The rule, point by point and class by class."""
    codes = sorted({*before, *labeled})
    out = []
    for b, f in zip(said, grown, strict=True):
        b, f = dict(zip(before, b, strict=True)), dict(zip(labeled, f, strict=True))
        kept = sum(b[c] for c in before if c not in labeled)
        shared = sum(b.get(c, 0.0) for c in labeled)
        row = []
        for c in codes:
            if c not in labeled:
                row.append(b[c])
            else:
                known = b.get(c, 0.0) / shared if shared > 0 else f[c]
                row.append((1.0 - kept) * (trusted * f[c] + (1.0 - trusted) * known))
        out.append(row)
    return np.array(out)


@given(shares(3), shares(2), st.sampled_from([(2, 6), (2, 17), (17, 64)]), st.floats(0.0, 1.0))
def test_blended_equals_the_rule(said, grown, labeled, trusted):
    got = Blend(BEFORE, labeled, trusted)(said, grown)
    assert np.allclose(got.sum(axis=1), 1.0, atol=1e-9) and (got >= 0).all()
    assert np.allclose(got, by_hand(said, grown, BEFORE, labeled, trusted), atol=1e-9)
    codes = sorted({*BEFORE, *labeled})
    for code in set(BEFORE) - set(labeled):
        assert np.array_equal(got[:, codes.index(code)], said[:, BEFORE.index(code)])


@pytest.fixture(scope="module")
def base():
    xyz, label, dimensions = scene()
    options = TrainingOptions(**{**FEW, "voxel": 0.25}, passes=2, prior_weight=0.5)
    return train([TrainingCloud(xyz, label, dimensions, "a.laz")], options, progress=False)


def on_top(base, keep=None, n=40, **more):
    """Trained on a few points of another scene, of the classes `keep`."""
    xyz, label, dimensions = scene(seed=3)
    rng = np.random.default_rng(0)
    mask = np.zeros(len(xyz), bool)
    for code in keep or np.unique(label):
        mask[rng.choice(np.flatnonzero(label == code), n, replace=False)] = True
    options = TrainingOptions(**{**FEW, **more}, base=base, folds=0)
    return train([TrainingCloud(xyz, label, dimensions, "b.laz", mask)], options, progress=False)


def test_a_file_holds_the_base(base, tmp_path):
    model = on_top(base)
    assert [entry.name for entry in model.passes] == ["random_forest"] * 2 + ["refined_forest"]
    assert model.voxel == base.voxel and model.halo_m > base.halo_m
    model.save(tmp_path / "m.model")
    again = load_model(tmp_path / "m.model")
    xyz, _, dimensions = scene(seed=7, n=4000)
    entry, two = (m.predict(xyz, dimensions, probabilities=True) for m in (model, again))
    assert np.array_equal(entry.probabilities, two.probabilities)
    again.save(tmp_path / "n.model")
    assert (tmp_path / "n.model").read_bytes() == (tmp_path / "m.model").read_bytes()
    assert "refined forest" in str(again)
    held = [set(entry.get("percentiles", ())) for entry in again.manifest()["passes"]]
    assert held[0] == held[2] and not held[1]  # of each training its first pass


def leaves(value, at=()):
    """Yield the path of everything in a manifest; of a list, its first entry."""
    yield at
    inside = enumerate(value[:1]) if isinstance(value, list) else ()
    for key, single in value.items() if isinstance(value, dict) else inside:
        if key != "arrays":
            yield from leaves(single, (*at, key))


def test_odd_numbers_anywhere_in_a_manifest(base, tmp_path):
    """A file with any value replaced is refused with a message, or gives probabilities that sum to 1."""
    on_top(base).save(tmp_path / "m.model")
    xyz, _, dimensions = scene(seed=7, n=60)
    with zipfile.ZipFile(tmp_path / "m.model") as archive:
        head = json.loads(archive.read("manifest.json"))
    refused = 0
    passes = [("passes", 2, *at) for at in leaves(head["passes"][2])]
    for at in [*list(leaves(head))[1:], *passes]:
        for odd in (10**400, 10**300, 5e-324, -1, True, 1.0, 2.5, [], {}, None):

            def edit(inner, _, at=at, odd=odd):
                for key in at[:-1]:
                    inner = inner[key]
                inner[at[-1]] = odd

            shutil.copy(tmp_path / "m.model", tmp_path / "odd.model")
            changed(tmp_path / "odd.model", edit)
            try:
                model = load_model(tmp_path / "odd.model")
                str(model)
                if at[0] in ("passes", "priors"):
                    prediction = model.predict(xyz, dimensions, probabilities=True).probabilities
                    assert np.allclose(prediction.sum(axis=1), 1.0, atol=1e-6), (at, odd)
            except StageError as error:
                refused += 1
                assert "odd.model" in str(error), (at, odd)
    assert refused > 500


def test_a_class_without_labels_is_kept(base):
    codes = base.codes.tolist()
    gone, *rest = codes[::-1]
    model = on_top(base, keep=rest)
    assert model.codes.tolist() == codes
    xyz, _, dimensions = scene(seed=7, n=4000)
    before = base.predict(xyz, dimensions, probabilities=True).probabilities[:, codes.index(gone)]
    after = model.predict(xyz, dimensions, probabilities=True).probabilities[:, codes.index(gone)]
    assert np.abs(after - before).max() < 1e-3  # of what the base hands on in 65535ths


@pytest.mark.parametrize("new", [17, 1])
def test_a_new_class_is_learnt(base, new):
    xyz, label, dimensions = scene(seed=3)
    tall = (label == 6) & ((xyz[:, 0] // 10 + xyz[:, 1] // 10) % 2 == 0)
    xyz[tall, 2] += 6
    dimensions["HeightAboveGround"] = xyz[:, 2].copy()
    label[tall] = new
    cloud = TrainingCloud(xyz, label, dimensions, "b.laz")
    options = TrainingOptions(**FEW, base=base, folds=0, classes=[*BEFORE, new])
    model = train([cloud], options, progress=False)
    if new == 1:  # and is one for who trains on top of it, even if its label often tells nothing
        assert new in label_classes([cloud], TrainingOptions(**FEW, base=model)).classes.codes
    new, old = (m.predict(xyz, dimensions).classification for m in (model, base))
    assert (new == label).mean() > (old == label).mean() + 0.05


def test_every_label_counts(base):
    """Whichever point stands for a voxel."""
    xyz, label, dimensions = scene(seed=3, n=40_000)  # many points a voxel
    rng = np.random.default_rng(0)
    few = np.zeros(len(xyz), int)
    for code in (2, 6):
        few[rng.choice(np.flatnonzero(label == code), 30, replace=False)] = code
    options = TrainingOptions(**FEW, base=base, folds=0)
    voxels = len(np.unique(np.floor(xyz[few > 0] / base.voxel), axis=0))
    for cloud in (
        TrainingCloud(xyz, few, dimensions),
        TrainingCloud(xyz, label, dimensions, mask=few > 0),
    ):
        model = train([cloud], options, progress=False)
        reported = sum(entry["available"] for entry in model.info["classes"])
        assert reported == voxels


def test_what_cannot_be_built_on(base):
    with pytest.raises(OptionError, match="a base must be a model"):
        TrainingOptions(base="standard")
    with pytest.raises(OptionError, match="'own'"):
        TrainingOptions(base=base, context=["box1"])
    for more in ({"algorithm": "alsnet"}, {"passes": 2}, {"target": 6}):
        with pytest.raises(OptionError, match="there is one forest"):
            TrainingOptions(base=base, **more)
    once = on_top(base)
    twice = on_top(once)
    assert len(twice.passes) == 4
    with pytest.raises(OptionError, match="up to 3 forests"):
        TrainingOptions(base=twice)


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p[-1]["parameters"].update(before=[2, 5]),
        lambda p: p[-1]["parameters"].update(labeled=[6, 5]),
        lambda p: p[-1].update(context=["box1"]),
        lambda p: p[0].update(codes=[2, 5]),
        lambda p: p[1].update(factors=[1.0]),
    ],
)
def test_a_manifest_that_contradicts_itself(base, tmp_path, change):
    model = on_top(base)
    manifest = json.loads(json.dumps(model.manifest()))
    change(manifest["passes"])
    with pytest.raises(ModelError):
        model_file.write(tmp_path / "m", manifest, [entry.arrays() for entry in model.passes])
        load_model(tmp_path / "m")


@pytest.mark.pdal
def test_through_pdal(tmp_path, write_las):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 60, (2, 6_000))
    block = (x > 20) & (x < 40) & (y > 20) & (y < 40)
    z = np.where(block, 8.0, 0.0) + rng.normal(0, 0.02, len(x))
    label = np.where(block, 6, np.where(y < 10, 11, 2)).astype(np.uint8)
    cloud = {"X": x + 5e5, "Y": y + 5e6, "Z": z + 100, "Classification": label}
    source = write_las(tmp_path / "in.las", cloud, point_format=3)
    model = tmp_path / "mine.model"
    writer = {"type": "writers.classifiermodel", "filename": str(model), "base": "standard"}
    writer |= {"trees": 5, "classes": "2,6,11", "count": 200}
    heights = ps.load_model("standard").info["preparation"]
    ps.run_pipeline([str(source), *heights, writer])
    loaded = ps.load_model(model)
    assert loaded.codes.tolist() == [2, 5, 6, 11, 14, 15]
    sha256 = loaded.info["base"]["sha256"]
    assert f"on top of       standard, the passes before (SHA-256 {sha256})" in str(loaded)
    assert loaded.info["preparation"] == heights
    classify = {"type": "filters.modelclassifier", "model": str(model)}
    ps.run_pipeline([str(source), *heights, classify, str(tmp_path / "out.las")])
    predicted = np.asarray(laspy.read(tmp_path / "out.las").classification)
    assert 11 in predicted and ((predicted == 6) == (label == 6)).mean() > 0.9
