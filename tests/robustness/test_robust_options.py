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
    ("option in capitals", HAG, {"CELL": 5}, ["no option 'CELL'", "Options: cell"]),
    ("text for a number", HAG, {"cell": "wide"}, ["option 'cell' must be a number", '"wide"']),
    ("unit in a number", HAG, {"cell": "20m"}, ["option 'cell' must be a number", '"20m"']),
    ("decimal comma", HAG, {"cell": "0,5"}, ["option 'cell' must be a number", '"0,5"']),
    ("true for a number", HAG, {"cell": True}, ["option 'cell' must be a number", "true"]),
    ("null for a number", HAG, {"cell": None}, ["option 'cell' must be a number", "null"]),
    ("list for a number", HAG, {"cell": [20]}, ["option 'cell' must be a number", "[20]"]),
    ("object for a number", HAG, {"cell": {}}, ["option 'cell' must be a number", "{}"]),
    ("zero length", HAG, {"cell": 0}, ["must be a number above 0", "(found 0)"]),
    ("negative length", HAG, {"resolution": -0.5}, ["option 'resolution' must be a number above 0", "-0.5"]),
    ("length of 1e300", HAG, {"cell": 1e300}, ["at most 10000 m", "1e+300"]),
    ("number too large for a double", HAG, {"cell": "1e999"}, ["option 'cell' must be a number", "1e999"]),
    ("text NaN for a number", HAG, {"cell": "nan"}, ["option 'cell' must be a number"]),
    (
        "resolution larger than cell",
        HAG,
        {"cell": 1, "resolution": 5},
        ["not be larger than 'cell'", "Swap them"],
    ),
    ("class code of 300", HAG, {"ignore": [300]}, ["class codes of 0 to 255", "300"]),
    ("class code of -1", HAG, {"ignore": "-1"}, ["class codes of 0 to 255", "-1"]),
    ("nested list", HAG, {"ignore": [[7]]}, ["must be a list, or text separated by commas"]),
    ("fraction for a whole number", FEATURES, {"seed": 1.5}, ["option 'seed' must be a whole number", "1.5"]),
    ("negative seed", FEATURES, {"seed": -1}, ["option 'seed' must be a whole number from 0 to"]),
    ("negative threads", HAG, {"threads": -2}, ["option 'threads' must be a whole number from 0"]),
    ("a million threads", HAG, {"threads": 1_000_000}, ["option 'threads'", "from 0 to 1024"]),
    ("memory of 1 MB", FEATURES, {"memory": 1}, ["option 'memory' must be a whole number of 16 MB or more"]),
    (
        "empty list of neighborhoods",
        FEATURES,
        {"neighborhoods": []},
        ["is an empty list", "Name at least one"],
    ),
    ("empty text of neighborhoods", FEATURES, {"neighborhoods": ""}, ["is an empty list"]),
    ("only commas", FEATURES, {"neighborhoods": ",,,"}, ["is an empty list"]),
    ("empty list of features", FEATURES, {"feature_set": []}, ["'feature_set' is an empty list"]),
    ("unknown neighborhood", FEATURES, {"neighborhoods": "q5"}, ["option 'neighborhoods'", "q5"]),
    (
        "misspelt preset",
        FEATURES,
        {"neighborhoods": "weinman2018"},
        ["option 'neighborhoods'", "weinmann2018"],
    ),
    ("contradictory kopt(100,10)", FEATURES, {"neighborhoods": "kopt(100,10)"}, ["kopt(100,10)"]),
    ("kopt with one number", FEATURES, {"neighborhoods": "kopt(10)"}, ["kopt(10)"]),
    ("kopt of a million neighbors", FEATURES, {"neighborhoods": "kopt(10,1000000)"}, ["kopt(10,1000000)"]),
    ("neighborhood without a radius", FEATURES, {"neighborhoods": "c"}, ["option 'neighborhoods'"]),
    ("radius of 0", FEATURES, {"neighborhoods": "c0"}, ["option 'neighborhoods'", "c0"]),
    ("negative radius", FEATURES, {"neighborhoods": "s-1"}, ["option 'neighborhoods'", "s-1"]),
    (
        "radius of 1e9 m",
        FEATURES,
        {"neighborhoods": "c1000000000"},
        ["option 'neighborhoods'", "c1000000000"],
    ),
    ("unit in a radius", FEATURES, {"neighborhoods": "c2m"}, ["option 'neighborhoods'", "c2m"]),
    ("number for a neighborhood", FEATURES, {"neighborhoods": 5}, ["option 'neighborhoods'", "5"]),
    ("unknown feature", FEATURES, {"feature_set": "Linarity"}, ["option 'feature_set'", "Linearity"]),
    ("unclosed parenthesis", FEATURES, {"neighborhoods": "kopt(10,50"}, ["option 'neighborhoods'"]),
    ("where that does not parse", HAG, {"where": "Z >> 3"}, ["'where' expression", "at character 4"]),
    ("where in Python's words", HAG, {"where": "Z > 3 and X > 2"}, ["'and' is not expected"]),
    ("where that is no condition", HAG, {"where": "Z + 3"}, ["gives a number, not true or false"]),
    ("where left empty", HAG, {"where": " "}, ["option 'where' is empty"]),
    ("where that compares comparisons", HAG, {"where": "20 < Z < 22"}, ["'<' does not fit its two sides"]),
    ("where nested 1,000 deep", HAG, {"where": "(" * 1000 + "Z>1" + ")" * 1000}, ["nested too deeply"]),
    ("unknown unit", HAG, {"horizontal_unit": "foots"}, ["not a known length unit", "Did you mean"]),
    ("unit of an angle", HAG, {"vertical_unit": "degree"}, ["not a known length unit", "Known units"]),
    ("label mapping to no class", TRAIN, {"filename": "m", "classes": {"2,3": "Grond"}}, ["Grond"]),
    ("label mapped twice", TRAIN, {"filename": "m", "classes": {"2": 2, "2,3": 5}}, ["label twice"]),
    ("class code of 999", TRAIN, {"filename": "m", "classes": {"2": 999}}, ["999"]),
    ("classes as broken JSON text", TRAIN, {"filename": "m", "classes": '{"2": '}, ["classes"]),
    ("binary without a target", TRAIN, {"filename": "m", "strategy": "binary"}, ["needs 'target'"]),
    ("target without binary", TRAIN, {"filename": "m", "target": 2}, ["only with strategy 'binary'"]),
    ("unknown strategy", TRAIN, {"filename": "m", "strategy": "multi"}, ["must be one of", "Did you mean"]),
    ("no trees", TRAIN, {"filename": "m", "trees": 0}, ["'trees'", "0"]),
    ("half a tree", TRAIN, {"filename": "m", "trees": 1.5}, ["'trees'", "1.5"]),
    ("trees less than none twice", TRAIN, {"filename": "m", "trees": "--5"}, ["'trees'", "--5"]),
    ("trees in superscript", TRAIN, {"filename": "m", "trees": "\u00b2"}, ["'trees'"]),
    (
        "no samples",
        TRAIN,
        {"filename": "m", "count": 0},
        ["option 'count' must be a whole number from 1 to"],
    ),
    ("one fold", TRAIN, {"filename": "m", "folds": 1}, ["'folds' must be 0 or at least 2"]),
    ("share of 2", TRAIN, {"filename": "m", "max_samples": 2}, ["option 'max_samples'", "at most 1"]),
    ("no file name", TRAIN, {}, ["option 'filename' is required"]),
    ("empty file name", TRAIN, {"filename": ""}, ["option 'filename' is empty"]),
    (
        "model in a folder that is not there",
        TRAIN,
        {"filename": "no/such/m"},
        ["folder", "does not exist", "Create it"],
    ),
    ("model named as a folder", TRAIN, {"filename": "."}, ["names a folder"]),
    ("accuracy of no class", ACCURACY, {"classes": "ground"}, ["ground"]),
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
    ("tag that is a number", [{"type": HAG, "tag": 5}], ["line 3", "'tag' is text"]),
    ("inputs that is a number", [{"type": HAG, "inputs": 5}], ["line 3", "'inputs' is a tag"]),
    ("inputs that is no tag", [{"type": HAG, "inputs": ["nix"]}], ["undefined stage tag 'nix'"]),
    ("stage that is a number", [7], ["line 3", "a stage is an object, or a file name", "7"]),
    ("stage that is a list", [[{"type": HAG}]], ["line 3", "a stage is an object, or a file name"]),
    ("dimension that is missing", [{"type": ACCURACY}], ["'Reference' is missing", "filters.ferry"]),
    ("where with a dimension that is missing", [{"type": HAG, "where": "Hight > 2"}], ["names the dimension 'Hight'"]),
    ("where that holds for no point", [{"type": HAG, "where": "Z > 1e6"}], None),
    ("minor_version that is no number", [{"type": HAG}, {"type": "writers.las", "filename": "p.las", "minor_version": "x"}], ["minor_version"]),
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
    ("override out of range", ["--stage.t.cell=-1"], ["must be a number above 0"]),
    ("override with an unknown option", ["--stage.t.sell=1"], ["Did you mean 'cell'?"]),
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
    ("stage options where none are taken", ["drivers", "--stage.a.b=1"], 1, "takes no stage options"),
    ("options of a stage that is not there", ["options", "filters.hag_minimum"], 1, "Did you mean 'filters.hag_minima'?"),
    ("classify with a model that is not there", ["classify", "JOB", "b.las", "--model", "standart"], 1, "Did you mean 'standard'?"),
    ("classify a file that is not there", ["classify", "a.las", "b.las"], 1, "a.las: there is no such file or folder. Check the path"),
    ("train on a mistyped file", ["train", "jbo.json", "--model", "m"], 1, "Did you mean 'job.json'?"),
    ("objects of a file that is not there", ["objects", "a.las", "b.gpkg"], 1, "a.las: there is no such file or folder"),
    ("accuracy of a file that is not there", ["accuracy", "a.las"], 1, "a.las: there is no such file or folder"),
    ("review of a file that is not there", ["review", "a.las", "b.gpkg"], 1, "a.las: there is no such file or folder"),
    ("count that is no number", ["train", "a.las", "--model", "m", "--count", "many"], 2, "invalid int value"),
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
    ("whole number as a fraction", {"cell": 20.0, "threads": 1.0}),
    ("list as text", {"ignore": "7, 18"}),
    ("list as one number", {"ignore": 7}),
    ("empty list where none is meant", {"ignore": []}),
    ("unit named in capitals", {"horizontal_unit": "US-FT"}),
]


@pytest.mark.parametrize(("case", "options"), RIGHT, ids=[row[0] for row in RIGHT])
def test_right_after_all(cell, tmp_path, monkeypatch, cloud, case, options):
    monkeypatch.chdir(tmp_path)
    path = job(tmp_path, str(cloud), {"type": HAG, **options})
    cell("Options", case).runs(
        ["expand", path], "is taken: " + ", ".join(f"`{k}`: {v!r}" for k, v in options.items())
    )
