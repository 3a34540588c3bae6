"""What commands and stages take, as JSON, for programs that make dialogs of it (the QGIS plugin)."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import Any

from ..base.asprs import NAMES, class_color
from ..base.version import __version__
from ..classifier.modelfile import shipped
from ..stages import registry

#: Changes where a reader of the JSON must.
FORMAT = 1
_TYPES = {int: "integer", float: "number"}


def dialogs(commands: Mapping[str, argparse.ArgumentParser]) -> str:
    """Commands with their arguments, stages with their options, shipped models, classes with their colors.

    An argument has ``name``, ``flag`` (empty for one without), ``kind`` (``number``, ``integer``, ``boolean``, ``string``),
    ``help``, ``default``, ``choices``, ``required``, ``many`` (takes several, or may be repeated) and ``value`` (what usage
    calls its value).
    """
    answer = {
        "format": FORMAT,
        "version": __version__,
        "models": list(shipped()),
        "classes": {str(code): {"name": name, "color": class_color(code)} for code, name in NAMES.items()},
        "commands": {
            name: {"help": parser.description, "arguments": [_argument(one) for one in _arguments(parser)]}
            for name, parser in commands.items()
        },
        "stages": {
            name: {"help": stage.summary, "options": [_option(stage, one) for one in stage.all_options()]}
            for name, stage in registry.stages().items()
        },
    }
    return json.dumps(answer, indent=1) + "\n"


def _arguments(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [one for one in parser._actions if one.help != argparse.SUPPRESS and one.dest != "help"]


def _argument(action: argparse.Action) -> dict[str, Any]:
    switch = action.nargs == 0
    of_choices = type(next(iter(action.choices))) if action.choices else None
    kind = "boolean" if switch else _TYPES.get(action.type or of_choices, "string")  # type: ignore[arg-type]
    default = bool(action.default) if switch else action.default
    return {
        "name": action.dest,
        "flag": max(action.option_strings, key=len, default="") if not switch else action.option_strings[0],
        "off": next((one for one in action.option_strings if one.startswith("--no-")), ""),
        "kind": kind,
        "help": (action.help or "").replace("%%", "%"),
        "default": default if isinstance(default, bool | int | float | str) else None,
        "choices": list(action.choices or ()),
        "required": bool(action.required),
        "many": action.nargs in ("+", "*") or isinstance(action, argparse._AppendAction),
        "value": action.metavar if isinstance(action.metavar, str) else "",
    }


def _option(stage: Any, option: Any) -> dict[str, Any]:
    default = option.default
    return {
        "name": option.name,
        "kind": option.kind,
        "help": stage.where_help or option.help if option.name == "where" else option.help,
        "default": ",".join(map(str, default)) if isinstance(default, tuple) else default,
        "choices": list(option.choices),
        "minimum": option.minimum,
        "maximum": option.maximum,
        "exclusive": option.exclusive,
        "unit": option.unit,
        "required": option.required,
    }
