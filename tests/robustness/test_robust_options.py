"""Options: every mistake is named with its file, line, stage, option, value and cure."""

from __future__ import annotations

import numpy as np
import pytest
from robustness_kit import HAG, job

import pdal_stages as ps
from pdal_stages.base.errors import StageError

pytestmark = pytest.mark.pdal

HEIGHTS = "filters.hag_minima"
FEATURES = "filters.multiscalefeatures"
TRAIN = "writers.classifiermodel"
ACCURACY = "filters.accuracy"
OUT = {"type": "writers.las", "filename": "o.las"}

#: stage, options, what the message must hold
WRONG = {
    "unknown option": (HEIGHTS, {"cels": 5}, ["no option 'cels'", "5", "Did you mean 'cell'?"]),
    "option of another stage": (HEIGHTS, {"neighborhoods": "c1"}, ["no option 'neighborhoods'", "Options: cell"]),
    "text for a number": (HEIGHTS, {"cell": "wide"}, ["option 'cell' must be a number", "'wide'"]),
    "true for a number": (HEIGHTS, {"cell": True}, ["option 'cell' must be a number", "True"]),
    "length of 0": (HEIGHTS, {"cell": 0}, ["must be a number from 0.05", "(found 0)"]),
    "length of 1e300": (HEIGHTS, {"cell": 1e300}, ["to 10000 m", "1e+300"]),
    "options that contradict": (HEIGHTS, {"cell": 1, "resolution": 5}, ["not be larger than 'cell'", "Swap them"]),
    "class code of 300": (HEIGHTS, {"ignore": [300]}, ["class codes of 0 to 255", "300"]),
    "fraction for a whole number": (FEATURES, {"seed": 1.5}, ["option 'seed' must be a whole number", "1.5"]),
    "a million threads": (HEIGHTS, {"threads": 1_000_000}, ["option 'threads'", "from 0 to 1024"]),
    "empty list": (FEATURES, {"neighborhoods": []}, ["is an empty list", "Name at least one"]),
    "unknown neighborhood": (FEATURES, {"neighborhoods": "q5"}, ["unknown neighborhood", "q5"]),
    "contradictory neighborhood": (FEATURES, {"neighborhoods": "kopt(100,10)"}, ["kopt(100,10)"]),
    "unknown feature": (FEATURES, {"feature_set": "Linarity"}, ["unknown feature", "Linearity"]),
    "where that does not parse": (HEIGHTS, {"where": "Z >> 3"}, ["'where' expression", "not a condition", "Example"]),
    "where that is no condition": (HEIGHTS, {"where": "Z + 3"}, ["gives a number, not true or false"]),
    "where nested 1,000 deep": (HEIGHTS, {"where": "(" * 1000 + "Z>1" + ")" * 1000}, ["'where' expression"]),
    "where of 20 kB": (HEIGHTS, {"where": "Z > 3 && " * 2500 + "X"}, ["'where' expression", "(22,501 characters)"]),
    "depth of a number": (TRAIN, {"filename": "m", "max_depth": 1}, ["option 'max_depth'"]),
    "another depth": (TRAIN, {"filename": "m", "max_depth": "1"}, ["'max_depth' must be 'sqrt', or left out"]),
    "unknown unit": (HEIGHTS, {"horizontal_unit": "foots"}, ["not a known length unit", "Did you mean"]),
    "label mapping to no class": (TRAIN, {"filename": "m", "classes": {"2,3": "Grond"}}, ["Grond"]),
    "label mapped twice": (TRAIN, {"filename": "m", "classes": {"2": 2, "2,3": 5}}, ["label twice"]),
    "none of the choices": (TRAIN, {"filename": "m", "vote": "majorty"}, ["must be one of", "Did you mean"]),
    "number in superscript": (TRAIN, {"filename": "m", "trees": "\u00b2"}, ["'trees'"]),
    "share of 2": (TRAIN, {"filename": "m", "max_samples": 2}, ["option 'max_samples'", "at most 1"]),
    "no file name": (TRAIN, {}, ["option 'filename' is required"]),
    "folder that is not there": (TRAIN, {"filename": "no/such/m"}, ["folder", "does not exist", "Create it"]),
    "merge that is no mapping": (ACCURACY, {"merge": [5]}, ["option 'merge' must be a mapping"]),
    "yes for true": (ACCURACY, {"print": "yes"}, ["option 'print' must be true or false", '"yes"']),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options(command, tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    stage, options, says = WRONG[case]
    path = job(tmp_path, "in.las", {"type": stage, "tag": "t", **options}, OUT)
    message = command.refused(["pipeline", path], f"job.json, line 3: {stage} (tag 't'):", *says)
    # The objects of python-pdal say the same, without the file.
    family, _, name = stage.partition(".")
    with pytest.raises(StageError) as caught:
        getattr(ps.Filter if family == "filters" else ps.Writer, name)(tag="t", **options)
    assert str(caught.value) in message


STAGES = {
    "unknown stage of ours": ([{"type": "filters.hagminima"}], ["line 3", "filters.hagminima", "filters.hag_minima"]),
    "reader for a filter": ([{"type": "readers.hag_minima"}], ["line 3", "Did you mean 'filters.hag_minima'?"]),
    "unknown stage": ([{"type": "filters.reprojektion"}], ["line 3", "Did you mean 'filters.reprojection'?"]),
    "unknown option of PDAL's stage": ([{"type": "filters.range", "limit": "Z[0:1]"}], ["line 3", "Unexpected argument 'limit'"]),
    "wrong value of PDAL's option": ([{"type": "filters.outlier", "mean_k": "x"}], ["line 3", "mean_k"]),
    "type that is a number": ([{"type": 5}], ["line 3", "'type' is text", "5"]),
    "inputs that is no tag": ([{**HAG, "inputs": ["nix"]}], ["undefined stage tag 'nix'"]),
    "stage that is a number": ([7], ["line 3", "a stage is an object, or a file name", "7"]),
    "dimension that is missing": ([{"type": ACCURACY}], ["'Reference' is missing", "filters.ferry"]),
    "where with a missing dimension": ([{**HAG, "where": "Hight > 2"}], ["names the dimension 'Hight'"]),
    "two writers of one file": ([HAG, OUT], ["two output files are the same file"]),
    "output named as a folder": ([{**OUT, "filename": "."}], ["names a folder"]),
    "output name of 300 characters": ([{**OUT, "filename": "x" * 296 + ".las"}], ["longer than 255 bytes"]),
    "input that is not there": ([{"type": "readers.las", "filename": "nix.las"}], ["nix.las"]),
    "more features than LAS describes": ([{"type": FEATURES, "neighborhoods": "weinmann2018", "feature_set": "all"}, {**OUT, "filename": "p.las", "extra_dims": "all"}], ["LAS cannot hold so many"]),
}  # fmt: skip


@pytest.mark.parametrize("case", STAGES)
def test_wrong_stages(command, tmp_path, monkeypatch, cloud, case):
    monkeypatch.chdir(tmp_path)
    stages, says = STAGES[case]
    command.refused(["pipeline", job(tmp_path, cloud, *stages, OUT)], *says)


OVERRIDES = {
    "--stage.hite.cell=5": "no stage of the pipeline has the tag 'hite'",
    "--stage.tt.cell=5": "Did you mean 't'?",
    "--stage.t.cel=5": "Did you mean 'cell'?",
    "--writers.las.skale_x=1": "List its options with: pdal-stages",
    "--filters.hag_nn.count=5": "has the type 'filters.hag_nn'",
    "--stage.t.cell": "Write --stage.t.cell=VALUE",
    f"--{FEATURES}.neighborhoods=": "is an empty list",
}
USAGE = {
    "unknown command": (["pipelines"], "Did you mean 'pipeline'?"),
    "unknown choice": (["classify", "a.las", "out", "--per", "fil"], "Did you mean 'file'?"),
    "options of stages for a model": (["model", "no.model", "--filters.x.y=1"], "takes no stage options"),
    "accuracy of two files": (["accuracy", "c.las", "c.las"], "--reference FILE, of the same points"),
    "unknown dimension": (["accuracy", "c.las", "--reference-dimension", "Clasification"], "Did you mean 'Classification'?"),
    "scheduler without its protocol": (["classify", "c.las", "o", "--scheduler", "localhost"], "missing port number"),
    "a buffer larger than the Earth": (["pipeline", "job.json", "--tile", "50", "--buffer", "1e308"], "1e+09 meters"),
    "tiles of a nanometer": (["classify", "c.las", "o", "--tile", "1e-9"], "from 0.001 to 1e+09"),
    "unknown flag": (["validate", "job.json", "--strict"], "unrecognized arguments: --strict"),
    "no pipeline file": (["pipeline"], "no pipeline file was given"),
    "options of a stage that is not there": (["options", "filters.hag_minimum"], "Did you mean 'filters.hag_minima'?"),
    "classify a file that is not there": (["classify", "nowhere.laz", "b.las"], "nowhere.laz: there is no such file or folder. Check the path"),
    "train on a mistyped file": (["train", "jbo.json", "--model", "m"], "Did you mean 'job.json'?"),
    "metadata in a folder that is not there": (["pipeline", "job.json", "--metadata", "no/m.json"], "metadata file does not exist"),
    **{word: (["pipeline", "job.json", word], says) for word, says in OVERRIDES.items()},
}  # fmt: skip


@pytest.mark.parametrize("case", USAGE)
def test_wrong_usage(command, tmp_path, monkeypatch, cloud, case):
    monkeypatch.chdir(tmp_path)
    words, says = USAGE[case]
    (tmp_path / "c.las").write_bytes(cloud.read_bytes())
    job(tmp_path, cloud, {**HAG, "tag": "t"}, {"type": FEATURES, "neighborhoods": "c1"}, OUT)
    command.refused(words, says)


@pytest.mark.parametrize("options", [{"cell": " 20 "}, {"ignore": "7, 18"}, {"ignore": 7}], ids=str)
def test_right_after_all(command, tmp_path, cloud, options):
    command.runs(["expand", job(tmp_path, cloud, {**HAG, **options})])


def test_wheres_of_no_point_and_of_many_terms(command, tmp_path, cloud):
    done = command.runs(["pipeline", job(tmp_path, cloud, {**HAG, "where": "Z > 1e6"})])
    assert "'where' matches no points: Z > 1e6" in done.err
    where = " || ".join(f"Classification == {k % 256}" for k in range(4_000))
    command.runs(["pipeline", job(tmp_path, cloud, {**HAG, "where": where})])


@pytest.mark.parametrize("deep", [150, 900, 5000])
def test_options_nested_too_deeply(command, tmp_path, monkeypatch, deep):
    """Lists, or objects, in any option; also where Python gives them."""
    monkeypatch.chdir(tmp_path)
    for text in ("[" * deep + "]" * deep, '{"a":' * deep + "1" + "}" * deep):
        for stage, option in ((HEIGHTS, "ignore"), (TRAIN, "classes"), ("filters.crop", "bounds")):
            (tmp_path / "job.json").write_text(
                f'["in.las", {{"type": "{stage}", "{option}": {text}}}, "o.las"]'
            )
            message = command.refused(["pipeline", tmp_path / "job.json"])
            assert "nested" in message or "recursion" in message
            assert len(message) < 600
    value = []
    for _ in range(deep):
        value = [value]
    with pytest.raises(StageError, match="nested more than"):
        ps.Filter.hag_morphological(ignore=value)
    with pytest.raises(StageError, match="nested more than"):
        ps.run_pipeline([{"type": HEIGHTS, "ignore": value}])


def test_a_long_where_that_matches_nothing_is_printed_in_part(
    command, tmp_path, monkeypatch, cloud
):
    monkeypatch.chdir(tmp_path)
    where = " || ".join(["Z > 1e9"] * 2000)
    path = job(tmp_path, cloud, {"type": HEIGHTS, "where": where}, OUT)
    message = command.runs(["pipeline", path]).err
    assert "'where' matches no points: Z > 1e9 ||" in message and len(message) < 1000


def test_line_breaks_in_names_are_printed_as_codes(command, tmp_path, write_las):
    """Of dimensions and files, in errors and in results."""
    x, y = np.random.default_rng(0).uniform(0, 30, (2, 500))
    arrays = {"X": x, "Y": y, "Z": 0 * x, "Classification": np.full(500, 2, np.uint8)}
    arrays |= {"a\nb 100 %": x, "Checked": np.ones(500, np.uint8)}
    source = write_las(tmp_path / "in\n2 Ground.las", arrays, point_format=6)
    out = tmp_path / "out\n2 Ground.laz"
    for words in (
        ["accuracy", source, "--reference-dimension", "Nothing"],
        ["corrections", source, source, "--out", out],
        ["objects", source, tmp_path / "o\n2 Ground.gpkg"],
        ["classify", source, out],
    ):
        done = command(*words)
        for line in (done.out + done.err).splitlines():
            assert not line.startswith(("2 Ground", "b 100 %")), (words, line)


def test_all_points_are_withheld(command, tmp_path, write_las):
    x, y = np.random.default_rng(0).uniform(0, 30, (2, 500))
    arrays = {"X": x, "Y": y, "Z": 0 * x, "Withheld": np.ones(500, np.uint8)}
    arrays["Classification"] = np.repeat([2, 5], 250).astype(np.uint8)
    source = write_las(tmp_path / "in.las", arrays, point_format=6)
    command.refused(
        ["train", source, "--model", tmp_path / "m.model"], "Left out are points that are withheld"
    )
