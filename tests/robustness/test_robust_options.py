"""Options: every mistake is named with its file, line, stage, option, value and cure."""

from __future__ import annotations

import pytest
from robustness_kit import job

import pdal_stages as ps
from pdal_stages.base.errors import StageError

pytestmark = pytest.mark.pdal

HAG, FEATURES, TRAIN, ACCURACY = (
    "filters.hag_minima",
    "filters.multiscalefeatures",
    "writers.classifiermodel",
    "filters.accuracy",
)

#: case, stage, options, what the message must hold
WRONG = [
    ("unknown option", HAG, {"cels": 5}, ["no option 'cels'", "5", "Did you mean 'cell'?"]),
    ("option of another stage", HAG, {"neighborhoods": "c1"}, ["no option 'neighborhoods'", "Options: cell"]),
    ("text for a number", HAG, {"cell": "wide"}, ["option 'cell' must be a number", '"wide"']),
    ("true for a number", HAG, {"cell": True}, ["option 'cell' must be a number", "true"]),
    ("null for a number", HAG, {"cell": None}, ["option 'cell' must be a number", "null"]),
    ("zero length", HAG, {"cell": 0}, ["must be a number above 0", "(found 0)"]),
    ("length of 1e300", HAG, {"cell": 1e300}, ["at most 10000 m", "1e+300"]),
    (
        "resolution larger than cell",
        HAG,
        {"cell": 1, "resolution": 5},
        ["not be larger than 'cell'", "Swap them"],
    ),
    ("class code of 300", HAG, {"ignore": [300]}, ["class codes of 0 to 255", "300"]),
    ("fraction for a whole number", FEATURES, {"seed": 1.5}, ["option 'seed' must be a whole number", "1.5"]),
    ("a million threads", HAG, {"threads": 1_000_000}, ["option 'threads'", "from 0 to 1024"]),
    (
        "empty list of neighborhoods",
        FEATURES,
        {"neighborhoods": []},
        ["is an empty list", "Name at least one"],
    ),
    ("empty list of features", FEATURES, {"feature_set": []}, ["'feature_set' is an empty list"]),
    ("unknown neighborhood", FEATURES, {"neighborhoods": "q5"}, ["option 'neighborhoods'", "q5"]),
    ("contradictory kopt(100,10)", FEATURES, {"neighborhoods": "kopt(100,10)"}, ["kopt(100,10)"]),
    ("neighborhood without a radius", FEATURES, {"neighborhoods": "c"}, ["option 'neighborhoods'"]),
    ("unknown feature", FEATURES, {"feature_set": "Linarity"}, ["option 'feature_set'", "Linearity"]),
    ("where that does not parse", HAG, {"where": "Z >> 3"}, ["'where' expression", "at character 4"]),
    ("where that is no condition", HAG, {"where": "Z + 3"}, ["gives a number, not true or false"]),
    ("where nested 1,000 deep", HAG, {"where": "(" * 1000 + "Z>1" + ")" * 1000}, ["nested too deeply"]),
    ("unknown unit", HAG, {"horizontal_unit": "foots"}, ["not a known length unit", "Did you mean"]),
    ("label mapping to no class", TRAIN, {"filename": "m", "classes": {"2,3": "Grond"}}, ["Grond"]),
    ("label mapped twice", TRAIN, {"filename": "m", "classes": {"2": 2, "2,3": 5}}, ["label twice"]),
    ("class code of 999", TRAIN, {"filename": "m", "classes": {"2": 999}}, ["999"]),
    ("binary without a target", TRAIN, {"filename": "m", "strategy": "binary"}, ["needs 'target'"]),
    ("unknown strategy", TRAIN, {"filename": "m", "strategy": "multi"}, ["must be one of", "Did you mean"]),
    ("trees in superscript", TRAIN, {"filename": "m", "trees": "\u00b2"}, ["'trees'"]),
    (
        "no samples",
        TRAIN,
        {"filename": "m", "count": 0},
        ["option 'count' must be a whole number from 1 to"],
    ),
    ("share of 2", TRAIN, {"filename": "m", "max_samples": 2}, ["option 'max_samples'", "at most 1"]),
    ("no file name", TRAIN, {}, ["option 'filename' is required"]),
    (
        "model in a folder that is not there",
        TRAIN,
        {"filename": "no/such/m"},
        ["folder", "does not exist", "Create it"],
    ),
    ("model named as a folder", TRAIN, {"filename": "."}, ["names a folder"]),
    ("merge that is no mapping", ACCURACY, {"merge": [5]}, ["option 'merge' must be a mapping"]),
    ("yes for true", ACCURACY, {"print": "yes"}, ["option 'print' must be true or false", '"yes"']),
]


@pytest.mark.parametrize(("case", "stage", "options", "says"), WRONG, ids=[row[0] for row in WRONG])
def test_wrong_options(cell, tmp_path, monkeypatch, case, stage, options, says):
    monkeypatch.chdir(tmp_path)
    path = job(
        tmp_path,
        "in.las",
        {"type": stage, "tag": "t", **options},
        {"type": "writers.las", "filename": "o.las"},
    )
    message = cell("Options", case).refused(
        ["pipeline", path], f"job.json, line 3: {stage} (tag 't'):", *says
    )
    # The objects of python-pdal say the same, without the file.
    family, _, name = stage.partition(".")
    with pytest.raises(StageError) as caught:
        getattr(ps.Filter if family == "filters" else ps.Writer, name)(tag="t", **options)
    assert str(caught.value) in message


STAGES = [
    ("unknown stage of ours", [{"type": "filters.hagminima"}], ["line 3", "no stage 'filters.hagminima'", "filters.hag_minima"]),
    ("reader for a filter", [{"type": "readers.hag_minima"}], ["line 3", "Did you mean 'filters.hag_minima'?"]),
    ("unknown stage", [{"type": "filters.reprojektion"}], ["line 3", "filters.reprojektion", "Did you mean 'filters.reprojection'?"]),
    ("unknown option of PDAL's stage", [{"type": "filters.range", "limit": "Z[0:1]"}], ["line 3", "Unexpected argument 'limit'"]),
    ("wrong value of PDAL's option", [{"type": "filters.outlier", "mean_k": "x"}], ["line 3", "mean_k"]),
    ("type that is a number", [{"type": 5}], ["line 3", "'type' is text", "5"]),
    ("inputs that is no tag", [{"type": HAG, "inputs": ["nix"]}], ["undefined stage tag 'nix'"]),
    ("stage that is a number", [7], ["line 3", "a stage is an object, or a file name", "7"]),
    ("dimension that is missing", [{"type": ACCURACY}], ["'Reference' is missing", "filters.ferry"]),
    ("where with a dimension that is missing", [{"type": HAG, "where": "Hight > 2"}], ["names the dimension 'Hight'"]),
    ("where that holds for no point", [{"type": HAG, "where": "Z > 1e6"}], None),
    ("two writers of one file", [{"type": HAG}, {"type": "writers.las", "filename": "o.las"}], ["two output files are one"]),
    ("output in a folder that is not there", [{"type": "writers.las", "filename": "no/o.las"}], ["does not exist", "Create it"]),
    ("output named as a folder", [{"type": "writers.las", "filename": "."}], ["names a folder"]),
    ("output name of 300 characters", [{"type": "writers.las", "filename": "x" * 296 + ".las"}], ["longer than 255 bytes"]),
    ("input that is not there", [{"type": "readers.las", "filename": "nix.las"}], ["nix.las"]),
    ("more features than LAS describes", [{"type": FEATURES, "neighborhoods": "weinmann2018", "feature_set": "all"}, {"type": "writers.las", "filename": "p.las", "extra_dims": "all"}], ["LAS cannot hold so many"]),
]  # fmt: skip


@pytest.mark.parametrize(("case", "stages", "says"), STAGES, ids=[row[0] for row in STAGES])
def test_wrong_stages(cell, tmp_path, monkeypatch, cloud, case, stages, says):
    monkeypatch.chdir(tmp_path)
    path = job(tmp_path, str(cloud), *stages, {"type": "writers.las", "filename": "o.las"})
    if says is None:
        done = cell("Options", case).runs(
            ["pipeline", path], "a warning: 'where' holds for none of the 600 points"
        )
        assert "'where' holds for none of the 600 points: Z > 1e6" in done.err
    else:
        cell("Options", case).refused(["pipeline", path], *says)


def test_a_where_of_many_terms(cell, tmp_path, cloud):
    where = " || ".join(f"Classification == {k % 256}" for k in range(20_000))
    path = job(tmp_path, str(cloud), {"type": HAG, "where": where})
    cell("Options", "where of 20,000 terms").runs(["pipeline", path], "heights")


OVERRIDES = [
    (
        "--stage.TAG that matches nothing",
        ["--stage.hite.cell=5"],
        ["no stage of the pipeline has the tag 'hite'"],
    ),
    ("--filters.name that matches nothing", ["--filters.hag_nn.count=5"], ["has the type 'filters.hag_nn'"]),
    ("override without a value", ["--stage.t.cell"], ["has no value", "Write --stage.t.cell=VALUE"]),
    ("override that empties a list", [f"--{FEATURES}.neighborhoods="], ["is an empty list"]),
]


@pytest.mark.parametrize(("case", "words", "says"), OVERRIDES, ids=[row[0] for row in OVERRIDES])
def test_wrong_overrides(cell, tmp_path, monkeypatch, case, words, says):
    monkeypatch.chdir(tmp_path)
    path = job(tmp_path, "in.las", {"type": HAG, "tag": "t"}, {"type": FEATURES}, "o.las")
    cell("Options", case).refused(["pipeline", path, *words], *says)


USAGE = [
    ("no command", [], 2, "the following arguments are required"),
    ("unknown command", ["pipelines"], 2, "invalid choice"),
    ("unknown flag", ["validate", "job.json", "--strict"], 2, "unrecognized arguments: --strict"),
    ("no pipeline file", ["pipeline"], 1, "no pipeline file was given"),
    ("options of a stage that is not there", ["options", "filters.hag_minimum"], 1, "Did you mean 'filters.hag_minima'?"),
    ("classify with a model that is not there", ["classify", "JOB", "b.las", "--model", "standart"], 1, "Did you mean 'standard'?"),
    ("classify a file that is not there", ["classify", "a.las", "b.las"], 1, "a.las: there is no such file or folder. Check the path"),
    ("train on a mistyped file", ["train", "jbo.json", "--model", "m"], 1, "Did you mean 'job.json'?"),
    ("metadata in a folder that is not there", ["pipeline", "JOB", "--metadata", "no/m.json"], 1, "metadata file does not exist"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "words", "code", "says"), USAGE, ids=[row[0] for row in USAGE])
def test_wrong_usage(cell, tmp_path, monkeypatch, cloud, case, words, code, says):
    monkeypatch.chdir(tmp_path)
    path = job(tmp_path, str(cloud), {"type": "writers.las", "filename": "o.las"})
    it = cell("Options", case)
    done = it.command(*(str(path) if word == "JOB" else word for word in words))
    if code == 2:  # argparse's own form
        assert done.code == 2 and says in done.err and "Traceback" not in done.err
    else:
        it.refused(done, says)
    assert not (tmp_path / "o.las").exists()


RIGHT = [
    ("number as text", {"cell": " 20 "}),
    ("list as text", {"ignore": "7, 18"}),
    ("list as one number", {"ignore": 7}),
]


@pytest.mark.parametrize(("case", "options"), RIGHT, ids=[row[0] for row in RIGHT])
def test_right_after_all(cell, tmp_path, monkeypatch, cloud, case, options):
    monkeypatch.chdir(tmp_path)
    path = job(tmp_path, str(cloud), {"type": HAG, **options})
    cell("Options", case).runs(
        ["expand", path], "is taken: " + ", ".join(f"`{k}`: {v!r}" for k, v in options.items())
    )
