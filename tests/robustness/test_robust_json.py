"""Pipeline JSON in every odd form, and its parser's properties."""

from __future__ import annotations

import json
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robustness_kit import HAG, job

from pdal_stages.base.errors import StageError
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.expansion import expand
from pdal_stages.pipeline.json_source import parse_pipeline

STAGE = b'{"type": "filters.hag_minima"}'

#: bytes of the file, what the message must hold
REFUSED = {
    "empty file": (b"", ["the pipeline is empty"]),
    "a text": (b'"in.las"', ["must be a list or an object"]),
    "empty list": (b"[]", ["the pipeline has no stages"]),
    "object without 'pipeline'": (b'{"stages": []}', ["no list named 'pipeline'", "'stages'", 'Write {"pipeline"']),
    "trailing comma": (b"[\n" + STAGE + b",\n]", ["job.json, line", "none before a closing bracket"]),
    "missing comma": (b'[\n"a.las"\n"b.las"]', ["job.json, line 3", "Expecting ',' delimiter"]),
    "several roots": (b'["a.las"]\n["b.las"]', ["line 2", "Extra data", "one list or object"]),
    "Windows path without doubled backslashes": (b'["C:\\data\\in.las"]', ["line 1", "escape"]),
    "NaN": (b'[{"type": "filters.hag_minima", "cell": NaN}]', ["NaN is not a JSON number"]),
    "number beyond a double": (b'["a.las",\n{"type": "filters.range", "limits": 1e999}]', ["line 2", "float"]),
    "whole number of 5,000 digits": (b'[{"type": "filters.hag_minima", "cell": ' + b"9" * 5000 + b"}]", ["not valid JSON"]),
    "comment that does not end": (b'["a.las", /* b\n"c.las"]', ["line 1", "does not end"]),
    "half a surrogate pair": (b'["a.las",\n"\\ud800.las"]', ["line 2", "surrogates not allowed"]),
    "NUL in a name": (b'["a\\u0000.las", "b.las"]', ["line 1", "NUL"]),
    "a point cloud": (b"LASF\xff", ["a point cloud, not a pipeline"]),
    "Latin-1 text": ('["Gr\u00fcn.las"]'.encode("latin-1"), ["not UTF-8", "byte 4 is 0xfc", "Save it as UTF-8"]),
    "a LAS file as the pipeline": (b"LASF\x00\x00\xff\xfe" + b"\x00" * 300, ["not"]),
    "nested 100,000 deep": (b"[" * 100_000, ["not valid JSON"]),
    "a million opened comments": (b"[" + b"/*" * 1_000_001, ["does not end"]),
    "mistake in a stage that spans lines": (
        b'// one\n[\n"a.las", {"type": "filters.range",\n"limits": "Z[0:1]"}, /* x\n*/\n\n{"type": '
        b'"filters.hag_minima",\n"cell": 0}]',
        ["job.json, line 7:"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused(command, tmp_path, case):
    text, says = REFUSED[case]
    (tmp_path / "job.json").write_bytes(text)
    started = time.process_time()
    command.refused(["expand", tmp_path / "job.json"], *says)
    assert time.process_time() - started < 20  # linear in the text, whatever it is


GOOD = {
    "byte order mark": b'\xef\xbb\xbf["a.las", ' + STAGE + b"]",
    "CRLF line ends": b'[\r\n"a.las",\r\n' + STAGE + b"\r\n]\r\n",
    "comments of both kinds": b'// a\n[ /* b */ "a.las", // "c"\n' + STAGE + b"/* d\n */]",
    "comment marks inside texts": b'["http://a/b.las", {"type": "filters.range", "limits": "/* Z '
                                  b'*/"}, ' + STAGE + b"]",
    "non-ASCII names": '["Stra\u00dfe/\u6e2c\u91cf.las", '.encode() + STAGE + b"]",
    "object with other keys": b'{"name": "x", "pipeline": ["a.las", ' + STAGE + b'], "more": [1]}',
    "key 'pipeline' twice: the last counts": b'{"pipeline": 3, "pipeline": ["a.las", ' + STAGE + b"]}",
}  # fmt: skip


@pytest.mark.parametrize("case", GOOD)
def test_taken(command, tmp_path, case):
    (tmp_path / "job.json").write_bytes(GOOD[case])
    done = command.runs(["expand", tmp_path / "job.json", "-o", tmp_path / "plain.json"])
    plain = json.loads((tmp_path / "plain.json").read_text())
    assert not done.out and plain["pipeline"][-1]["type"] == "filters.python"


def test_files_that_cannot_be_read(command, tmp_path):
    command.refused(["pipeline", tmp_path / "nix.json"], "No such file")
    command.refused(["pipeline", tmp_path], "Is a directory")
    command.refused(["pipeline", "x" * 5000], "File name too long")
    text = b'[\n"a.las",\n{"type": "filters.hag_minima", "cell": 0}]'
    command.refused(
        command.process("expand", "--stdin", input=text),
        "standard input, line 3: filters.hag_minima",
    )


@pytest.mark.pdal
def test_names_and_spaces(command, tmp_path, cloud):
    folder = tmp_path / "Daten f\u00fcr \u6e2c\u91cf & 'co'"
    folder.mkdir()
    (folder / "in put.las").write_bytes(cloud.read_bytes())
    command.runs(["pipeline", job(folder, folder / "in put.las", HAG, folder / "o\u00fct [1].las")])
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


@settings(max_examples=30, deadline=None)
@given(st.lists(stages | values, max_size=5), st.booleans(), st.sampled_from([None, 0, 2]))
def test_any_json_is_expanded_or_refused(given_stages, as_object, indent):
    value = {"pipeline": given_stages} if as_object else given_stages
    try:
        source = parse_pipeline(json.dumps(value, indent=indent))
        assert source.stages == given_stages
        source.stages = pdal_env.with_types(source.stages)
        expanded = expand(source)
        assert json.loads(json.dumps(expanded.stages, allow_nan=False)) == expanded.stages
    except StageError:
        pass


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.text(max_size=10).filter(lambda s: "\0" not in s), min_size=1, max_size=5),
    st.data(),
)
def test_comments_between_change_nothing(texts, data):
    comment = st.sampled_from(["", " ", "\n", '// c " [ /*\n', '/* " // \n ] */', "/**/"])
    parts = (
        part for at, word in enumerate(texts) for part in (("," if at else "["), json.dumps(word))
    )
    read = parse_pipeline(
        "".join(data.draw(comment) + part for part in parts) + data.draw(comment) + "]"
    )
    assert read.stages == texts
    assert read.lines == sorted(read.lines)


def test_an_escape_that_is_written_out_is_a_text():
    assert parse_pipeline(json.dumps(["\\u0000", "\\\\u0000"])).stages == ["\\u0000", "\\\\u0000"]
    with pytest.raises(StageError, match="NUL"):
        parse_pipeline(json.dumps(["\\\0"]))
