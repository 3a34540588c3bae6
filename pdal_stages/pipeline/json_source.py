"""Read a pipeline as a user wrote it: JSON with comments, options set from outside, line numbers.

Comments are allowed, as PDAL allows them. On the command line, options of stages are set as in
PDAL: ``--stage.TAG.option=value`` and ``--filters.name.option=value``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.checks import refuse_constant, refuse_nested
from ..base.errors import OptionError, PipelineError, suggest
from ..base.json_types import StageJson
from ..stages.registry import refuse_removed

#: No pipeline file has as many bytes; devices, such as /dev/zero, have no end.
_MOST_BYTES = 1 << 26


@dataclass
class PipelineSource:
    """A parsed pipeline: its stages, and the line each begins on."""

    stages: list[Any]  #: objects or file names, as written
    lines: list[int]  #: one per stage; 0 where it did not come from text
    name: str = ""  #: the file, for messages; empty for text

    def __post_init__(self) -> None:
        """Write file names as text that are objects with only a path (PDAL 2.9)."""
        for number, stage in enumerate(self.stages):
            name = stage.get("filename") if isinstance(stage, dict) else None
            if isinstance(name, dict) and set(name) == {"path"} and isinstance(name["path"], str):
                self.stages[number] = {**stage, "filename": name["path"]}

    def where(self, index: int) -> str:
        """Return ``job.json, line 12`` or ``stage 3``."""
        if self.lines[index]:
            return f"{self.name or 'pipeline'}, line {self.lines[index]}"
        return f"stage {index + 1}"


def read_pipeline(source: str | Path | list | dict) -> PipelineSource:
    """Read a pipeline from a file name, JSON text, or Python lists, dicts, python-pdal stages."""
    if isinstance(source, list | dict):
        stages = [_written(stage) for stage in _list_of_stages(source, "")]
        return _checked(PipelineSource(list(stages), [0] * len(stages)))
    text = str(source)
    if text.lstrip("\ufeff \t\r\n")[:2].startswith(("[", "{", "//", "/*")):
        return parse_pipeline(text)
    try:
        with open(source, "rb") as file:
            data = file.read(_MOST_BYTES)
        if len(data) == _MOST_BYTES:
            raise OSError(f"{_MOST_BYTES >> 20} MB or more, too much for a pipeline")
    except (OSError, ValueError) as error:
        where = ascii(text[:200])[1:-1]
        raise PipelineError("the pipeline file cannot be read", where=where, found=error) from None
    return parse_pipeline(decode(data, text), text)


def _written(stage: Any) -> Any:
    """Return a stage of python-pdal as an object of JSON; others as they are."""
    options = getattr(stage, "options", None)
    return {"type": stage.type, **options} if isinstance(options, dict) else stage


def decode(data: bytes, name: str) -> str:
    """Return the text of a pipeline file: UTF-8, with or without a byte order mark."""
    if data.startswith(b"LASF"):
        cure = "Give a pipeline's JSON file; or classify the points: pdal-stages classify IN OUT"
        raise PipelineError("this is a point cloud, not a pipeline", where=name, cure=cure)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        what = "the pipeline file is not UTF-8 text"
        byte = f"byte {error.start} is 0x{data[error.start]:02x}"
        raise PipelineError(what, where=name, found=byte, cure="Save it as UTF-8") from None


def parse_pipeline(text: str, name: str = "") -> PipelineSource:
    """Parse pipeline JSON text; errors name the line."""
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
        what, reason = "the pipeline is not valid JSON", str(error)[:200]
        raise PipelineError(what, where=name or None, found=reason) from None
    stages = _list_of_stages(value, name)
    start = len(clean) - len(clean.lstrip())
    if isinstance(value, dict):
        inside = _item_positions(clean, start)
        keys = [_decoder.raw_decode(clean, at)[0] for at in inside[::2]]
        start = dict(zip(keys, inside[1::2], strict=True))["pipeline"]
    lines = [clean.count("\n", 0, at) + 1 for at in _item_positions(clean, start)]
    return _checked(PipelineSource(stages, lines, name))


def _list_of_stages(value: Any, name: str) -> list[Any]:
    """Return the stages of a pipeline: the list itself, or that named 'pipeline' in an object."""
    stages = value.get("pipeline") if isinstance(value, dict) else value
    if isinstance(stages, list):
        return stages
    what, kind = "must be a list or an object", type(value).__name__
    if isinstance(value, dict):
        what = "has no list named 'pipeline'"
        kind = f"an object with {', '.join(map(repr, value)) or 'nothing in it'}"[:200]
    cure = 'Write {"pipeline": [...]}, or the list alone'
    raise PipelineError(f"the pipeline {what}", where=name or None, found=kind, cure=cure)


def _item_positions(text: str, at: int) -> list[int]:
    """Return where the items of a list begin, or the keys and values of an object, in valid JSON.

    The opening bracket is at `at`.
    """
    positions: list[int] = []
    while True:
        while text[(at := at + 1)] in " \t\r\n,:":
            pass
        if text[at] in "]}":
            return positions
        positions.append(at)
        at = _decoder.raw_decode(text, at)[1] - 1


_decoder = json.JSONDecoder()


def _checked(source: PipelineSource) -> PipelineSource:
    """Refuse stages that are no objects or file names, or hold what PDAL cannot take."""
    if not source.stages:
        raise PipelineError("the pipeline has no stages", where=source.name or None)
    for index, stage in enumerate(source.stages):
        where = source.where(index)
        if not isinstance(stage, str | dict):
            value = json.dumps(stage, default=str)[:80]
            raise PipelineError("a stage is an object, or a file name", where=where, found=value)
        _check_values(stage, where)
        if isinstance(stage, dict):
            refuse_removed(str(stage.get("type", "")), where)
        for key in ("type", "tag", "inputs") if isinstance(stage, dict) else ():
            value = stage.get(key, "")  # type: ignore[union-attr]
            texts = value if key == "inputs" and isinstance(value, list) else [value]
            if not all(isinstance(text, str) for text in texts):
                kind = "a tag, or a list of tags" if key == "inputs" else "text"
                value = json.dumps(value, default=str)[:80]
                raise PipelineError(f"a stage's '{key}' is {kind}", where=where, found=value)
    return source


def _check_values(stage: Any, where: str) -> None:
    """Refuse values that PDAL cannot take: it needs UTF-8 without NUL, and finite numbers."""
    try:
        refuse_nested(stage)
        text = json.dumps(stage, allow_nan=False, ensure_ascii=False)
        text.encode()
        if "\\u0000" in text.replace("\\\\", ""):  # a backslash before it makes it a text
            raise ValueError("a text holds a NUL character")
    except UnicodeEncodeError as error:
        what, cure = "a text is not valid UTF-8", "If it is a file's name, rename the file"
        raise PipelineError(what, where=where, found=error, cure=cure) from None
    except (TypeError, ValueError, RecursionError) as error:
        what = "a stage holds a value that PDAL cannot take"
        raise PipelineError(what, where=where, found=error) from None


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


# ---- options set from outside --------------------------------------------------------------------

_FLAG = re.compile(
    r"--(?:stage\.(?P<tag>[^.=]+)|(?P<type>(?:readers|filters|writers)\.\w+))\.(?P<option>\w+)"
    r"(?:=(?P<value>.*))?",
    re.DOTALL,
)


@dataclass(frozen=True)
class Override:
    """An option set from outside: for stages with a tag, or of a type."""

    selector: str
    by_tag: bool
    option: str
    value: str

    @property
    def flag(self) -> str:
        """The option as it is written on the command line."""
        return f"--{'stage.' if self.by_tag else ''}{self.selector}.{self.option}={self.value}"


def parse_overrides(arguments: Iterable[str]) -> tuple[list[Override], list[str]]:
    """Return the overrides among command-line arguments, and the other arguments.

    The value follows after ``=`` or as the next argument.
    """
    overrides: list[Override] = []
    others: list[str] = []
    words = iter(arguments)
    for word in words:
        match = _FLAG.fullmatch(word)
        if match is None:
            others.append(word)
            continue
        value = next(words, "--") if match["value"] is None else match["value"]
        if match["value"] is None and value.startswith("--"):
            raise OptionError(f"'{word}' has no value", cure=f"Write {word}=VALUE")
        by_tag = match["tag"] is not None
        overrides.append(Override(match["tag"] or match["type"], by_tag, match["option"], value))
    return overrides, others


def apply_overrides(stages: list[Any], overrides: Iterable[Override]) -> list[Any]:
    """Return the stages with overrides applied; an override that fits no stage is an error."""
    out = [dict(s) if isinstance(s, dict) else s for s in stages]
    for override in overrides:
        key = "tag" if override.by_tag else "type"
        hits = [s for s in out if isinstance(s, dict) and str(s.get(key, "")) == override.selector]
        if not hits:
            known = sorted({str(s[key]) for s in out if isinstance(s, dict) and key in s})
            raise OptionError(
                f"no stage of the pipeline has the {key} '{override.selector}'",
                found=override.flag,
                cure=f"{suggest(override.selector, known)}The pipeline's {key}s: "
                f"{', '.join(known) or 'none'}",
            )
        for stage in hits:
            stage[override.option] = override.value
    return out


def overridden(stage: StageJson, overrides: Iterable[Override]) -> StageJson:
    """Return a stage with the overrides of its type."""
    of_type = [o for o in overrides if not o.by_tag and o.selector == stage["type"]]
    return apply_overrides([stage], of_type)[0]
