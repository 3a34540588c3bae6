"""Outputs of files that are alike, written without PDAL: as PDAL wrote one of them, to the byte.

A pipeline takes PDAL several milliseconds, however few points it has, most of them for the reference system; of a survey
in thousands of small files that is as much as their features. So of inputs that say the same but for their points, with one
writer, PDAL writes the first ones. What it made of one of them, and of points whose every bit is random, is held against
what is made here, and only where these are the same, byte for byte, are the others made here. Whatever that cannot tell
(other writers, filters behind the stages, octrees, waveforms) stays PDAL's.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from ..base.las import LasHeader, read_header, records
from ..pipeline.likefile import Extra, LikeFile, Some, extra_of
from .extract import records_of
from .lasfiles import finish, plain_header
from .results import NewValues
from .sources import InputSource
from .store import check_run
from .tail import written

#: Writes an output as PDAL does: a reader's file, the new values, the name.
WithPdal = Callable[[str, NewValues, str], Any]

#: Bytes of a header that tell of the points alone: counts, counts by return, extents, and what LAS 1.4 has of these.
_OF_POINTS = ((107, 131), (179, 227), (247, 375))
#: Points whose bits are random, and points that are put together at a time.
_RANDOM, _BLOCK = 200, 500_000
#: Kinds that are remembered.
_MOST_KINDS = 64


@dataclass(frozen=True)
class _Way:
    """How outputs of a kind are made."""

    like: LikeFile  #: one of them
    copied: dict[str, Extra]  #: extra dimensions that come out of an input's records


#: By kind: None for those that were seen once, False for those that take PDAL.
_known: OrderedDict[bytes, _Way | bool | None] = OrderedDict()


def kind_of(
    source: InputSource, tail: Sequence[Mapping[str, Any]], values: Mapping[str, Any], output: str, *more: Any
) -> bytes | None:
    """What decides how an output is made but for points and values; None where that takes PDAL in any case."""
    if len(tail) != 1 or tail[0].get("type") != "writers.las" or "where" in tail[0]:
        return None
    forward = str(tail[0].get("forward", ""))
    if "all" not in forward and "header" not in forward:  # PDAL's own day and names
        return None
    header = read_header(source.path)
    if header is None or header.records_after or header.waveforms:
        return None
    head, _ = plain_header(source.path)
    for start, end in _OF_POINTS:
        if start < header.header_bytes:
            head[start : min(end, header.header_bytes)] = bytes(min(end, header.header_bytes) - start)
    for start, end in _ranges(head, header):
        head[start:end] = bytes(end - start)
    writer = {key: value for key, value in tail[0].items() if key != "filename"}
    kinds = {name: str(column.dtype) for name, (_, column) in values.items()}
    suffixes = [Path(name).suffix.lower() for name in (source.path, output)]
    return bytes(head) + json.dumps([source.reader, writer, kinds, suffixes, *more], default=str).encode()


def _ranges(head: bytearray, header: LasHeader) -> Iterator[tuple[int, int]]:
    """Where records say the least and most of an extra dimension (LAS 1.4 R15, table 24), which PDAL does not hand on."""
    for record in records(io.BytesIO(head), header):
        if (record.user, record.number) == (b"LASF_Spec", 4):
            for start in range(record.data, record.data + record.length - 191, 192):
                yield start + 64, start + 112


def write_alike(
    kind: bytes | None, source: InputSource, copy: str, new: NewValues, output: str, scratch: str
) -> dict[str, Any] | None:
    """Write an input's output where outputs of its kind are known; None where PDAL has to."""
    way = _known.get(kind) if kind is not None else None
    if not isinstance(way, _Way) or not new.kept.any():
        return None
    points = records_of(source.path, copy, len(new.kept))
    if points is None:
        return None
    with (
        whole_files(output, check=lambda *_: check_run(scratch)) as (partial,),
        open(partial, "x+b") as file,
    ):
        way.like.write(file, _some(points, new), way.copied)
        file.flush()
        os.fsync(file.fileno())
    return written([output], int(np.count_nonzero(new.kept)))


def learn(
    kind: bytes | None,
    source: InputSource,
    copy: str,
    new: NewValues,
    output: str,
    scratch: str,
    with_pdal: WithPdal,
) -> None:
    """See how PDAL wrote an output, where it is the second of its kind."""
    if kind is None or _known.get(kind, None) is not None:
        return
    if kind not in _known:
        _known[kind] = None
        if len(_known) > _MOST_KINDS:
            _known.popitem(last=False)
        return
    try:
        way = _way(source.path, output, new)
        same = way is not None and (
            _same(way, source.path, records_of(source.path, copy, len(new.kept)), new, output)
            and _tried(way, source.path, new, scratch, Path(output).suffix, with_pdal)
        )
    except (StageError, OSError, ValueError, struct.error):
        same = False
    _known[kind] = way if same and way is not None else False


def _way(path: str, output: str, new: NewValues) -> _Way | None:
    """How an output seems to have been made; None where its points cannot be told from input and new values."""
    before, like = read_header(path), LikeFile.of(output)
    if before is None or like is None or before.point_format != like.header.point_format:
        return None
    had = extra_of(path, before)
    if had is None or not new.values.keys() <= like.holds:
        return None
    copied = {}
    for name, (_, dtype) in like.extra.items():
        if name in new.values:
            if new.values[name][1].dtype != dtype:
                return None
        elif name not in had or had[name].dtype != dtype:
            return None
        else:
            copied[name] = had[name]
    return _Way(like, copied)


def _same(way: _Way, path: str, points: NDArray | None, new: NewValues, output: str) -> bool:
    """Whether what is made here is what PDAL made."""
    if points is None:
        return False
    out = io.BytesIO()
    way.like.write(out, _some(points, new), way.copied)
    with open(output, "rb") as file:
        return file.read() == out.getvalue()


def _tried(way: _Way, path: str, new: NewValues, scratch: str, suffix: str, with_pdal: WithPdal) -> bool:
    """Whether that is so for points whose every bit is random, too."""
    rng = np.random.default_rng(1)
    head, _ = plain_header(path)
    (width,) = struct.unpack_from("<H", head, 105)
    points = rng.integers(0, 256, (_RANDOM, width), np.uint8)
    places = rng.integers(-(2**30), 2**30, (_RANDOM, 3), np.int32)
    points[:, :12] = places.view(np.uint8)
    header = read_header(path)
    assert header is not None
    for start, end in _ranges(head, header):
        head[start:end] = rng.bytes(end - start)
    numbers = [(20 if header.point_format < 6 else 22, np.dtype("<f8"))] * (
        header.point_format in (1, 3, 6, 7, 8)
    )
    extra = extra_of(path, header) or {}
    numbers += [(one.at, one.dtype) for one in extra.values() if one.dtype.kind == "f"]
    for at, dtype in numbers:  # any bits would be such as no program writes
        values = rng.normal(0.0, 1e5, _RANDOM).astype(dtype)
        points[:, at : at + dtype.itemsize] = values[:, None].view(np.uint8)
    columns: dict[str, tuple[None, NDArray]] = {}
    for name, (_, column) in new.values.items():
        columns[name] = (None, rng.integers(0, 100, _RANDOM).astype(column.dtype))
    tried = NewValues(np.ones(_RANDOM, bool), columns)
    with TemporaryDirectory(prefix="alike-", dir=scratch, ignore_cleanup_errors=True) as folder:
        given, made = os.path.join(folder, "given.las"), os.path.join(folder, f"made{suffix}")
        with open(given, "wb") as file:
            file.write(head + points.tobytes())
            finish(file, head, b"", _RANDOM)
        with_pdal(given, tried, made)
        return _same(way, path, points, tried, made)


def _some(points: NDArray, new: NewValues) -> Iterator[Some]:
    """Points, (n, bytes) records of an input, with what is new of them, in parts."""
    for start in range(0, len(points), _BLOCK):
        end = start + _BLOCK
        values: dict[str, tuple[NDArray | None, NDArray]] = {}
        for name, (rows, column) in new.values.items():
            if rows is None:
                values[name] = None, column[start:end]
            else:
                mine = (rows >= start) & (rows < end)
                values[name] = rows[mine] - start, column[mine]
        yield Some(points[start:end], values, new.kept[start:end])
