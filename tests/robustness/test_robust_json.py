"""Pipeline JSON in every odd form, its parser's properties, and its overrides."""

from __future__ import annotations

import json
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robustness_kit import job

from pdal_stages.base.errors import PipelineError, StageError
from pdal_stages.pipeline.lowering import lower
from pdal_stages.pipeline.read import parse_pipeline

STAGE = b'{"type": "filters.hag_minima"}'

#: case, bytes of the file, what the message must hold
REFUSED = [
    ("empty file", b"", ["the pipeline is empty"]),
    ("null", b"null", ["must be a list or an object", "NoneType"]),
    ("a text", b'"in.las"', ["must be a list or an object"]),
    ("empty list", b"[]", ["the pipeline has no stages"]),
    ("object without 'pipeline'", b'{"stages": []}', ["no list named 'pipeline'", "'stages'", 'Write {"pipeline"']),
    ("trailing comma in the list", b"[\n" + STAGE + b",\n]", ["job.json, line", "Remove the comma"]),
    ("trailing comma in a stage", b'[\n{"type": "filters.hag_minima",\n}]', ["job.json, line", "Remove the comma"]),
    ("missing comma", b'[\n"a.las"\n"b.las"]', ["job.json, line 3", "Expecting ',' delimiter"]),
    ("several roots", b'["a.las"]\n["b.las"]', ["line 2", "Extra data", "one list or object"]),
    ("cut in the middle", b'["a.las", {"type": "filt', ["job.json, line 1"]),
    ("Windows path without doubled backslashes", b'["C:\\data\\in.las"]', ["line 1", "escape"]),
    ("NaN", b'[{"type": "filters.hag_minima", "cell": NaN}]', ["NaN is not a JSON number"]),
    ("number too large for a double in JSON", b'["a.las",\n{"type": "filters.range", "limits": 1e999}]', ["line 2", "float"]),
    ("whole number of 5,000 digits", b'[{"type": "filters.hag_minima", "cell": ' + b"9" * 5000 + b"}]", ["not valid JSON"]),
    ("comment that does not end", b'["a.las", /* b\n"c.las"]', ["line 1", "does not end"]),
    ("half a surrogate pair", b'["a.las",\n"\\ud800.las"]', ["line 2", "not valid UTF-8"]),
    ("NUL in a name", b'["a\\u0000.las", "b.las"]', ["line 1", "NUL"]),
    ("Latin-1 text", '["Gr\u00fcn.las"]'.encode("latin-1"), ["not UTF-8", "byte 4 is 0xfc", "Save it as UTF-8"]),
    ("UTF-16", '["a.las"]'.encode("utf-16"), ["not UTF-8", "UTF-16", "Save it as UTF-8"]),
    ("a LAS file as the pipeline", b"LASF\x00\x00\xff\xfe" + b"\x00" * 300, ["not"]),
    ("nested 100,000 deep", b"[" * 100_000, ["not valid JSON"]),
    ("a million opened comments", b"[" + b"/*" * 1_000_001, ["does not end"]),
]  # fmt: skip


@pytest.mark.parametrize(("case", "text", "says"), REFUSED, ids=[row[0] for row in REFUSED])
def test_refused(cell, tmp_path, case, text, says):
    path = tmp_path / "job.json"
    path.write_bytes(text)
    started = time.process_time()
    cell("Pipeline JSON", case).refused(["expand", path], *says)
    assert time.process_time() - started < 20  # linear in the text, whatever it is


GOOD = [
    ("byte order mark", b'\xef\xbb\xbf["a.las", ' + STAGE + b"]"),
    ("CRLF line ends", b'[\r\n"a.las",\r\n' + STAGE + b"\r\n]\r\n"),
    ("comments of both kinds", b'// a\n[ /* b */ "a.las", // "c"\n' + STAGE + b"/* d\n */]"),
    ("comment marks inside texts", b'["http://a/b.las", {"type": "filters.range", "limits": "/* Z */"}, ' + STAGE + b"]"),
    ("non-ASCII names", '["Stra\u00dfe/\u6e2c\u91cf.las", '.encode() + STAGE + b"]"),
    ("object with other keys", b'{"name": "x", "pipeline": ["a.las", ' + STAGE + b'], "more": [1]}'),
    ("key 'pipeline' twice: the last counts", b'{"pipeline": 3, "pipeline": ["a.las", ' + STAGE + b"]}"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "text"), GOOD, ids=[row[0] for row in GOOD])
def test_taken(cell, tmp_path, case, text):
    path = tmp_path / "job.json"
    path.write_bytes(text)
    done = cell("Pipeline JSON", case).runs(
        ["expand", path, "-o", tmp_path / "plain.json"], "is read as PDAL reads it"
    )
    plain = json.loads((tmp_path / "plain.json").read_text())
    assert not done.out and plain["pipeline"][-1]["type"] == "filters.python"


def test_files_that_cannot_be_read(cell, tmp_path, capfd):
    cell("Pipeline JSON", "file that is not there").refused(
        ["pipeline", tmp_path / "nix.json"], "No such file"
    )
    cell("Pipeline JSON", "folder for a file").refused(["pipeline", tmp_path], "Is a directory")
    cell("Pipeline JSON", "file name of 5,000 characters").refused(
        ["pipeline", "x" * 5000], "File name too long"
    )


def test_standard_input(cell):
    it = cell("Pipeline JSON", "standard input that is not UTF-8")
    it.refused(it.process("expand", "--stdin", input=b'["\xff"]'), "standard input: ", "not UTF-8")
    it = cell("Pipeline JSON", "empty standard input")
    it.refused(it.process("expand", "--stdin", input=b""), "the pipeline is empty")
    it = cell("Pipeline JSON", "mistake on standard input")
    text = b'[\n"a.las",\n{"type": "filters.hag_minima", "cell": 0}]'
    it.refused(it.process("expand", "--stdin", input=text), "standard input, line 3: filters.hag_minima")


def test_the_line_is_the_stages(cell, tmp_path):
    lines = ["// one", "[", '"a.las", {"type": "filters.range",', '"limits": "Z[0:1]"}, /* x', "*/", "",
             '{"type": "filters.hag_minima",', '"cell": 0}]']  # fmt: skip
    path = tmp_path / "job.json"
    path.write_text("\n".join(lines))
    cell("Pipeline JSON", "mistake in a stage that spans lines").refused(
        ["expand", path], "job.json, line 7:"
    )


def test_names_and_spaces(cell, tmp_path, cloud):
    folder = tmp_path / "Daten f\u00fcr \u6e2c\u91cf & 'co'"
    folder.mkdir()
    source = folder / "in put.las"
    source.write_bytes(cloud.read_bytes())
    path = job(folder, str(source), {"type": "filters.hag_minima"}, str(folder / "o\u00fct [1].las"))
    cell("Environment", "spaces, quotes and non-ASCII characters in paths").runs(
        ["pipeline", path], "the file is written"
    )
    assert (folder / "o\u00fct [1].las").stat().st_size > 1000


# ---- properties ------------------------------------------------------------------------------------------

values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**6), 10**6) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip
names = st.sampled_from(
    ["type", "tag", "inputs", "filename", "cell", "where", "neighborhoods", "classes", "x"]
)
types = st.sampled_from(["filters.hag_minima", "filters.multiscalefeatures", "writers.classifiermodel",
                         "filters.accuracy", "filters.range", "readers.las", "writers.las", ""])  # fmt: skip
stages = st.builds(
    lambda kind, rest: {"type": kind, **rest}, types, st.dictionaries(names, values, max_size=4)
) | st.text(max_size=10)


@settings(max_examples=150, deadline=None)
@given(st.lists(stages | values, max_size=5), st.booleans(), st.sampled_from([None, 0, 2]))
def test_any_json_is_lowered_or_refused(given_stages, as_object, indent):
    value = {"pipeline": given_stages} if as_object else given_stages
    try:
        source = parse_pipeline(json.dumps(value, indent=indent))
        assert source.stages == given_stages
        lowered = lower(source)
        assert json.loads(json.dumps(lowered.stages, allow_nan=False)) == lowered.stages
    except StageError:
        pass


@settings(max_examples=100, deadline=None)
@given(st.lists(st.text(max_size=10).filter(lambda s: "\0" not in s), min_size=1, max_size=5), st.data())
def test_comments_between_change_nothing(texts, data):
    comment = st.sampled_from(["", " ", "\n", '// c " [ /*\n', '/* " // \n ] */', "/**/"])
    text = "".join(
        data.draw(comment) + part
        for at, word in enumerate(texts)
        for part in (("," if at else "["), json.dumps(word))
    )
    try:
        read = parse_pipeline(text + data.draw(comment) + "]")
    except PipelineError as error:  # a bare number or list is no stage, but every text is one
        raise AssertionError(str(error)) from error
    assert read.stages == texts
    assert read.lines == sorted(read.lines)
