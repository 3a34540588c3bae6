"""Options that every PDAL stage has and our stages answer before PDAL sees them: `option_file` and `where_merge`."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..base.errors import OptionError

_MERGE = ("auto", "true", "false")


def settled(stage: Mapping[str, Any]) -> dict[str, Any]:
    """A stage of ours with the options of its `option_file`; what the pipeline says itself goes first.

    Raises
    ------
    OptionError
        If the file cannot be read, or `where_merge` asks for what cannot be.
    """
    options = dict(stage)
    if "option_file" in options:
        path = options.pop("option_file")
        options = {**_read(path), **options}
    if "where_merge" in options:
        _check_merge(options.pop("where_merge"), "where" in options)
    return options


def _check_merge(value: Any, where: bool) -> None:
    word = str(value).strip().lower()
    if word not in _MERGE:
        raise OptionError("option 'where_merge' must be one of 'auto', 'true', 'false'", found=repr(value))
    if not where:
        raise OptionError("option 'where_merge' needs 'where'", cure="Leave it out, or give 'where'")
    if word == "false":
        raise OptionError(
            "option 'where_merge' cannot be false here: points outside 'where' stay beside the others, as neighbors",
            cure='Leave it out, and tell the points apart afterwards, e.g. with {"type": "filters.expression"}',
        )


def _read(path: Any) -> dict[str, Any]:
    """An option file as PDAL has them: a JSON object, or words ``--name=value``."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig").strip()
    except (OSError, ValueError, TypeError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise OptionError("the option file cannot be read", found=f"{str(path)[:200]!r}: {why}") from None
    try:
        if text.startswith("{"):
            found = json.loads(text)
        elif text.startswith("-"):
            found = _words(shlex.split(text))
        else:
            raise ValueError("neither a JSON object nor --name=value")
    except (ValueError, RecursionError) as error:
        raise OptionError("the option file cannot be understood", found=f"{path}: {error}") from None
    wired = {"type", "tag", "inputs"} & set(found)
    if wired:
        raise OptionError(
            "an option file sets options, not how stages are joined",
            found=f"{path}: {', '.join(sorted(wired))}",
        )
    return found


def _words(words: list[str]) -> dict[str, str]:
    found, waiting = {}, iter(words)
    for word in waiting:
        name, equals, value = word.partition("=")
        if not name.startswith("--") or len(name) < 3:
            raise ValueError(f"'{word}' does not begin with --name")
        value = value if equals else next(waiting, "")
        if not value:
            raise ValueError(f"'{word}' has no value")
        found[name[2:]] = value
    return found
