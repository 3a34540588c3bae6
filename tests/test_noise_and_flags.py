"""Noise, withheld and overlap points, and the flags of old LAS files: through the command line."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pytest
from block_scene import QUICK_TRAINING, ground_and_block

import pdal_stages as ps
from pdal_stages.base.errors import OptionError
from pdal_stages.cli import main
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.stages.hag_minima import HagMinima
from pdal_stages.stages.options import Selection

pytestmark = pytest.mark.pdal
FLAGS = ("Synthetic", "KeyPoint", "Withheld")
NEWER = {"minor_version": 4, "dataformat_id": 6}


def flagged(seed=1):
    arrays = ground_and_block(900, seed)
    rng = np.random.default_rng(seed)
    return {
        **arrays,
        **{name: (rng.random(len(arrays["X"])) < 0.2).astype(np.uint8) for name in FLAGS},
    }


@pytest.fixture(scope="module")
def model(tmp_path_factory, write_las):
    folder = tmp_path_factory.mktemp("model")
    source = write_las(folder / "train.las", ground_and_block(900), point_format=1)
    path = folder / "small.model"
    words = ["train", str(source), "--model", str(path), *QUICK_TRAINING]
    assert main([*words, "--writers.classifiermodel.dimensions=HeightAboveGround"]) == 0
    return path


def all_flags(las):
    return np.array([np.asarray(las[name]) for name in ("synthetic", "key_point", "withheld")])


# ---- flags of LAS 1.0-1.3 in LAS 1.4 -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("tiles", [False, True])
def test_flags_of_old_files_stay_flags_in_new_ones(
    tmp_path, run, run_job, write_las, model, suffix, tiles
):
    source = write_las(tmp_path / "in.las", flagged(), point_format=1)
    out = tmp_path / f"out.{suffix}"
    if tiles:  # by PDAL itself, which refuses what it would mix up
        classifier = {"type": "filters.modelclassifier", "model": str(model), "ignore": ""}
        writer = {"type": "writers.las", "filename": str(out), "forward": "all", **NEWER}
        stages = [source, {"type": "filters.hag_minima"}, classifier, writer]
        code, _, err = run_job(stages, "--tile", 20, "--workers", 0)
    else:
        words = ["--model", model, "--filters.modelclassifier.ignore="]
        words += [f"--writers.las.{k}={v}" for k, v in NEWER.items()]
        code, _, err = run("classify", source, out, *words)
    if not pdal_env.splits_class_flags():
        assert code == 1 and "as parts of the class" in err and "laspy.convert" in err
        assert not out.exists()
        return
    assert code == 0, err
    before, after = laspy.read(source), laspy.read(out)
    assert after.header.point_format.id == 6 and set(np.unique(after.classification)) == {2, 6}
    assert np.array_equal(all_flags(before), all_flags(after))


@pytest.mark.parametrize("wiring", ["plain", "pattern"])
def test_old_and_new_files_together(tmp_path, run_job, write_las, wiring):
    """Old PDAL reads the flags of one as bits of the class, of the other apart."""
    old = write_las(tmp_path / "a_old.las", flagged(), point_format=1)
    new = write_las(tmp_path / "b_new.las", flagged(2), point_format=6)
    out = {"type": "writers.las", "filename": str(tmp_path / "o.las"), **NEWER}
    heights = {"type": "filters.hag_minima", "ignore": "withheld"}
    readers = [new, old] if wiring == "plain" else [tmp_path / "*_*.las"]
    code, _, err = run_job([*readers, heights, out])
    if not pdal_env.splits_class_flags():
        assert code == 1 and "a_old.las" in err and "those of LAS 1.4" in err
        assert not (tmp_path / "o.las").exists()
        return
    assert code == 0, err
    written, parts = laspy.read(tmp_path / "o.las"), [laspy.read(new), laspy.read(old)]
    if written.x[0] != parts[0].x[0]:  # PDAL may take a pattern's files as the folder lists them
        parts.reverse()
    for name in ("x", "y", "classification"):
        assert np.array_equal(
            written[name], np.concatenate([np.asarray(part[name]) for part in parts])
        ), name
    assert np.array_equal(all_flags(written), np.hstack([all_flags(part) for part in parts]))
    assert not list(written.point_format.extra_dimension_names)


def test_where_sees_classes_without_flags(write_las, tmp_path, model):
    """Of LAS 1.2 as of LAS 1.4."""
    classes = []
    for point_format in (1, 6):
        source = write_las(tmp_path / f"{point_format}.las", flagged(), point_format=point_format)
        stage = {"type": "filters.modelclassifier", "model": str(model), "ignore": ""}
        stage["where"] = "Classification == 6"
        run_ = ps.run_pipeline([str(source), {"type": "filters.hag_minima"}, stage])
        classes.append(run_.reports[-1][1][-1].figures["where"])
    assert classes[0] == classes[1] == np.count_nonzero(flagged()["Classification"] == 6)


def test_writers_of_both_are_refused_before_work(tmp_path, run_job, write_las, model):
    if pdal_env.splits_class_flags():
        pytest.skip("PDAL 2.6 and newer read flags as dimensions of their own")
    old = write_las(tmp_path / "old.las", flagged(), point_format=1)
    new = {"type": "writers.las", "filename": str(tmp_path / "o4.las"), **NEWER}
    older = {**new, "filename": str(tmp_path / "o2.las"), "minor_version": 2, "dataformat_id": 1}
    code, _, err = run_job([old, older, new])
    assert code == 1 and "flags" in err and "laspy.convert" in err
    assert run_job([old, {**older, "forward": "all"}])[0] == 0
    assert np.array_equal(all_flags(laspy.read(old)), all_flags(laspy.read(tmp_path / "o2.las")))


def test_kept_codes_that_do_not_fit_are_refused(tmp_path, run, write_las, model):
    arrays = ground_and_block(900)
    arrays["Classification"][:7] = 65
    source = write_las(tmp_path / "in.las", arrays, point_format=6)
    words = ["--model", model, "--where", "Classification < 60"]
    old = ["--writers.las.minor_version=2", "--writers.las.dataformat_id=1"]
    code, _, err = run("classify", source, tmp_path / "o.las", *words, *old)
    assert code == 1 and "code 65" in err and "minor_version" in err
    assert run("classify", source, tmp_path / "o.las", *words)[0] == 0
    assert np.count_nonzero(np.asarray(laspy.read(tmp_path / "o.las").classification) == 65) == 7


# ---- noise, withheld, overlap ------------------------------------------------------------------------------


@pytest.mark.parametrize("point_format", [1, 6])
def test_noise_and_withheld_points_are_not_there(tmp_path, run, write_las, model, point_format):
    """The others are classified as in a file without them; these keep their class."""
    clean = ground_and_block(900)
    n = len(clean["X"])
    rng = np.random.default_rng(3)
    bad = {name: np.concatenate([v, v[:120]]) for name, v in clean.items()}
    bad["Z"][n:] += rng.uniform(-8, 8, 120)
    bad["Classification"][n:] = np.tile([7, 18, 5], 40)
    bad["Withheld"] = (bad["Classification"] == 5).astype(np.uint8)
    out = {}
    for name, arrays in (("clean", clean), ("bad", bad)):
        source = write_las(tmp_path / f"{name}.las", arrays, point_format=point_format)
        code, output, err = run("classify", source, tmp_path / "o.las", "--model", model)
        assert code == 0, err
        out[name] = laspy.read(tmp_path / "o.las")
    assert "noise and withheld points, not classified (ignore)" in output and "120" in output
    for name in ("classification", "Reliability", "HeightAboveGround"):
        assert np.array_equal(np.asarray(out["bad"][name])[:n], np.asarray(out["clean"][name])), (
            name
        )
    assert np.array_equal(np.asarray(out["bad"].classification)[n:], bad["Classification"][n:])
    assert np.abs(out["bad"].HeightAboveGround[n:]).max() > 1  # they still have heights


def test_overlap_is_a_neighbor_and_keeps_its_class(tmp_path, run, write_las, model):
    arrays = ground_and_block(900)
    truth = arrays["Classification"].copy()
    arrays["Classification"][::3] = 12
    source = write_las(tmp_path / "in.las", arrays, point_format=1)
    reliability = {}
    for words in ((), ("--filters.modelclassifier.keep=",)):
        code, output, err = run("classify", source, tmp_path / "o.las", "--model", model, *words)
        assert code == 0, err
        out = laspy.read(tmp_path / "o.las")
        assert np.array_equal(
            np.asarray(out.classification) == 12, (arrays["Classification"] == 12) & (not words)
        )
        assert ("class kept (keep)" in output) == (not words)
        reliability[words] = np.asarray(out.Reliability)
    others = arrays["Classification"] != 12
    assert np.array_equal(*(values[others] for values in reliability.values()))
    assert (np.asarray(out.classification) == truth).mean() > 0.9


@pytest.mark.parametrize("point_format", [1, 6])
def test_features_and_training_without_unwanted_points(tmp_path, write_las, point_format):
    clean = ground_and_block(300)
    bad = {name: np.concatenate([v, v[:60]]) for name, v in clean.items()}
    bad["Z"][300:] += 1.0
    bad["Classification"][300:330] = 7
    bad["Withheld"] = np.repeat([0, 1], [330, 30]).astype(np.uint8)
    features, models = [], []
    for name, arrays in (("clean", clean), ("bad", bad)):
        source = write_las(tmp_path / f"{name}.las", arrays, point_format=point_format)
        planarity = {"neighborhoods": "k5", "feature_set": "covariance"}
        job = ps.run_pipeline([str(source), {"type": "filters.multiscalefeatures", **planarity}])
        features.append(job.arrays[0]["Planarity_k5"])
        writer = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m.model")}
        few = {"neighborhoods": "k5", "passes": 1, "trees": 2, "count": 50, "threads": 1}
        ps.run_pipeline([str(source), {"type": "filters.hag_minima"}, {**writer, **few}])
        models.append(ps.load_model(tmp_path / "m.model").passes[0].arrays())
    assert np.array_equal(features[0], features[1][:300]) and not features[1][300:].any()
    assert all(np.array_equal(models[0][key], models[1][key]) for key in models[0])


def test_withheld_points_are_not_scored(tmp_path, run, write_las):
    arrays = ground_and_block(900)
    arrays["Withheld"] = (np.arange(900) < 100).astype(np.uint8)
    reference = write_las(tmp_path / "reference.las", arrays, point_format=1)
    arrays["Classification"][:100] = 9
    judged = write_las(tmp_path / "judged.las", arrays, point_format=1)
    for words, compared, right in (((), 800, 1.0), (("--filters.accuracy.ignore=",), 900, 8 / 9)):
        out = tmp_path / "a.json"
        code, _, err = run("accuracy", judged, "--reference", reference, "--json", out, *words)
        assert code == 0, err
        figures = json.loads(out.read_text())
        assert figures["points"] == compared and figures["overall_accuracy"] == pytest.approx(right)


@pytest.mark.parametrize("type_name", ["filters.hag_minima", "filters.hag_morphological"])
def test_points_outside_where_have_heights(tmp_path, write_las, type_name):
    """They do not form the ground, but 0 would be a height too."""
    arrays = ground_and_block(900)
    arrays["Classification"][::5] = 7
    arrays["Z"][::5] -= 20
    source = str(write_las(tmp_path / "in.las", arrays, point_format=1))
    where = {"type": type_name, "where": "Classification != 7", "ignore": ""}
    heights = ps.run_pipeline([source, where]).arrays[0]["HeightAboveGround"]
    assert (heights[::5] < -10).all()
    # What another stage gave them stays.
    before = {"type": "filters.hag_minima", "ignore": ""}
    first = ps.run_pipeline([source, before]).arrays[0]["HeightAboveGround"]
    both = ps.run_pipeline([source, before, where]).arrays[0]["HeightAboveGround"]
    assert np.array_equal(both[::5], first[::5]) and not np.array_equal(both, first)


@pytest.mark.parametrize(
    ("text", "codes", "dimensions"),
    [
        ("7,18,withheld", (7, 18), ["Withheld"]),
        ("Classification[65:67], Overlap[1:1]", (65, 66, 67), ["Overlap"]),
        ("ReturnNumber![1:1]", (), ["ReturnNumber"]),
    ],
)
def test_ranges_of_dimensions(text, codes, dimensions):
    chosen = HagMinima({"ignore": text}).ignore
    assert isinstance(chosen, Selection) and chosen.codes == codes
    assert [span.dimension for span in chosen.spans] == dimensions
    with pytest.raises(OptionError, match="class codes"):
        HagMinima({"ignore": text + ",noise"})
