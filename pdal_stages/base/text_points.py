"""Points in text files, checked before PDAL reads them: it takes ``1,9`` for 1 and goes on.

PDAL's ``readers.text``: a header line names the dimensions, its first character that is neither a
letter nor a digit separates the fields.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from .errors import StageError
from .json_types import JsonObject, StageJson

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
#: Lines that are converted at a time.
_PART = 200_000
#: Most decimals of coordinates: a nanometer.
_MOST_DECIMALS = 9
#: How many units in the last place a decimal fraction may be off in a double.
_SLACK = 4
_HOW = "Options of the reader: --readers.text.separator, --readers.text.header, --readers.text.skip"


@dataclass
class TextPoints:
    """The points of a text file: their number, and of each axis its range and decimals."""

    count: int = 0
    low: dict[str, float] = field(default_factory=dict)
    high: dict[str, float] = field(default_factory=dict)
    decimals: dict[str, int] = field(default_factory=dict)

    def add(self, axis: str, values: np.ndarray) -> None:
        """Take coordinates (n,) of an axis into account."""
        values = values[np.isfinite(values)]  # others are refused where they matter
        if not len(values):
            return
        self.low[axis] = min(self.low.get(axis, math.inf), float(values.min()))
        self.high[axis] = max(self.high.get(axis, -math.inf), float(values.max()))
        decimals = self.decimals.get(axis, 0)
        while decimals < _MOST_DECIMALS:
            steps = values * 10.0**decimals
            if np.all(np.abs(steps - np.rint(steps)) <= _SLACK * np.spacing(np.abs(steps))):
                break
            decimals += 1
        self.decimals[axis] = decimals

    def las_options(self) -> JsonObject:
        """Return scales and offsets of ``writers.las`` that hold the coordinates exactly."""
        options: StageJson = {}
        for axis, decimals in self.decimals.items():
            offset = float(math.floor(self.low[axis]))
            while decimals and (self.high[axis] - offset) * 10.0**decimals >= 2**31:
                decimals -= 1  # LAS has 32 bits
            name = axis.lower()
            options |= {f"scale_{name}": float(f"1e-{decimals}"), f"offset_{name}": offset}
        return options


def check_text(path: str, options: StageJson) -> TextPoints:
    """Refuse a text file that PDAL would misread; return what it holds.

    Parameters
    ----------
    path : str
    options : mapping
        Of ``readers.text``: ``separator``, ``header``, ``skip``.

    Raises
    ------
    StageError
        Naming the first line that is wrong.
    """
    try:
        with open(path, encoding="utf-8", errors="surrogateescape") as file:
            return _check_lines(file, options)
    except StageError as error:
        raise error.at(path) from None


def _check_lines(file: Iterator[str], options: StageJson) -> TextPoints:
    skipped = sum(1 for _ in itertools.islice(file, int(options.get("skip") or 0)))
    header = str(options.get("header") or next(file, "")).rstrip("\r\n")
    number = skipped + (not options.get("header"))
    if header.startswith(("\ufeff", "//", "#")):
        raise StageError(
            "the header line does not begin with the name of a dimension",
            found=repr(header[:40]),
            cure="Take what stands before the first name away, or skip the line and give it: "
            "--readers.text.skip=1 --readers.text.header=X,Y,Z",
        )
    separator = str(options.get("separator") or _separator(header))
    plain = header.replace('"', "")
    names = [name.strip() for name in plain.split(None if separator == " " else separator)]
    out = TextPoints()
    while lines := list(itertools.islice(file, _PART)):
        out.count += _convert(lines, separator, names, number, out)
        number += len(lines)
    return out


def _separator(header: str) -> str:
    """Return the character between fields, as PDAL finds it."""
    if header.startswith('"'):
        between = header.split('"')[2:3]
        return between[0].strip() or " " if between else " "
    return next((c for c in header if not (c.isascii() and c.isalnum())), " ")


def _convert(
    lines: list[str], separator: str, names: list[str], before: int, out: TextPoints
) -> int:
    """Take lines into account; return the number of points. `before` lines stand before them."""
    numbered = [(n, line.strip()) for n, line in enumerate(lines, before + 1) if line.strip()]
    if not numbered:
        return 0
    delimiter = None if separator == " " else separator
    try:
        values = np.loadtxt(
            [line for _, line in numbered], delimiter=delimiter, comments=None, ndmin=2
        )
        if values.shape[1] != len(names):
            raise ValueError
    except ValueError:
        _name_wrong_line(numbered, delimiter, names)
        raise
    for axis in {"X", "Y", "Z"}.intersection(names):
        out.add(axis, values[:, names.index(axis)])
    return len(values)


def _name_wrong_line(
    numbered: list[tuple[int, str]], delimiter: str | None, names: list[str]
) -> None:
    """Raise an error on the first line that is wrong."""
    for number, line in numbered:
        fields = line.split(delimiter)
        if len(fields) != len(names):
            seen = f"line {number:,}: {len(fields)} fields, {len(names)} dimensions"
            raise StageError(
                "a line does not have a value for each dimension", found=seen, cure=_HOW
            )
        for name, text in zip(names, fields, strict=True):
            if not _NUMBER.fullmatch(text.strip()):
                seen = f"line {number:,}: {name} is {text.strip()!r}"
                cure = "Write numbers with a decimal point, without signs between digits"
                raise StageError("a value is not a number", found=seen, cure=cure)
