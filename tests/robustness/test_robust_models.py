"""Model files that are missing, damaged, of another version, hostile, or made for other points."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import laspy
import numpy as np
import pytest
from robustness_kit import HAG, job, repack, scene
from test_robust_clouds import FEET, FOOT

import pdal_stages as ps
from pdal_stages.base.errors import ModelError

pytestmark = pytest.mark.pdal
KEEP = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
TRAPPED = Path("/tmp/should-not-exist-pdal-stages")


def rename(head, members):
    head["passes"][0]["feature_names"][0] = "Colour_s1"


class Evil:
    def __reduce__(self):
        return (open, (str(TRAPPED), "w"))


#: Edit of manifest and members of a good file, what the message must hold;
#: test_classifier_modelfile.py has more.
BROKEN = {
    "version 4": (lambda h, m: h.update(version=4), ["version", "Update pdal-stages"]),
    "997 neighborhoods": (lambda h, m: h["passes"][0].update(neighborhoods=[f"ropt(0.25,{k / 100},0.05)" for k in range(30, 1027)]),
                          ["at most 64 neighborhoods"]),
    "a feature that no neighborhood has": (rename, ["Colour_s1", "belongs to none"]),
    "a neighborhood that is none": (lambda h, m: h["passes"][0].update(neighborhoods=["q5"]), []),
    "densities of 400 digits": (lambda h, m: h["densities"].update(high=10**400), ["densities"]),
    "a pickle inside": (lambda h, m: m.update({h["arrays"]["1.threshold"]["file"]: pickle.dumps(Evil())}), []),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_broken_models(command, tmp_path, cloud, model, case):
    edit, says = BROKEN[case]
    target = tmp_path / "broken.model"
    repack(model, target, edit)
    message = command.refused(
        ["classify", cloud, tmp_path / "out.las", "--model", target], "broken.model", *says
    )
    path = job(tmp_path, cloud, {"type": "filters.modelclassifier", "model": str(target)})
    command.refused(["pipeline", path], "job.json, line 3: filters.modelclassifier")
    with pytest.raises(ModelError) as caught:
        ps.Filter.modelclassifier(model=str(target))
    assert str(caught.value) in message or "broken.model" in str(caught.value)
    assert not TRAPPED.exists()


def test_models_that_are_not_there(command, tmp_path, cloud):
    for name, says in {
        str(tmp_path / "nix.model"): ["nix.model", "no such model file", "Check the path"],
        "standrd": ["Did you mean 'standard'?"],
        str(tmp_path): ["not a file"],
        "": ["model"],
        "a\0b": ["model"],
    }.items():
        command.refused(["classify", cloud, tmp_path / "out.las", "--model", name], *says)


def test_a_model_that_changes_between_runs(command, tmp_path, cloud, model):
    copy = tmp_path / "m.model"
    copy.write_bytes(model.read_bytes())
    words = ["classify", cloud, tmp_path / "out.las", "--model", copy]
    command.runs(words)
    (tmp_path / "out.las").unlink()
    copy.write_bytes(model.read_bytes()[:-50])
    command.refused(words, "m.model")


# ---- made for other points -----------------------------------------------------------------------------------


def trained(target, source, *before, **more):
    write = {"type": "writers.classifiermodel", "filename": str(target), "neighborhoods": "c1,s2", "trees": 5, "folds": 0,
             "passes": 1, "feature_set": "covariance,geometric", "count": 100, **more}  # fmt: skip
    ps.run_pipeline(
        [
            {"type": "readers.las", "filename": str(source), "use_eb_vlr": True},
            *(before or (HAG,)),
            write,
        ]
    )
    return target


def right(path):
    return np.mean(np.asarray(laspy.read(path).classification) == scene()["Classification"])


def test_other_dimensions(command, tmp_path, write_las, cloud):
    data, out = scene(), tmp_path / "out.las"
    data["Amplitude"] = np.where(data["Classification"] == 6, 3.0, 1.0).astype("f4")
    source = write_las(tmp_path / "with.las", data, point_format=3)
    model = trained(tmp_path / "m.model", source, dimensions=["Amplitude"])
    command.refused(["classify", cloud, out, "--model", model], "'Amplitude' is missing")
    command.runs(["classify", source, out, "--model", model])
    assert right(out) > 0.95
    apply = {"type": "filters.modelclassifier", "model": str(trained(tmp_path / "h.model", cloud))}
    path = job(tmp_path, cloud, apply)
    command.refused(["pipeline", path], "'HeightAboveGround' is missing", "filters.hag_minima")


def test_units_of_training_points_stay_there(command, tmp_path, write_las, cloud):
    feet = {
        name: values / FOOT if name in "XYZ" else values for name, values in scene(seed=5).items()
    }
    source = write_las(tmp_path / "feet.las", feet, point_format=6, wkt=FEET, scale=1e-4)
    model = trained(tmp_path / "m.model", source)
    command.runs(["classify", cloud, tmp_path / "out.las", "--model", model])
    assert right(tmp_path / "out.las") > 0.9
    model = trained(
        tmp_path / "u.model", cloud, {**HAG, "vertical_unit": "foot"}, vertical_unit="foot"
    )
    assert ps.load_model(model).info["preparation"] == [HAG]


def test_the_label_as_a_dimension_and_more_samples_than_points(command, tmp_path, cloud):
    target = tmp_path / "m.model"
    words = [
        "train",
        cloud,
        "--model",
        target,
        "--neighborhoods",
        "c1",
        "--trees",
        3,
        "--count",
        99999999,
    ]
    command.refused(
        [*words, "--writers.classifiermodel.dimensions=Classification"],
        "the label itself",
        "Leave it out",
    )
    command.runs(words)  # the largest class bounds what is drawn
    large, small = sorted(ps.load_model(target).info["classes"], key=lambda c: -c["available"])
    assert large["duplicates"] == 0 and small["samples"] + small["duplicates"] == large["samples"]


# ---- names and figures that are not meant for people ----------------------------------------------------------


def test_names_that_command_a_terminal_or_pass_for_lines(command, tmp_path, cloud, model):
    """They are printed as codes."""
    red = "\x1b]0;title\x07\x1b[31mred\u202eder"

    def edit(head, _):
        head["classes"][0]["name"] = f"Ground\n  6 Roof{red}"
        head["training"]["clouds"][0]["name"] = "a\noverall accuracy 100 %\x1b[2J"

    evil = repack(model, tmp_path / "evil.model", edit)
    odd = tmp_path / "a\n2 Ground 1,000 points\x1b[2J\x07.las"
    odd.write_bytes(cloud.read_bytes())
    for done in (
        command.runs(["model", evil]),
        command.runs(["classify", odd, tmp_path / "o\x1b[0m.las", "--model", evil]),
        command("classify", odd, odd, "--model", model),
    ):
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", done.out + done.err)
        assert (
            "Roof\\x1b]0;title\\x07\\x1b[31mred\\u202eder" in done.out
            or "1,000 points\\x1b[2J\\x07.las" in done.err
        )


# ---- preparations: what a model asks for before it ------------------------------------------------------------

#: What would touch FILE; test_preparation.py has more.
HOSTILE = {
    "runs Python": {"type": "filters.python", "function": "f", "module": "m",
                    "source": "import pathlib\npathlib.Path('FILE').unlink()\ndef f(a, b): return True"},
    "empties a file by a log of PDAL's": {"type": "filters.smrf", "log": "FILE"},
    "is another name for a filter": {"type": "filters.hag_minima ", "log": "FILE"},
    "nests a pipeline": {**HAG, "inputs": [{"type": "writers.las", "filename": "FILE"}]},
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_preparation_that_does_more_than_heights(command, tmp_path, cloud, model, what):
    victim = tmp_path / "victim.txt"
    victim.write_text("--cell=1\n")
    stage = json.loads(json.dumps(HOSTILE[what]).replace("FILE", str(victim)))
    target = repack(
        model, tmp_path / "evil.model", lambda head, _: head.update(preparation=[HAG, stage])
    )
    apply = job(
        tmp_path, cloud, HAG, {"type": "filters.modelclassifier", "model": str(target)}, "out.las"
    )
    for words in (
        ["classify", cloud, tmp_path / "out.las", "--model", target],
        ["pipeline", apply],
        ["model", target],
    ):
        assert "Put before" not in command.refused(words, "evil.model")
    with pytest.raises(ModelError):
        ps.load_model(target)
    assert victim.read_text() == "--cell=1\n"


def test_training_on_heights_that_a_model_cannot_carry(command, tmp_path, cloud):
    """The model is written without its preparation, and everybody says what belongs before it."""
    target, out = tmp_path / "m.model", tmp_path / "out.las"
    write = {"type": "writers.classifiermodel", "filename": str(target), "neighborhoods": "c1", "trees": 3, "passes": 1, "label": "Reference",
             "feature_set": "covariance", "count": 50, "dimensions": "HeightAboveGround", "folds": 0}  # fmt: skip
    preparation = [{"type": "filters.pmf"}, {"type": "filters.hag_nn"}]
    done = command.runs(["pipeline", job(tmp_path, cloud, KEEP, *preparation, write)])
    assert "'filters.pmf'" in done.err and "Write a pipeline with the same stages" in done.err
    model = ps.load_model(target)
    assert model.info["preparation"] == [] and model.info["by_hand"] == [
        "filters.pmf",
        "filters.hag_nn",
    ]
    says = "filters.pmf, filters.hag_nn"
    command.refused(["classify", cloud, out, "--model", target], says, "Write a pipeline")
    apply = {"type": "filters.modelclassifier", "model": str(target)}
    command.refused(["pipeline", job(tmp_path, cloud, apply, "out.las")], says)
    command.runs(["pipeline", job(tmp_path, cloud, *preparation, apply, out)])


def test_heights_of_pdal_are_carried(command, tmp_path, cloud):
    """filters.smrf and filters.hag_nn with options go into the file and are run by classify."""
    smrf = {"type": "filters.smrf", "cell": "2", "ignore": "Classification[7:7]", "tag": "ground"}
    nearest = {"type": "filters.hag_nn", "count": 2}
    target = trained(
        tmp_path / "m.model",
        cloud,
        KEEP,
        smrf,
        nearest,
        label="Reference",
        dimensions="HeightAboveGround",
    )
    carried = [{"type": "filters.smrf", "cell": 2, "ignore": ["Classification[7:7]"]}, nearest]
    assert ps.load_model(target).info["preparation"] == carried
    command.runs(["classify", cloud, tmp_path / "out.las", "--model", target])
    assert np.unique(laspy.read(tmp_path / "out.las").classification).size == 2
