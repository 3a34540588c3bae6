"""Read a pipeline as a user wrote it: JSON with comments, as PDAL reads it, and errors that name
the line.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.checks import refuse_constant
from ..base.errors import PipelineError

#: More bytes than any pipeline file has.
_LARGEST = 1 << 26


@dataclass
class PipelineSource:
    """A parsed pipeline: its stages, and the line each begins on."""

    stages: list[Any]  #: objects or file names, as written
    lines: list[int]  #: one per stage; 0 where it did not come from text
    name: str = ""  #: the file, for messages; empty for text

    def __post_init__(self) -> None:
        self.stages = [_with_plain_name(stage) for stage in self.stages]

    def where(self, index: int) -> str:
        """``job.json, line 12`` or ``stage 3``."""
        if self.lines[index]:
            return f"{self.name or 'pipeline'}, line {self.lines[index]}"
        return f"stage {index + 1}"


def _with_plain_name(stage: Any) -> Any:
    """A file name given as an object with only a path (PDAL 2.9), as text, which every PDAL
    takes.
    """
    name = stage.get("filename") if isinstance(stage, dict) else None
    if isinstance(name, dict) and set(name) == {"path"} and isinstance(name["path"], str):
        return {**stage, "filename": name["path"]}
    return stage


def read_pipeline(source: str | Path | list | dict) -> PipelineSource:
    """A pipeline from a file name, JSON text, or Python lists and dicts."""
    if isinstance(source, list | dict):
        stages = source.get("pipeline") if isinstance(source, dict) else source
        if not isinstance(stages, list):
            raise PipelineError(
                "a pipeline is a list of stages, or an object with a list named 'pipeline'"
            )
        return _checked(PipelineSource(stages, [0] * len(stages)))
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n")[:2].startswith(
        ("[", "{", "//", "/*")
    ):
        return parse_pipeline(source)
    try:
        data = _content(Path(source))
    except (OSError, ValueError) as error:
        where = ascii(str(source)[:200])[1:-1]
        raise PipelineError("the pipeline file cannot be read", where=where, found=error) from None
    return parse_pipeline(decode(data, str(source)), str(source))


def _content(path: Path) -> bytes:
    """What a file or pipe holds; devices have no end."""
    with open(path, "rb") as file:
        if len(data := file.read(_LARGEST)) == _LARGEST:
            raise OSError(f"{_LARGEST >> 20} MB or more, too much for a pipeline")
    return data


def decode(data: bytes, name: str) -> str:
    """The text of a pipeline file, which is UTF-8, with or without a byte order mark."""
    if data.startswith(b"LASF"):
        cure = (
            "Give the JSON file of a pipeline; or classify the points: pdal-stages classify IN OUT"
        )
        raise PipelineError("this is a point cloud, not a pipeline", where=name, cure=cure)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        what, found = (
            "the pipeline file is not UTF-8 text",
            f"byte {error.start} is 0x{data[error.start]:02x}",
        )
        raise PipelineError(what, where=name, found=found, cure="Save it as UTF-8") from None


def parse_pipeline(text: str, name: str = "") -> PipelineSource:
    """Parse pipeline JSON text; comments are allowed, as PDAL allows them."""
    clean = _without_comments(text.removeprefix("\ufeff"), name)
    if not clean.strip():
        raise PipelineError("the pipeline is empty", where=name or None)
    try:
        value = json.loads(clean, parse_constant=refuse_constant)  # as PDAL does
    except json.JSONDecodeError as error:
        raise PipelineError(
            f"the pipeline is not valid JSON: {error.msg}",
            where=f"{name or 'pipeline'}, line {error.lineno}, column {error.colno}",
            found=repr(clean[max(0, error.pos - 20) : error.pos + 20].strip()),
            cure="JSON is one list or object, with double quotes, a comma between values, and none "
            "before a closing bracket",
        ) from None
    except (ValueError, RecursionError) as error:
        found = str(error)[:200]
        raise PipelineError(
            "the pipeline is not valid JSON", where=name or None, found=found
        ) from None
    stages = value.get("pipeline") if isinstance(value, dict) else value
    if not isinstance(stages, list):
        what, found = "must be a list or an object", type(value).__name__
        if isinstance(value, dict):
            what = "has no list named 'pipeline'"
            found = f"an object with {', '.join(map(repr, value)) or 'nothing in it'}"[:200]
        cure = 'Write {"pipeline": [...]}, or the list alone'
        raise PipelineError(f"the pipeline {what}", where=name or None, found=found, cure=cure)
    start = len(clean) - len(clean.lstrip())
    if isinstance(value, dict):
        inside = _places(clean, start)
        keys = [_decoder.raw_decode(clean, at)[0] for at in inside[::2]]
        start = dict(zip(keys, inside[1::2], strict=True))["pipeline"]
    lines = [clean.count("\n", 0, at) + 1 for at in _places(clean, start)]
    return _checked(PipelineSource(stages, lines, name))


def _places(text: str, at: int) -> list[int]:
    """Where the items of a list begin, or the keys and values of an object, whose bracket is there;
    it is valid JSON.
    """
    places: list[int] = []
    while True:
        while text[(at := at + 1)] in " \t\r\n,:":
            pass
        if text[at] in "]}":
            return places
        places.append(at)
        at = _decoder.raw_decode(text, at)[1] - 1


_decoder = json.JSONDecoder()


#: Types of the options that connect stages.
_SHAPES: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("type", (str,), "text"),
    ("tag", (str,), "text"),
    ("inputs", (str, list), "a tag, or a list of tags"),
)


def _checked(source: PipelineSource) -> PipelineSource:
    if not source.stages:
        raise PipelineError("the pipeline has no stages", where=source.name or None)
    for index, stage in enumerate(source.stages):
        where = source.where(index)
        if not isinstance(stage, str | dict):
            found = json.dumps(stage, default=str)[:80]
            raise PipelineError("a stage is an object, or a file name", where=where, found=found)
        _check_values(stage, where)
        for key, kinds, what in _SHAPES if isinstance(stage, dict) else ():
            value = stage.get(key, "")  # type: ignore[union-attr]
            tags = value if isinstance(value, list) else []
            if not isinstance(value, kinds) or not all(isinstance(tag, str) for tag in tags):
                found = json.dumps(value, default=str)[:80]
                raise PipelineError(f"a stage's '{key}' is {what}", where=where, found=found)
    return source


def _check_values(stage: Any, where: str) -> None:
    """Refuse values that PDAL cannot take: it needs UTF-8 without NUL, and finite numbers."""
    try:
        text = json.dumps(stage, allow_nan=False, ensure_ascii=False)
        text.encode()
        if "\\u0000" in text.replace("\\\\", ""):  # a backslash before it makes it a text
            raise ValueError("a text holds a NUL character")
    except UnicodeEncodeError as error:
        found = ascii(error.object[max(0, error.start - 40) : error.end])
        cure = "If it is a file's name, rename the file"
        raise PipelineError(
            "a text is not valid UTF-8", where=where, found=found, cure=cure
        ) from None
    except (TypeError, ValueError, RecursionError) as error:
        raise PipelineError(
            "a stage holds a value that PDAL cannot take", where=where, found=error
        ) from None


# The closing quote is optional, so that a match never fails: searching stays linear whatever the
# text.
_STRING_OR_COMMENT = re.compile(r'"[^"\\\n]*(?:\\.[^"\\\n]*)*"?|//[^\n]*|/\*(?s:.*?)(\*/|\Z)')


def _without_comments(text: str, name: str) -> str:
    """Replace comments by spaces, so that line numbers stay."""

    def blank(match: re.Match[str]) -> str:
        if match[0][0] == '"':
            return match[0]
        if match[1] == "":
            where = f"{name or 'pipeline'}, line {text.count(chr(10), 0, match.start()) + 1}"
            what = "a comment that begins with /* does not end"
            raise PipelineError(what, where=where, cure="Close it with */")
        return re.sub(r"[^\n]", " ", match[0])

    return _STRING_OR_COMMENT.sub(blank, text)
