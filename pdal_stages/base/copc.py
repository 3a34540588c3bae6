"""The octree of a COPC file, held against the file: PDAL's reader crashes, or leaves points out, where it is wrong.

Layout: "COPC 1.0", sections on the info record and the hierarchy.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from typing import BinaryIO

#: Bytes of the info record, and of an entry of the hierarchy: key, place, bytes, points.
_INFO, _ENTRY = 160, struct.Struct("<4iQii")
#: Deeper than any octree over doubles.
_DEEPEST = 64


def what_is_wrong(
    file: BinaryIO, info: int, size: int, points: int, chunks: Iterable[tuple[int, int, int]] | None
) -> tuple[str, str] | None:
    """Why the octree cannot be right: (what, found); None where it can.

    Parameters
    ----------
    file : binary file
    info : int
        Where the info record's data are.
    size : int
        Bytes of the file.
    points : int
        As the file's header has them.
    chunks : iterable of (int, int, int), optional
        Place, bytes and points of every chunk of the LAZ file, where they are known.
    """
    file.seek(info)
    data = file.read(_INFO)
    if len(data) < _INFO:
        return "its record of the octree is cut short", f"{len(data)} bytes"
    box = struct.unpack_from("<5d", data)
    if not all(map(math.isfinite, box)) or box[3] <= 0 or box[4] <= 0:
        return "its octree has an invalid extent", "center, half size and spacing " + ", ".join(
            f"{v:g}" for v in box
        )
    pages, seen = [struct.unpack_from("<2Q", data, 40)], set()
    nodes: dict[tuple[int, ...], tuple[int, int, int]] = {}
    while pages:
        place, length = pages.pop()
        if length % _ENTRY.size or place + length > size:
            return "its octree lies outside the file", f"a page of {length:,} bytes at {place:,}"
        if place in seen:
            return "its octree leads back to itself", f"a page at {place:,}"
        seen.add(place)
        file.seek(place)
        for *key, at, held, count in _ENTRY.iter_unpack(file.read(length)):
            level = key[0]
            if (
                not 0 <= level < _DEEPEST
                or any(not 0 <= k < 1 << level for k in key[1:])
                or tuple(key) in nodes
            ):
                return "its octree has a node that cannot be, or one twice", "-".join(map(str, key))
            if count == -1 and held > 0:
                pages.append((at, held))
            elif count < 0 or held < 0 or (count > 0) != (held > 0):
                return "its octree has a node that cannot be", f"{count:,} points in {held:,} bytes"
            elif count:
                nodes[tuple(key)] = (at, held, count)
    counted = sum(count for _, _, count in nodes.values())
    if counted != points:
        return "its octree does not hold its points", f"{counted:,} of {points:,}"
    if chunks is not None and sorted(nodes.values()) != sorted(chunks):
        return "the nodes of its octree are not the chunks of the file", f"{len(nodes):,} nodes"
    return None
