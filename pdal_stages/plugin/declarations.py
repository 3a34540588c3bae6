"""The stages' declarations as the C++ header that the plugin is compiled with."""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path

from ..base.version import __version__
from ..stages import registry
from ..stages.base import Stage
from ..stages.options import Option

#: Options that every PDAL filter declares by itself.
OF_PDAL = ("where",)
#: Kind of option -> how PDAL's parser takes it; all else as text, which Python parses.
_KINDS = {"number": "Number", "integer": "Integer", "boolean": "Boolean"}
_LISTS = ("list", "codes", "selection")

_HEADER = """\
// Written by pdal_stages {version} from its stages' declarations.
#pragma once

#include <cstddef>

namespace pdal_stages
{{
namespace declared
{{

constexpr const char *VERSION = {version_text};
constexpr const char *DIGEST = "{digest}";

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
    return _HEADER.format(
        version=__version__,
        version_text=_text(__version__),
        digest=digest(),
        options="\n".join(_options(n, kind) for n, kind in enumerate(registry.stages().values())),
        stages=_stages(),
        count=len(registry.stages()),
    )


def write(folder: Path) -> None:
    """Write ``declarations.hpp``, and ``stages.txt`` with a type a line, for a compiler."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "declarations.hpp").write_text(header())
    (folder / "stages.txt").write_text("".join(f"{name}\n" for name in registry.stages()))


@cache
def digest() -> str:
    """Changes with any stage, option, default or help that the plugin holds."""
    stages = [_options(n, kind) for n, kind in enumerate(registry.stages().values())]
    return hashlib.sha256("\n".join([*stages, _stages()]).encode()).hexdigest()[:16]


def native_options(kind: type[Stage]) -> list[Option]:
    """A stage's options that the plugin declares; writers of older PDAL have no `where`, so ours declares it."""
    return [o for o in kind.all_options() if o.name not in OF_PDAL or kind.type.startswith("writers.")]


def is_list(option: Option) -> bool:
    """Whether PDAL takes several values for an option."""
    return option.kind in _LISTS


def _options(number: int, kind: type[Stage]) -> str:
    lines = [f"const Option OPTIONS_{number}[] = {{  // {kind.type}"]
    for option in native_options(kind):
        default, value, text = option.default, 0.0, ""
        given = default not in (None, "", ())
        if option.kind in _KINDS and given:
            value = float(default)
        elif given:
            text = ",".join(map(str, default)) if isinstance(default, tuple) else str(default)
        fields = [
            _text(option.name),
            f"Kind::{_KINDS.get(option.kind, 'List' if is_list(option) else 'Text')}",
            str(bool(given)).lower(),
            repr(value),
            _text(text),
            _text(_help(kind, option)),
        ]
        lines.append(f"    {{ {', '.join(fields)} }},")
    return "\n".join([*lines, "};\n"])


def _stages() -> str:
    return "\n".join(
        f"    {{ {_text(kind.type)}, {_text(kind.summary)}, {_text('pdal-stages options ' + kind.type)}, "
        f"OPTIONS_{number}, sizeof(OPTIONS_{number}) / sizeof(Option) }},"
        for number, kind in enumerate(registry.stages().values())
    )


def _help(kind: type[Stage], option: Option) -> str:
    text = kind.where_help or option.help if option.name == "where" else option.help
    if option.choices:
        text += f" (one of: {', '.join(map(str, option.choices))})"
    if option.unit:
        text += f" [{option.unit}]"
    return f"{text} (required)" if option.required else text


def _text(text: str) -> str:
    """A C++ string literal of plain ASCII: what is beyond it stands as the bytes of its UTF-8."""
    out = []
    for byte in text.encode():
        character = chr(byte)
        if character in '"\\?':
            out.append(f"\\{character}")
        elif 32 <= byte < 127:
            out.append(character)
        else:
            out.append(f"\\{byte:03o}")
    return '"' + "".join(out) + '"'


if __name__ == "__main__":  # CMake
    write(Path(sys.argv[1]))
