"""The command line: flags, answers, exit codes, messages, and what is left on disk."""

from __future__ import annotations

import json
import re
import sys

import laspy
import pytest
from block_scene import ground_and_block
from processes import python

from pdal_stages.cli import main
from pdal_stages.cli.parser import COMMANDS, parse
from pdal_stages.stages.registry import stage_types

pytestmark = pytest.mark.pdal


@pytest.fixture()
def cloud(tmp_path, write_las):
    return write_las(tmp_path / "cloud.laz", ground_and_block(800), point_format=3)


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


def test_pipeline_with_overrides(job, tmp_path, run):
    out = tmp_path / "other.las"
    words = [
        "--stage.height.cell=10",
        f"--writers.las.filename={out}",
        "--metadata",
        tmp_path / "m.json",
    ]
    code, _, err = run("pipeline", job, *words)
    assert code == 0, err
    assert len(laspy.read(out)) == 800
    assert (
        json.loads((tmp_path / "m.json").read_text())["metadata"]["filters.hag_minima"]["cells"]
        == 9
    )
    assert "meters were assumed" in err


def test_stdin_and_expand(job, run, monkeypatch, tmp_path):
    import io

    code, out, _ = run("expand", job)
    assert code == 0
    plain = json.loads(out)
    assert [s.get("type") for s in plain["pipeline"]] == [
        "readers.las",
        "filters.python",
        "writers.las",
    ]
    monkeypatch.setattr(sys, "stdin", io.StringIO(job.read_text(encoding="utf-8-sig")))
    assert run("pipeline", "--stdin")[0] == 0
    assert run("expand", job, "-o", tmp_path / "plain.json")[0] == 0
    assert json.loads((tmp_path / "plain.json").read_text())["pipeline"][1]["function"] == "stage"


def test_validate(job, run, tmp_path):
    assert run("validate", job)[0] == 0
    code, out, _ = run("pipeline", "--validate", job)
    assert code == 0
    assert json.loads(out)["valid"] is True
    assert not (tmp_path / "out.las").exists()


def test_drivers_and_options_answer_like_pdal(run):
    code, out, _ = run("drivers")
    assert code == 0
    assert all(name in out for name in [*stage_types(), "readers.las"])
    listed = json.loads(run("drivers", "--showjson")[1])
    assert {"filters.hag_minima", "writers.las"} <= {d["name"] for d in listed}
    for name, stage in stage_types().items():
        out = run("options", name)[1]
        assert all(f"\n  {o.name}" in out for o in stage.all_options())
        schema = json.loads(run("options", name, "--showjson")[1])
        assert set(schema["properties"]) >= {o.name for o in stage.all_options()}
    assert "max_distance" in run("options", "filters.hag_nn")[1]
    code, _, err = run("options", "filters.hag_minma")
    assert code == 1 and "Did you mean 'filters.hag_minima'?" in err


def test_classify_imports_no_extras(cloud, tmp_path):
    script = f"""if True:
        import sys
        from pdal_stages.cli import main
        assert main(["classify", {str(cloud)!r}, {str(tmp_path / "out.laz")!r}]) == 0
        rooms = {{name.split(".")[1] for name in sys.modules if name.startswith("pdal_stages.")}}
        print(sorted(rooms & {{"objects", "reports", "review", "synthetic", "plugin"}}))
    """
    assert python(script).endswith("\n[]\n")


@pytest.mark.parametrize(
    ("words", "inputs", "output"),
    [
        (
            "classify a.laz --tile 500 b.laz --bridges c.laz out/",
            ["a.laz", "b.laz", "c.laz"],
            "out/",
        ),
        ("objects a.laz b.laz --cell 1 o.gpkg", ["a.laz", "b.laz"], "o.gpkg"),
        ("review --workers 2 a.laz b.laz --no-progress o.gpkg", ["a.laz", "b.laz"], "o.gpkg"),
        ("train a.laz --model m.model b.laz", ["a.laz", "b.laz"], None),
    ],
)
def test_names_may_stand_behind_flags(words, inputs, output):
    seen = parse(words.split(), is_program=False)
    assert seen.inputs == inputs and getattr(seen, "output", None) == output


@pytest.mark.parametrize(
    "command", [None, *(name for names in COMMANDS.values() for name in names)]
)
def test_help_fits_a_screen(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([*filter(None, [command]), "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 80
    with pytest.raises(SystemExit):
        main([*filter(None, [command]), "--help-all"])
    flags = set(re.findall(r"--[^ ]*\w+", capsys.readouterr().out)) - set(
        re.findall(r"--[^ ]*\w+", "\n".join(lines))
    )
    assert bool(flags) == ("--help-all" in lines[-1])
