"""Rows of a CSV file that hold points: control points, places that somebody asks about."""

from __future__ import annotations

import csv
import math
from typing import NamedTuple

from .errors import StageError

#: Names of columns of coordinates in a heading, in any case of letters.
_AXES = ("x", "y", "z")


class PointRow(NamedTuple):
    """A point of a CSV file."""

    x: float
    y: float
    z: float | None
    name: str  #: what else the row holds


def read_point_rows(path: str, what: str, needs_z: bool) -> list[PointRow]:
    """Return the points of a CSV file.

    Parameters
    ----------
    path : str
        Rows of x, y, z and more. A heading that names columns ``x``, ``y`` and ``z`` tells where
        these are; other headings, whose first two fields are no numbers, are skipped.
    what : str
        What a row is, for errors: ``control point``.
    needs_z : bool
        Whether each point must have a height.

    Raises
    ------
    StageError
        Naming the line that holds something else than finite numbers, or the file without rows.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except (OSError, UnicodeError, csv.Error) as error:
        raise StageError(f"the {what}s cannot be read", where=path, found=error) from None
    columns = [0, 1, 2]
    if rows and not any(map(_is_number, rows[0][1][:2])):
        heading = [name.strip().lower() for name in rows.pop(0)[1]]
        if {"x", "y"} <= {*heading}:
            columns = [heading.index(axis) for axis in _AXES if axis in heading]
    points = []
    for line, row in rows:
        fields = [row[at].strip() if at < len(row) else "" for at in columns]
        numbers = fields if needs_z or (len(fields) == 3 and fields[2]) else fields[:2]
        if len(numbers) < 2 + needs_z or not all(map(_is_number, numbers)):
            raise StageError(
                f"a {what} is not {'three' if needs_z else 'two or three'} numbers",
                where=f"{path}, line {line}",
                found=",".join(row),
                cure="Give rows of x,y,z" + ("" if needs_z else ", or x,y"),
            )
        x, y, *z = map(float, numbers)
        more = [field for at, field in enumerate(row) if at not in columns]
        points.append(PointRow(x, y, z[0] if z else None, ",".join(more).strip()))
    if not points:
        raise StageError(f"the file has no {what}s", where=path)
    return points


def _is_number(text: str) -> bool:
    """Return whether a field is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
