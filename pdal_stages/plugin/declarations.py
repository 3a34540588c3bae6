"""The declarations of our stages as a C++ header for the plugin."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

from ..base.options import Option
from ..base.version import __version__
from ..pipeline import pdal as pdal_env
from ..pipeline.expansion import SPLITS
from ..stages.base import Stage
from ..stages.registry import stage_types

#: Kind of option -> its type for PDAL's parser; others are text, which Python parses.
_KINDS = {
    "number": "Number",
    "integer": "Integer",
    "boolean": "Boolean",
    **dict.fromkeys(("list", "numbers", "codes", "selection"), "List"),
}


def header() -> str:
    """Return the text of ``declarations.hpp``, which ``stage.cpp`` includes."""
    options, stages = [], []
    for number, kind in enumerate(stage_types().values()):
        name = f"OPTIONS_{number}"
        lines = [f"    {{ {', '.join(fields)} }}," for fields in _fields(kind)]
        options += [f"const Option {name}[] = {{", *lines, "};"]
        texts = (kind.type, digest(kind), kind.summary, f"pdal-stages options {kind.type}")
        gathers = str(kind.needs_all_points()).lower()
        shown = ", ".join(map(json.dumps, texts))
        stages.append(f"    {{ {shown}, {name}, sizeof({name}) / sizeof(Option), {gathers} }},")
    version = f"constexpr const char *VERSION = {json.dumps(__version__)};"
    names = ", ".join(map(json.dumps, sorted({"filters.merge", *SPLITS})))
    not_gathered = (
        "// Stages after which views stay as they are: one, or as many as the user wants.\n"
        f"const std::set<std::string> NOT_GATHERED_AFTER {{ {names} }};"
    )
    same_version = " && ".join(
        f"PDAL_VERSION_{part} == {number}"
        for part, number in zip(("MAJOR", "MINOR", "PATCH"), pdal_env.version(), strict=True)
    )
    check = f'static_assert({same_version}, "PDAL\'s headers and library differ in their version");'
    return "\n".join(
        [check, version, not_gathered, *options, "const Stage STAGES[] = {", *stages, "};", ""]
    )


def digest(kind: type[Stage]) -> str:
    """Return a digest of what PDAL sees of a stage: names, types and defaults of options."""
    gathers = kind.needs_all_points()
    held = f"{kind.type} {gathers} {[fields[:-1] for fields in _fields(kind)]}"
    return hashlib.sha256(held.encode()).hexdigest()[:16]


def _fields(kind: type[Stage]) -> Iterator[list[str]]:
    """Yield the fields of each option, as C++ text; the help is the last one."""
    for option in kind.all_options():
        if option.name == "where" and kind.type.startswith("filters."):
            continue  # PDAL's filters have it by themselves, writers of older PDAL not
        text = option.typed_default
        as_number = text and option.kind in ("number", "integer", "boolean")
        yield [
            json.dumps(option.name),
            f"Kind::{_KINDS.get(option.kind, 'Text')}",
            str(bool(text)).lower(),
            repr(float(option.default) if as_number else 0.0),
            json.dumps("" if as_number else text),
            json.dumps(_help(option)),
        ]


def _help(option: Option) -> str:
    """Return an option's help with its choices and unit."""
    text = option.help
    if option.choices:
        text += f" (one of: {', '.join(map(str, option.choices))})"
    if option.unit:
        text += f" [{option.unit}]"
    return f"{text} (required)" if option.required else text
