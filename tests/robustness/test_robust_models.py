"""Model files that are missing, damaged, of another version, hostile, or made for other points."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import re
import zipfile

import laspy
import numpy as np
import pytest
from conftest import scene
from robustness_kit import job

import pdal_stages as ps
from pdal_stages.base.errors import ModelError

pytestmark = pytest.mark.pdal


def repack(path, target, edit, compression=zipfile.ZIP_DEFLATED):
    """A copy with manifest or members edited, checksums put right."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    head = json.loads(members.pop("manifest.json"))
    edit(head, members)
    for entry in head.get("arrays", {}).values() if isinstance(head.get("arrays"), dict) else ():
        if entry.get("file") in members:
            entry["sha256"] = hashlib.sha256(members[entry["file"]]).hexdigest()
    with zipfile.ZipFile(target, "w", compression) as archive:
        archive.writestr("manifest.json", json.dumps(head))
        for name, data in members.items():
            archive.writestr(name, data)
    return target


def swap_names(head, members):
    names = head["passes"][0]["feature_names"]
    names[0], names[1] = names[1], names[0]


def wild_threshold(head, members):
    name = head["arrays"]["1.threshold"]["file"]  # the first node of the first tree
    start = 10 + int.from_bytes(members[name][8:10], "little")
    members[name] = members[name][:start] + np.float32("nan").tobytes() + members[name][start + 4 :]


def wild_feature(head, members):
    name = head["arrays"]["1.feature"]["file"]
    whole = members[name]
    start = 10 + int.from_bytes(whole[8:10], "little")
    size = np.dtype(head["arrays"]["1.feature"]["dtype"]).itemsize
    members[name] = whole[:start] + (20_000).to_bytes(size, "little") + whole[start + size :]


def bomb(head, members):
    from pdal_stages.classifier.modelfile import to_bytes

    members[head["arrays"]["1.threshold"]["file"]] = to_bytes(np.zeros(30_000_000, np.float32))
    head["arrays"]["1.threshold"]["shape"] = [30_000_000]


def with_text(pattern, replacement):
    """Replace a text in the manifest, where JSON allows what Python would not write."""

    def edit(data):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        found = re.subn(pattern, replacement, members["manifest.json"])
        assert found[1]
        members["manifest.json"] = found[0]
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        return out.getvalue()

    return edit


class Evil:
    def __reduce__(self):
        return (open, ("/tmp/should-not-exist-pdal-stages", "w"))


#: case, edit of a good file (bytes -> bytes, or of manifest and members), what the message must hold
BROKEN = [
    ("model of version 3", lambda h, m: h.update(version=3), ["version", "Update pdal-stages"]),
    ("model of an algorithm that is not known", lambda h, m: h["passes"][0].update(algorithm="xgboost"), ["algorithm", "xgboost"]),
    ("model of version 2.0", lambda h, m: h.update(version=2.0), ["version 2.0"]),
    ("model with a number of 1e999", with_text(rb'"max_samples": [\d.]+', b'"max_samples": 1e999'), ["1e999 is too large"]),
    ("model with NaN in its manifest", with_text(rb'"max_samples": [\d.]+', b'"max_samples": NaN'), ["NaN is not a number"]),
    ("model with a key twice", with_text(rb'"max_samples"', b'"max_samples": 1, "max_samples"'), ["duplicate key"]),
    ("model with 997 neighborhoods", lambda h, m: h["passes"][0]["features"].update(neighborhoods=[f"ropt(0.25,{k / 100},0.05)" for k in range(30, 1027)]),
     ["at most 64 neighborhoods"]),
    ("model with features in another order", swap_names, ["features"]),
    ("model with a feature this release lacks", lambda h, m: h["passes"][0]["feature_names"].__setitem__(0, "Magic_c1"), ["features"]),
    ("model with a neighborhood that is none", lambda h, m: h["passes"][0]["features"].update(neighborhoods=["q5"]), [""]),
    ("model of densities of 400 digits", lambda h, m: h["densities"].update(high=10**400), ["densities"]),
    ("model without its classes", lambda h, m: h.pop("classes"), ["classes"]),
    ("model with class code 300", lambda h, m: h["classes"][0].update(code=300), ["classes"]),
    ("model with an array missing", lambda h, m: m.pop(h["arrays"]["1.threshold"]["file"]), ["differ"]),
    ("model with a member too many", lambda h, m: m.update({"../../evil.py": b"x"}), ["differ"]),
    ("model whose threshold is NaN", wild_threshold, [""]),
    ("model whose trees ask for feature 20,000", wild_feature, [""]),
    ("model that unpacks to far more (zip bomb)", bomb, ["far more"]),
    ("model cut in half", lambda d: d[: len(d) // 2], ["cut short"]),
    ("model without its last byte", lambda d: d[:-1], ["not a model file"]),
    ("model with one byte changed", lambda d: d[:2000] + bytes([d[2000] ^ 255]) + d[2001:], [""]),
    ("empty model file", lambda d: b"", ["not a model file"]),
    ("LAS file as the model", lambda d: b"LASF" + bytes(5000), ["not a model file"]),
    ("pickle as the model", lambda d: pickle.dumps(Evil()), ["not a model file"]),
    ("pickle inside the model", lambda h, m: m.update({h["arrays"]["1.threshold"]["file"]: pickle.dumps(Evil())}), [""]),
]  # fmt: skip


@pytest.mark.parametrize(("case", "edit", "says"), BROKEN, ids=[row[0] for row in BROKEN])
def test_broken_models(cell, tmp_path, cloud, model, case, edit, says):
    target = tmp_path / "broken.model"
    if edit.__code__.co_argcount == 1:
        target.write_bytes(edit(model.read_bytes()))
    else:
        repack(model, target, edit)
    message = cell("Models", case).refused(
        ["classify", cloud, tmp_path / "out.las", "--model", target], "broken.model", *says
    )
    path = job(tmp_path, str(cloud), {"type": "filters.modelclassifier", "model": str(target)})
    again = cell("Models", case).command("pipeline", path)
    assert (
        again.code == 1
        and "job.json, line 3: filters.modelclassifier" in again.err
        and "Traceback" not in again.err
    )
    assert cell("Models", case).command("model", target).code == 1
    with pytest.raises(ModelError) as caught:
        ps.Filter.modelclassifier(model=str(target))
    assert str(caught.value) in message or "broken.model" in str(caught.value)
    import os

    assert not os.path.exists("/tmp/should-not-exist-pdal-stages")


def test_models_that_are_not_there(cell, tmp_path, cloud):
    words = ["classify", cloud, tmp_path / "out.las", "--model"]
    cell("Models", "model that is not there").refused(
        [*words, tmp_path / "nix.model"], "nix.model", "no such model file", "Check the path"
    )
    cell("Models", "mistyped name of a shipped model").refused(
        [*words, "standrd"], "standrd", "Did you mean 'standard'?"
    )
    cell("Models", "folder as the model").refused([*words, tmp_path], "not a file")
    cell("Models", "model name that is empty").refused([*words, ""], "model")
    cell("Models", "NUL in the model's name").refused([*words, "a\0b"], "model")


def trained(tmp_path, source, name="m.model", **more):
    ps.run_pipeline(
        [{"type": "readers.las", "filename": str(source), "use_eb_vlr": True}, {"type": "filters.hag_minima"},
         {"type": "writers.classifiermodel", "filename": str(tmp_path / name), "neighborhoods": "c1,s2", "trees": 5,
          "feature_set": "covariance,geometric", "count": 100, **more}]
    )  # fmt: skip
    return tmp_path / name


def test_other_dimensions(cell, tmp_path, write_las, cloud):
    data = scene()
    data["Amplitude"] = np.where(data["Classification"] == 6, 3.0, 1.0).astype("f4")
    source = write_las(tmp_path / "with.las", data, point_format=3)
    model = trained(tmp_path, source, dimensions=["Amplitude"])
    cell("Models", "model trained on an extra dimension that the points lack").refused(
        ["classify", cloud, tmp_path / "out.las", "--model", model], "'Amplitude' is missing"
    )
    job_ = job(
        tmp_path,
        str(cloud),
        {"type": "filters.modelclassifier", "model": str(trained(tmp_path, cloud, "h.model"))},
    )
    cell("Models", "model that needs heights, without the stage that makes them").refused(
        ["pipeline", job_], "'HeightAboveGround' is missing", "filters.hag_minima"
    )
    cell("Models", "model trained on an extra dimension that the points have").runs(
        ["classify", source, tmp_path / "out.las", "--model", model], "classes"
    )
    assert (
        np.mean(np.asarray(laspy.read(tmp_path / "out.las").classification) == data["Classification"]) > 0.95
    )


def test_trained_in_feet(cell, tmp_path, write_las, cloud):
    from test_robust_clouds import WKT

    feet = scene(seed=5)
    for axis in "XYZ":
        feet[axis] = feet[axis] / 0.304800609601219
    source = write_las(tmp_path / "feet.las", feet, point_format=6, wkt=WKT["us-ft"], scale=1e-4)
    model = trained(tmp_path, source)
    cell("Models", "model trained on points in feet, applied to meters").runs(
        ["classify", cloud, tmp_path / "out.las", "--model", model],
        "classes: features are meters whatever the file's unit",
    )
    assert (
        np.mean(np.asarray(laspy.read(tmp_path / "out.las").classification) == scene()["Classification"])
        > 0.9
    )


def test_a_model_that_changes_between_runs(cell, tmp_path, cloud, model):
    copy = tmp_path / "m.model"
    copy.write_bytes(model.read_bytes())
    words = ["classify", cloud, tmp_path / "out.las", "--model", copy]
    it = cell("Models", "model file that is damaged between two runs of one process")
    assert it.command(*words).code == 0
    (tmp_path / "out.las").unlink()
    copy.write_bytes(model.read_bytes()[:-50])
    it.refused(words, "m.model")


# ---- names and figures that are not meant for people ----------------------------------------------------------


def rewritten(model, target, **changes):
    def edit(head, members):
        for place, value in changes.items():
            node = head
            *way, last = place.split("__")
            for word in way:
                node = node[int(word)] if word.isdigit() else node[word]
            node[last] = value

    return repack(model, target, edit)


def test_names_that_command_a_terminal(cell, tmp_path, cloud, model):
    name = "\x1b]0;title\x07\x1b[31mred\u202eder"
    evil = rewritten(model, tmp_path / "evil.model", classes__0__name=name)
    it = cell("Models", "class name with escape sequences")
    for words in (["model", evil], ["classify", cloud, tmp_path / "o.las", "--model", evil]):
        done = it.runs(words, "printed as codes, such as \\x1b")
        assert "\\x1b]0;title\\x07\\x1b[31mred\\u202eder" in done.out
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", done.out + done.err)
    odd = tmp_path / "a\x1b[31m\x07.las"
    odd.write_bytes(cloud.read_bytes())
    it = cell("Clouds", "file name with escape sequences")
    done = it.runs(["classify", odd, tmp_path / "o\x1b[0m.las", "--model", model], "printed as codes")
    assert "o\\x1b[0m.las" in done.out and "\x1b" not in done.out + done.err
    it.refused(["classify", odd, odd, "--model", model], "a\\x1b[31m\\x07.las")


def test_figures_of_any_size(cell, tmp_path, model):
    curve = [
        {"epoch": e, "loss": v, "mean_f1": v}
        for e, v in ((0, 1), (10**400, 10**400), (1, 0.5), (2, 0.25), (-3, -1))
    ]
    for case, changes in (
        (
            "model with integers of 400 digits",
            {"training__huge": 10**400, "passes__0__parameters__trees": 10**400},
        ),
        ("model with a curve of epochs 0, -3 and 10^400", {"training__curve": curve}),
        (
            "model whose curve is of epoch 0 alone",
            {"training__curve": [{"epoch": 0, "loss": 0, "mean_f1": 0}] * 2},
        ),
    ):
        odd = rewritten(model, tmp_path / "odd.model", **changes)
        it = cell("Models", case)
        done = it.command("model", odd, "--html", tmp_path / "page.html")
        if done.code:
            it.refused(done, "odd.model")
        else:
            it.runs(done, "printed, and drawn as far as it can be")
            assert (tmp_path / "page.html").read_text().rstrip().endswith("</html>")


# ---- labels among what is trained on ---------------------------------------------------------------------------


def test_the_label_as_a_dimension(cell, tmp_path, write_las):
    data = scene(2000)
    source = write_las(tmp_path / "in.las", data, point_format=6)
    words = [
        "train",
        source,
        "--model",
        tmp_path / "m.model",
        "--neighborhoods",
        "c1",
        "--count",
        "100",
        "--trees",
        "3",
    ]
    it = cell("Models", "training on the label itself")
    it.refused(
        [*words, "--writers.classifiermodel.dimensions=Classification"], "the label itself", "Leave it out"
    )


def test_more_samples_than_points(cell, tmp_path, cloud):
    """The largest class bounds what is drawn, so a figure that means 'all' costs what all cost."""
    it = cell("Models", "training with 99,999,999 samples of each class, on 600 points")
    it.runs(
        [
            "train",
            cloud,
            "--model",
            tmp_path / "m.model",
            "--neighborhoods",
            "c1",
            "--count",
            "99999999",
            "--trees",
            "3",
        ],
        "trained on all points",
    )
    (large, small) = sorted(
        ps.load_model(tmp_path / "m.model").info["classes"], key=lambda c: -c["available"]
    )
    assert large["duplicates"] == 0 and small["samples"] + small["duplicates"] == large["samples"]
