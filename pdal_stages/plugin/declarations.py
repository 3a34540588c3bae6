"""The stages' declarations as the C++ header that the plugin is compiled with."""

from __future__ import annotations

import hashlib
import json

from ..base.version import __version__
from ..stages.base import Stage, stage_types
from ..stages.options import Option

#: Kind of option -> how PDAL's parser takes it; all else as text, which Python parses.
_KINDS = {
    "number": "Number",
    "integer": "Integer",
    "boolean": "Boolean",
    **dict.fromkeys(("list", "numbers", "bands", "codes", "selection"), "List"),
}

_HEADER = """\
// Written by pdal_stages from its stages' declarations.
#pragma once

#include <cstddef>

namespace pdal_stages
{{
namespace declared
{{

constexpr const char *VERSION = {version};

enum class Kind {{ Number, Integer, Boolean, List, Text }};

struct Option
{{
    const char *name;
    Kind kind;
    bool hasDefault;
    double number;
    const char *text;
    const char *help;
}};

struct Stage
{{
    const char *type;
    const char *digest;
    const char *summary;
    const char *link;
    const Option *options;
    std::size_t count;
}};

{options}

const Stage STAGES[] = {{
{stages}
}};
constexpr std::size_t COUNT = {count};

}} // namespace declared
}} // namespace pdal_stages
"""


def header() -> str:
    """The text of ``declarations.hpp``."""
    options, stages = [], []
    for number, kind in enumerate(stage_types().values()):
        name = f"OPTIONS_{number}"
        options.append(f"const Option {name}[] = {{{_options(kind)}}};")
        texts = (kind.type, digest(kind), kind.summary, f"pdal-stages options {kind.type}")
        stages.append(
            f"    {{ {', '.join(map(json.dumps, texts))}, {name}, sizeof({name}) / sizeof(Option) }},"
        )
    return _HEADER.format(
        version=json.dumps(__version__),
        options="\n".join(options),
        stages="\n".join(stages),
        count=len(stages),
    )


def digest(kind: type[Stage]) -> str:
    """Changes with any option, default or help of a stage that the plugin holds."""
    return hashlib.sha256(f"{kind.type} {kind.summary}{_options(kind)}".encode()).hexdigest()[:16]


def _options(kind: type[Stage]) -> str:
    lines = [""]
    for option in kind.all_options():
        if option.name == "where" and kind.type.startswith("filters."):
            continue  # PDAL's filters have it by themselves, writers of older PDAL not
        default, given = option.default, option.default not in (None, "", ())
        as_number = given and option.kind in ("number", "integer", "boolean")
        text = (
            ""
            if as_number or not given
            else ",".join(map(str, default))
            if isinstance(default, tuple)
            else str(default)
        )
        fields = [
            json.dumps(option.name),
            f"Kind::{_KINDS.get(option.kind, 'Text')}",
            str(bool(given)).lower(),
            repr(float(default) if as_number else 0.0),
            json.dumps(text),
            json.dumps(_help(kind, option)),
        ]
        lines.append(f"    {{ {', '.join(fields)} }},")
    return "\n".join([*lines, ""])


def _help(kind: type[Stage], option: Option) -> str:
    text = kind.where_help or option.help if option.name == "where" else option.help
    if option.choices:
        text += f" (one of: {', '.join(map(str, option.choices))})"
    if option.unit:
        text += f" [{option.unit}]"
    return f"{text} (required)" if option.required else text
