"""Extra dimensions of LAS files: what a file says of each, beside its name and type (LAS 1.4 R15, table 24).

PDAL writes its own words for dimensions that it knows and none for others, whatever the input said.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .las import records_of

#: Bytes of an entry, and where in it the name and the description are; both are texts of at most 32 bytes.
_ENTRY, _NAME, _DESCRIPTION = 192, slice(4, 36), slice(160, 192)
#: Types by number, 1 to 10, in PDAL's words.
_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float", "double")
_SCALE, _OFFSET = 0x08, 0x10


class _Entry(NamedTuple):
    place: int  #: in the file
    name: str
    type: str  #: empty for what is not a number
    description: bytes
    scaled: bool


def _entries(path: str | os.PathLike, later: bool = False) -> Iterator[_Entry]:
    """What the file's one record of them says, or what `later` ones say, which PDAL passes over."""
    described = [(r, data) for r, data in records_of(path, b"LASF_Spec") if r.number == 4]
    for record, data in described[1:] if later else described[:1]:
        for start in range(0, len(data) - _ENTRY + 1, _ENTRY):
            entry = data[start : start + _ENTRY]
            kind, options = entry[2], entry[3]
            name = _text(entry[_NAME]).decode("utf-8", "replace")
            known = _TYPES[kind - 1] if 1 <= kind <= len(_TYPES) else ""
            scaled = known and options & (_SCALE | _OFFSET)
            held = "double" if scaled else known
            yield _Entry(record.data + start, name, held, _text(entry[_DESCRIPTION]), bool(scaled))


def _text(field: bytes) -> bytes:
    return field.split(b"\0")[0]


def extra_dimensions(path: str | os.PathLike) -> dict[str, str]:
    """Extra dimensions that a LAS file describes, by name: the types PDAL holds them in. Empty where there are none.

    Scaled ones are ``double``; those that are not valid numbers are left out.
    """
    try:
        return {entry.name: entry.type for entry in _entries(path) if entry.name and entry.type}
    except (OSError, ValueError):
        return {}


def plain_dimensions(path: str | os.PathLike) -> list[tuple[str, str]] | None:
    """Names and types of the extra dimensions in their order; None where one is scaled, not a number or has no name."""
    found = list(_entries(path))
    if any(entry.scaled or not entry.type or not entry.name for entry in found):
        return None
    return [(entry.name, entry.type) for entry in found]


def number_type(kind: str) -> np.dtype:
    """The NumPy type of one that PDAL writes so: ``double``, ``float``, ``uint8`` or ``uint8_t``."""
    return np.dtype({"float": "f4", "double": "f8"}.get(kind, kind.removesuffix("_t")))
