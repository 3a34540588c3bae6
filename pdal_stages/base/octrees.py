"""Octrees of COPC files and EPT sources, checked before PDAL trusts them.

Pages at wrong offsets or that contain themselves crash PDAL or make it loop, and points that no
page lists are silently left out. Layouts: COPC 1.0 (copc.io), EPT 1.1 (entwine.io).
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from .checks import strict_json
from .errors import StageError
from .json_types import JsonObject
from .las import read_header, records_of

#: Where a node or page lies in its file.
_Place = TypeVar("_Place")
#: Level, x, y and z of a node.
Key = tuple[int, int, int, int]
#: Number of points of each node, and their location.
Nodes = dict[Key, tuple[int, _Place]]
#: Entries of a page: nodes, or with -1 points other pages.
Entries = Iterator[tuple[Key, int, _Place]]

#: Deeper nodes would be smaller than a step of the coordinates, which have 32 bits.
_DEEPEST = 31
#: Of a COPC file: middle and half side of its cube, spacing, place and bytes of the first page,
#: times.
_COPC_INFO = struct.Struct("<5d2Q2d")
#: Entry of a page: level, x, y, z, offset, bytes, points.
_COPC_ENTRY = struct.Struct("<4iQ2i")
#: Endings of the files of an EPT source, by their type.
_ENDINGS = {"binary": "bin", "laszip": "laz", "zstandard": "zst"}


def check_copc(path: str | os.PathLike) -> None:
    """Refuse a COPC file, readable as LAZ, whose octree does not hold each of its chunks once.

    Raises
    ------
    StageError
        Naming what is wrong.
    """
    header = read_header(path)
    about = [data for record, data in records_of(path, b"copc") if record.number == 1]
    if header is None or not about or len(about[0]) < 160:
        return  # which PDAL says
    x, y, z, half, spacing, begin, length, _, _ = _COPC_INFO.unpack_from(about[0])
    try:
        # Its cube holds all points, but for what programs round: a hundredth of it. Not tuned.
        beyond = [abs(end - middle) for end, middle in zip(header.box, (x, y, x, y), strict=True)]
        if not (half > 0 and max(beyond) <= 1.01 * half and math.isfinite(z) and spacing > 0):
            raise ValueError(
                f"a cube of {2 * half:g} around {x:g}, {y:g}, {z:g}, points {spacing:g} apart"
            )
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size

            def entries(page: tuple[int, int]) -> Entries:
                place, held = page
                if not 0 < held <= size - place or held % _COPC_ENTRY.size:
                    raise ValueError(f"a page of {held:,} bytes at {place:,}")
                file.seek(place)
                for *key, offset, inside, count in _COPC_ENTRY.iter_unpack(file.read(held)):
                    yield tuple(key), count, (offset, inside)  # type: ignore[misc]

            nodes = _walk((begin, length), entries)
            file.seek(header.offset)
            table = int.from_bytes(file.read(8), "little")
            place = header.offset + 8  # chunks follow each other from here to their table
            chunks = sorted((n for n in nodes.values() if n[0]), key=lambda n: n[1])
            for count, (offset, inside) in chunks:
                file.seek(place + header.point_bytes)  # a chunk begins with a point and the number
                counted = int.from_bytes(file.read(4), "little")
                if offset != place or not 0 < inside <= table - place or counted != count:
                    raise ValueError(f"{count:,} points in {inside:,} bytes at {offset:,}")
                place += inside
        if (held := sum(count for count, _ in nodes.values())) != header.count:
            raise ValueError(f"{held:,} points, the header counts {header.count:,}")
    except ValueError as error:
        raise StageError(
            "the octree of the COPC file is damaged",
            where=str(path),
            found=str(error),
            cure="Get the file again; renamed to .laz, it is read as a plain LAZ file",
        ) from None


def _is_rounded(dimension: JsonObject) -> bool:
    """Return whether a dimension is an axis of integers that stand for fractions.

    PDAL puts the scaled values back into integers.
    """
    if dimension["name"] not in ("X", "Y", "Z") or dimension["type"] == "float":
        return False
    return any(float(dimension.get(name) or 0) % 1 for name in ("scale", "offset"))


def check_ept(path: str) -> JsonObject:
    """Check an EPT source, ``ept.json``, against its files; return its description.

    One at an address is left to PDAL.

    Raises
    ------
    StageError
        If the source is damaged, or PDAL would not read all of its points.
    """
    if "://" in path:
        return {}
    folder = Path(path).parent

    def entries(page: str) -> Entries:
        listed = json.loads((folder / "ept-hierarchy" / f"{page}.json").read_bytes())
        for name, count in dict(listed).items():
            level, x, y, z = map(int, name.split("-"))
            yield (level, x, y, z), int(count), name

    try:
        about = strict_json(Path(path).read_bytes())
        x0, y0, _, x1, y1, _ = map(float, about["boundsConforming"])
        left, low, _, right, high, _ = map(float, about["bounds"])
        # PDAL looks for points beyond the octree without end.
        there = left - 1 <= x0 <= x1 <= right + 1 and low - 1 <= y0 <= y1 <= high + 1
        if int(about["points"]) < 0 or not there:
            raise ValueError("not a valid description, or its points lie outside its octree")
        schema, kind = about["schema"], about.get("dataType")
        if kind != "laszip" and any(map(_is_rounded, schema)):
            raise ValueError("PDAL rounds its coordinates to whole numbers; build it as laszip")
        step = sum(int(dimension["size"]) for dimension in schema)
        for count, name in _walk("0-0-0-0", entries).values() if kind in _ENDINGS else ():
            file = folder / "ept-data" / f"{name}.{_ENDINGS[kind]}"
            held = file.stat().st_size if count else 0
            if count and kind == "laszip":
                header = read_header(file)
                fits = header is not None and header.count == count
            else:
                fits = held == count * step if kind == "binary" else bool(held) == bool(count)
            if not fits:
                raise ValueError(f"{count:,} points in {file.name}, of {held:,} bytes")
        return about
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        what = "the EPT source is damaged"
        cure = "Get it again from its source, or build it again"
        raise StageError(what, where=path, found=str(error), cure=cure) from None


def _walk(root: _Place, entries: Callable[[_Place], Entries[_Place]]) -> Nodes[_Place]:
    """Return all nodes of an octree from its first page on; ValueError for a wrong one."""
    nodes: Nodes[_Place] = {}
    waiting: list[tuple[Key, _Place]] = [((0, 0, 0, 0), root)]
    while waiting:  # not without end: a page that comes again has its nodes twice
        first, page = waiting.pop()
        for key, count, place in entries(page):
            level, *at = key
            there = 0 <= level <= _DEEPEST and all(0 <= number < 1 << level for number in at)
            if not there or count < -1:
                raise ValueError(f"node {key} of {count:,} points")
            if count == -1:
                waiting.append((key, place))
            elif key in nodes:
                raise ValueError(f"node {key} is there twice")
            else:
                nodes[key] = count, place
        if first not in nodes:
            raise ValueError(f"node {first} is not in its page")
    for level, *at in nodes:
        if level and (level - 1, *(place >> 1 for place in at)) not in nodes:
            raise ValueError(f"node {(level, *at)} is in no other")
    return nodes
