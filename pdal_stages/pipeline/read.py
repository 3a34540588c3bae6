"""Reading pipeline JSON as PDAL does, with errors that name the line."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import PipelineError


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
    """A file name that says no more than a path, as text, which every PDAL takes (from 2.9 on it may be an object)."""
    name = stage.get("filename") if isinstance(stage, dict) else None
    if isinstance(name, dict) and set(name) == {"path"} and isinstance(name["path"], str):
        return {**stage, "filename": name["path"]}
    return stage


def read_pipeline(source: str | Path | list | dict) -> PipelineSource:
    """A pipeline from a file name, JSON text, or Python lists and dicts.

    Raises
    ------
    PipelineError
        If the file cannot be read, is not JSON, or is not a pipeline.
    """
    if isinstance(source, Path) or (isinstance(source, str) and not _looks_like_json(source)):
        path = Path(source)
        try:
            data = path.read_bytes()
        except (OSError, ValueError) as error:
            raise PipelineError(
                "the pipeline file cannot be read", where=ascii(str(path)[:200])[1:-1], found=error
            ) from None
        return parse_pipeline(decode(data, str(path)), str(path))
    if isinstance(source, str):
        return parse_pipeline(source)
    stages = source.get("pipeline") if isinstance(source, dict) else source
    if not isinstance(stages, list):
        raise PipelineError("a pipeline is a list of stages, or an object with a list named 'pipeline'")
    return _checked(PipelineSource(stages, [0] * len(stages)))


def decode(data: bytes, name: str) -> str:
    """The text of a pipeline file, which is UTF-8, with or without a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
        raise PipelineError(
            "the pipeline file is not UTF-8 text",
            where=name,
            found="UTF-16" if wide else f"byte {error.start} is 0x{data[error.start]:02x}",
            cure="Save it as UTF-8",
        ) from None


def parse_pipeline(text: str, name: str = "") -> PipelineSource:
    """Parse pipeline JSON text; comments are allowed, as PDAL allows them."""
    clean = _without_comments(text.removeprefix("\ufeff"), name)
    if not clean.strip():
        raise PipelineError("the pipeline is empty", where=name or None)
    try:
        # parse_constant: NaN and Infinity are not JSON, and PDAL refuses them too.
        value = json.loads(clean, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise PipelineError(
            f"the pipeline is not valid JSON: {error.msg}",
            where=f"{name or 'pipeline'}, line {error.lineno}, column {error.colno}",
            found=repr(clean[max(0, error.pos - 20) : error.pos + 20].strip()),
            cure=_cure(clean, error),
        ) from None
    except (ValueError, RecursionError) as error:
        raise PipelineError(
            "the pipeline is not valid JSON", where=name or None, found=str(error)[:200]
        ) from None
    if isinstance(value, dict):
        if not isinstance(value.get("pipeline"), list):
            raise PipelineError(
                "the pipeline has no list named 'pipeline'",
                where=name or None,
                found=f"an object with {', '.join(map(repr, value)) or 'nothing in it'}"[:200],
                cure='Write {"pipeline": [...]}, or the list alone',
            )
        stages = value["pipeline"]
    elif isinstance(value, list):
        stages = value
    else:
        raise PipelineError(
            "the pipeline must be a list or an object", where=name or None, found=type(value).__name__
        )
    lines = _lines(clean, len(stages), isinstance(value, dict))
    return _checked(PipelineSource(stages, lines, name))


def _checked(source: PipelineSource) -> PipelineSource:
    if not source.stages:
        raise PipelineError("the pipeline has no stages", where=source.name or None)
    for index, stage in enumerate(source.stages):
        where = source.where(index)
        if not isinstance(stage, str | dict):
            raise PipelineError(
                "a stage is an object, or a file name", where=where, found=json.dumps(stage, default=str)[:80]
            )
        _check_values(stage, where)
        if not isinstance(stage, dict):
            continue
        for key, kinds, what in _SHAPES:
            value = stage.get(key, "")
            if not isinstance(value, kinds) or (
                isinstance(value, list) and not all(isinstance(v, str) for v in value)
            ):
                raise PipelineError(
                    f"a stage's '{key}' is {what}", where=where, found=json.dumps(value, default=str)[:80]
                )
    return source


#: What PDAL wants of the options that wire stages together.
_SHAPES: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("type", (str,), "text"),
    ("tag", (str,), "text"),
    ("inputs", (str, list), "a tag, or a list of tags"),
)


def _check_values(stage: Any, where: str) -> None:
    """Refuse what PDAL cannot be given: it takes UTF-8 without NUL, and numbers that a double holds."""
    try:
        text = json.dumps(stage, allow_nan=False, ensure_ascii=False, default=str)
        text.encode()
        if "\\u0000" in text:
            raise ValueError("a text holds a NUL character")
    except UnicodeEncodeError as error:
        found = ascii(error.object[error.start - 40 if error.start > 40 else 0 : error.end])
        cure = "If it is a file's name, rename the file"
        raise PipelineError("a text is not valid UTF-8", where=where, found=found, cure=cure) from None
    except (ValueError, RecursionError) as error:
        raise PipelineError("a stage holds what PDAL cannot be given", where=where, found=error) from None


def _looks_like_json(text: str) -> bool:
    start = text.lstrip("\ufeff \t\r\n")[:2]
    return start[:1] in ("[", "{") or start in ("//", "/*")


# The closing quote is optional, so that a match never fails: searching stays linear whatever the text.
_STRING = r'"[^"\\\n]*(?:\\.[^"\\\n]*)*"?'
_STRING_OR_COMMENT = re.compile(rf"{_STRING}|//|/\*")


def _without_comments(text: str, name: str = "") -> str:
    """Comments as spaces, so that places stay."""
    if "/" not in text:
        return text
    parts, at = [], 0
    while (match := _STRING_OR_COMMENT.search(text, at)) is not None:
        start, end = match.span()
        if match.group() == "//":
            end = text.find("\n", start)
            end = len(text) if end < 0 else end
        elif match.group() == "/*":
            end = text.find("*/", start + 2) + 2
            if end < 2:
                raise PipelineError(
                    "a comment that begins with /* does not end",
                    where=f"{name or 'pipeline'}, line {text.count(chr(10), 0, start) + 1}",
                    cure="Close it with */",
                )
        else:
            parts.append(text[at:end])
            at = end
            continue
        parts += [text[at:start], re.sub(r"[^\n]", " ", text[start:end])]
        at = end
    return "".join([*parts, text[at:]])


def _no_constant(word: str):
    raise ValueError(f"{word} is not a JSON number")


def _cure(text: str, error: json.JSONDecodeError) -> str | None:
    before = text[: error.pos].rstrip()
    after = text[error.pos :].lstrip()[:1]
    closing = after in ("]", "}")
    if (before.endswith(",") and (closing or after == ",")) or (closing and "trailing comma" in error.msg):
        return "Remove the comma before the closing bracket"
    if after == "'":
        return 'JSON wants double quotes: "text"'
    if error.msg == "Extra data":
        return "A pipeline is one list or object; remove what follows it"
    return None


_VISIBLE = re.compile(r"\S")


def _lines(text: str, count: int, is_object: bool) -> list[int]:
    """The line each stage begins on: walk the list item by item."""
    decoder = json.JSONDecoder(parse_constant=_no_constant)

    def skip(at: int) -> int:
        return len(text) if (found := _VISIBLE.search(text, at)) is None else found.start()

    at = skip(0)
    begin = at
    if is_object:
        at = skip(at + 1)
        begin = -1
        while text[at] != "}":
            key, at = decoder.raw_decode(text, at)
            at = skip(skip(at) + 1)
            if key == "pipeline":  # of equal keys the last counts, as in json.loads
                begin = at
            _, at = decoder.raw_decode(text, at)
            at = skip(at)
            if text[at] == ",":
                at = skip(at + 1)
    lines: list[int] = []
    at = skip(begin + 1)
    line, counted = 1, 0
    while len(lines) < count:
        line += text.count("\n", counted, at)
        counted = at
        lines.append(line)
        _, at = decoder.raw_decode(text, at)
        at = skip(skip(at) + 1)
    return lines
