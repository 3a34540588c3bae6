"""The command line: flags, answers, exit codes, messages, and what is left on disk."""

from __future__ import annotations

import json
import sys

import laspy
import numpy as np
import pytest

from pdal_stages.cli import main, parsed
from pdal_stages.stages import registry

pytestmark = pytest.mark.pdal


@pytest.fixture()
def cloud(tmp_path, write_las):
    rng = np.random.default_rng(1)
    n = 800
    x, y = rng.uniform(0, 30, (2, n))
    block = (x > 15) & (y > 15)
    z = np.where(block, 5.0, 0.0) + rng.normal(0, 0.02, n)
    arrays = {"X": x, "Y": y, "Z": z, "Classification": np.where(block, 6, 2).astype(np.uint8)}
    return write_las(tmp_path / "cloud.laz", arrays, point_format=3)


@pytest.fixture()
def job(tmp_path, cloud):
    path = tmp_path / "job.json"
    out = tmp_path / "out.las"
    text = f"""// a comment, as PDAL allows
{{ "pipeline": [
    {json.dumps(str(cloud))},
    {{ "type": "filters.hag_minima", "tag": "height" }},
    {{ "type": "writers.las", "filename": {json.dumps(str(out))}, "extra_dims": "all" }}
]}}"""
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    return path


def run(capsys, *words):
    code = main([str(w) for w in words])
    return code, *capsys.readouterr()


def test_pipeline_with_overrides(job, tmp_path, capsys):
    out = tmp_path / "other.las"
    code, _, err = run(
        capsys,
        "pipeline",
        job,
        "--stage.height.cell=10",
        f"--writers.las.filename={out}",
        "--metadata",
        tmp_path / "m.json",
    )
    assert code == 0, err
    assert len(laspy.read(out)) == 800
    assert json.loads((tmp_path / "m.json").read_text())["metadata"]["filters.hag_minima"]["cells"] == 9
    assert "meters were assumed" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--stage.hieght.cell=10"], "Did you mean 'height'?"),
        (["--stage.height.cell=ten"], "option 'cell' must be a number"),
        (["--stage.height.resolution=50"], "must not be larger than 'cell'"),
        (["--filters.hag_minima.cel=10"], "Did you mean 'cell'?"),
        (["--stage.height.cell"], "has no value"),
        (["--stage.height.where=Z >"], "'where' expression cannot be read"),
    ],
)
def test_mistakes_are_named(job, tmp_path, capsys, words, message):
    code, out, err = run(capsys, "pipeline", job, *words)
    assert code == 1
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert not (tmp_path / "out.las").exists()


def test_stdin_and_expand(job, capsys, monkeypatch, tmp_path):
    import io

    code, out, _ = run(capsys, "expand", job)
    assert code == 0
    plain = json.loads(out)
    assert [s.get("type") for s in plain["pipeline"]] == [None, "filters.python", "writers.las"]
    monkeypatch.setattr(sys, "stdin", io.StringIO(job.read_text(encoding="utf-8-sig")))
    assert run(capsys, "pipeline", "--stdin")[0] == 0
    assert run(capsys, "expand", job, "-o", tmp_path / "plain.json")[0] == 0
    assert json.loads((tmp_path / "plain.json").read_text())["pipeline"][1]["function"] == "stage"


def test_standard_input_is_named_in_tiles_too(capsys, monkeypatch):
    import io

    for words in ([], ["--tile", "50"]):
        monkeypatch.setattr(sys, "stdin", io.StringIO('["in.las", {"type": ]'))
        code, _, err = run(capsys, "pipeline", "--stdin", *words)
        assert code == 1 and "standard input, line 1" in err


def test_validate(job, capsys, tmp_path):
    assert run(capsys, "validate", job)[0] == 0
    code, out, _ = run(capsys, "pipeline", "--validate", job)
    assert code == 0
    assert json.loads(out)["valid"] is True
    assert not (tmp_path / "out.las").exists()


def test_drivers_and_options_answer_like_pdal(capsys):
    code, out, _ = run(capsys, "drivers")
    assert code == 0
    assert all(name in out for name in [*registry.stages(), "readers.las"])
    listed = json.loads(run(capsys, "drivers", "--showjson")[1])
    assert {"filters.hag_minima", "writers.las"} <= {d["name"] for d in listed}
    for name, stage in registry.stages().items():
        out = run(capsys, "options", name)[1]
        assert all(f"\n  {o.name}" in out for o in stage.all_options())
        schema = json.loads(run(capsys, "options", name, "--showjson")[1])
        assert set(schema["properties"]) >= {o.name for o in stage.all_options()}
    assert "max_distance" in run(capsys, "options", "filters.hag_nn")[1]
    code, _, err = run(capsys, "options", "filters.hag_minma")
    assert code == 1 and "Did you mean 'filters.hag_minima'?" in err


def test_schemas_are_schemas_and_accept_the_examples():
    import jsonschema

    for stage in registry.stages().values():
        schema = stage.schema()
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(stage.example, schema)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**stage.example, "nonsense": 1}, schema)


def test_train_model_classify_accuracy(cloud, tmp_path, capsys):
    model, out = tmp_path / "m.model", tmp_path / "out.laz"
    code, printed, err = run(
        capsys,
        "train",
        cloud,
        "--model",
        model,
        "--neighborhoods",
        "c1,s2",
        "--count",
        100,
        "--writers.classifiermodel.trees=5",
    )
    assert code == 0, err
    assert "Ground" in printed and "Building" in printed
    assert run(capsys, "model", model)[0] == 0
    assert json.loads(run(capsys, "model", model, "--showjson")[1])
    code, printed, err = run(capsys, "classify", cloud, out, "--model", model)
    assert code == 0, err
    assert "800 points written" in printed
    code, _, err = run(
        capsys,
        "accuracy",
        out,
        "--reference",
        cloud,
        "--json",
        tmp_path / "a.json",
        "--html",
        tmp_path / "a.html",
    )
    assert code == 0, err
    assert (tmp_path / "a.html").stat().st_size > 10_000


def test_wrong_usage(capsys, tmp_path):
    with pytest.raises(SystemExit) as stop:
        main(["pipelin"])
    assert stop.value.code == 2
    assert run(capsys, "pipeline")[0] == 1
    code, _, err = run(capsys, "pipeline", tmp_path / "no.json")
    assert code == 1 and "cannot be read" in err
    code, _, err = run(capsys, "model", tmp_path / "no.model", "--filters.x.y=1")
    assert code == 1 and "takes no stage options" in err


@pytest.mark.parametrize(
    ("words", "inputs", "output"),
    [
        ("classify a.laz --tile 500 b.laz --wires c.laz out/", ["a.laz", "b.laz", "c.laz"], "out/"),
        ("objects a.laz b.laz --cell 1 o.gpkg", ["a.laz", "b.laz"], "o.gpkg"),
        ("review --workers 2 a.laz b.laz --no-progress o.gpkg", ["a.laz", "b.laz"], "o.gpkg"),
        ("train a.laz --model m.model b.laz", ["a.laz", "b.laz"], None),
    ],
)
def test_names_may_stand_behind_flags(words, inputs, output):
    seen = parsed(words.split(), is_program=False)
    assert seen.inputs == inputs and getattr(seen, "output", None) == output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["pipline", "{job}"], "Did you mean 'pipeline'?"),
        (["classify", "{job}", "out", "--per", "fil"], "Did you mean 'file'?"),
    ],
)
def test_choices_are_suggested(job, capsys, words, message):
    with pytest.raises(SystemExit):
        main([word.format(job=job) for word in words])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["pipeline", "{job}", "--writers.las.skale_x=1"],
            "Did you mean 'scale_x'? List its options with: pdal-stages",
        ),
        (["accuracy", "{cloud}", "{cloud2}"], "--reference FILE, of the same points"),
        (
            ["accuracy", "{cloud}", "{cloud2}", "--reference-dimension", "Clasification"],
            "Did you mean 'Classification'?",
        ),
        (
            ["classify", "{cloud}", "{folder}/o", "--scheduler", "localhost"],
            "For example tcp://localhost:8786",
        ),
    ],
)
def test_what_to_do_is_said(job, tmp_path, write_las, capsys, words, message):
    rng = np.random.default_rng(0)
    clouds = [write_las(tmp_path / f"{n}.las", {axis: rng.random(50) for axis in "XYZ"}) for n in "ab"]
    names = {"job": job, "cloud": clouds[0], "cloud2": clouds[1], "folder": tmp_path}
    code, _, err = run(capsys, *(word.format(**names) for word in words))
    assert code == 1 and message in err, err
