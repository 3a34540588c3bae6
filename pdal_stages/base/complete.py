"""Whether a file just written holds all its points: PDAL's writers do not notice that a disk is full.

Each format says in its header how much must follow, except text, where lines are counted.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from .errors import StageError
from .files import disk_is_full
from .las import read_header
from .lascheck import check_readable
from .readback import chunks_are_whole

_CURE = "Make room on the disk (or raise the limit on file sizes)"


def check_complete(
    path: str | os.PathLike, name: str | os.PathLike, writer: Mapping[str, Any], count: int | None = None
) -> bool:
    """Refuse a file that a writer could not finish.

    Parameters
    ----------
    path : path
        The file as it was written.
    name : path
        The name it is to get, for the message.
    writer : mapping
        The stage that wrote it.
    count : int, optional
        The points it must hold, where that is known.

    Returns
    -------
    bool
        Whether the format is one that can be judged; of others it is only known that disk and limits left room.

    Raises
    ------
    StageError
        If it is not whole.
    """
    path = Path(path)
    beside = path.suffix != Path(str(writer["filename"])).suffix  # a file the writer made with its own
    judge = _JUDGES.get(str(writer.get("type", ""))) or _BY_SUFFIX.get(path.suffix.lower())
    if beside:
        judge = _vectors if judge is _vectors else None
    try:
        size = path.stat().st_size
        with open(path, "rb+") as file:
            os.fsync(file.fileno())  # some file systems report a full disk only here
            try:
                whole = None if judge is None else judge(file, size, count, writer)
            except (ValueError, IndexError, struct.error):  # a header that is cut, or says nonsense
                whole = False
    except OSError as error:
        raise StageError("the output file cannot be read back", found=f"{name}: {error}") from error
    if whole is False or (whole is None and (disk_is_full(path) or size >= _largest())):
        raise StageError(
            "the output file could not be written completely",
            found=f"{name}: {size:,} bytes were written",
            cure=_CURE,
        )
    return whole is not None


def _largest() -> float:
    """Bytes that a file of this process may have."""
    try:
        import resource
    except ImportError:  # Windows
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def _las(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    header = read_header(file.name)
    if header is None:
        return False
    try:
        check_readable(file.name)
    except StageError:
        return False
    # The count is written last: none of it, but points and no records after them, means the header was never updated.
    if not header.count and not header.records_after and size >= header.offset + header.point_bytes:
        return header.compressed
    if count is not None and header.count != count:
        return False
    return not (header.compressed and header.count) or chunks_are_whole(file.name, header)


def _text(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    if str(writer.get("format", "csv")).lower() == "geojson":
        return _geojson(file, size, count)
    if str(writer.get("newline", "\n")) != "\n":
        return size > 0
    header = str(writer.get("write_header", True)).lower() not in ("false", "0", "no", "off")
    lines, last = 0, b"\n"
    while block := file.read(1 << 20):
        lines, last = lines + block.count(b"\n"), block[-1:]
    return last == b"\n" and lines >= header and (count is None or lines == count + header)


def _geojson(file: BinaryIO, size: int, count: int | None) -> bool:
    file.seek(max(0, size - 64))
    if not file.read().rstrip(_AFTER_JSON).endswith(b"]}"):
        return False
    file.seek(0)
    found, rest = -1, b""  # what stands before the first feature is none
    while block := file.read(1 << 20):
        *features, rest = (rest + block).split(_FEATURE)
        if found < 0 and not features:
            return True  # no points, or other words than PDAL's, of which only the end is known
        for feature in features:
            if found >= 0:  # PDAL 2.2 forgets the comma
                json.loads(_FEATURE + feature.removesuffix(b","))
            found += 1
    json.loads(_FEATURE + rest.rstrip(_AFTER_JSON).removesuffix(b"]}"))
    return count is None or found + 1 == count


def _ply(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    words = _header(file, b"end_header")
    elements: list[list[int]] = []  # how many, and bytes of each
    ascii_ = [b"format", b"ascii"] in (w[:2] for w in words)
    for word in words:
        if word[:1] == [b"element"]:
            elements.append([int(word[2]), 0])
        elif word[:1] == [b"property"]:
            triangle = word[1] == b"list"  # PDAL writes no other lists
            sizes = [_PLY_BYTES[w] for w in (word[2:4] if triangle else word[1:2])]
            elements[-1][1] += sizes[0] + 3 * sizes[1] if triangle else sizes[0]
    if count is not None and elements[0][0] != count:
        return False
    if ascii_:
        return _lines(file, sum(number for number, _ in elements), elements[-1][0])
    return size - file.tell() == sum(number * width for number, width in elements)


def _pcd(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    said = {word[0]: word[1:] for word in _header(file, b"DATA") if word}
    points = int(said[b"POINTS"][0])
    if count is not None and points != count:
        return False
    if said[b"DATA"] == [b"ascii"]:
        return _lines(file, points, points)
    if said[b"DATA"] == [b"binary_compressed"]:
        start = file.tell()
        packed = struct.unpack("<I", file.read(8)[:4])[0] if points else 0
        return size >= start + 8 * bool(points) + packed
    width = sum(int(a) * int(b) for a, b in zip(said[b"SIZE"], said[b"COUNT"], strict=True))
    return size - file.tell() == points * width


def _bpf(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    head = file.read(20)
    if head[:4] != b"BPF!":
        return False
    at, dimensions, compressed, points = struct.unpack_from("<iBxBxi", head, 8)
    if count is not None and points != count:
        return False
    needed = points * dimensions * 4
    if not compressed:
        return size >= at + needed
    while needed > 0:
        file.seek(at)
        raw, packed = struct.unpack("<II", file.read(8))
        needed -= raw
        at += 8 + packed
        if not raw or at > size:
            return False
    return True


def _sbet(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    return size % 136 == 0 and (count is None or size == 136 * count)


def _gltf(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool:
    magic, length = struct.unpack("<4s4xI", file.read(12))
    at, kinds = 12, []
    while at < size:
        file.seek(at)
        long, kind = struct.unpack("<I4s", file.read(8))
        at += 8 + long
        kinds.append(kind)
    return magic == b"glTF" and length == size == at and kinds == [b"JSON", b"BIN\0"]


def _vectors(file: BinaryIO, size: int, count: int | None, writer: Mapping[str, Any]) -> bool | None:
    """Of the formats that GDAL writes, those of which the length is known; None for others that hold something."""
    features = None if count is None else -(-count // int(writer.get("multicount", 1)))
    suffix = Path(file.name).suffix.lower()
    if suffix in (".geojson", ".json"):
        return _geojson_of_gdal(file, size, features)
    if suffix in (".shp", ".shx"):  # ESRI Shapefile Technical Description (1998), the main file's header
        long, kind = struct.unpack(">24xi4x", file.read(32))[0], file.read(4)[0]
        each = 8 if suffix == ".shx" else {1: 28, 11: 44}.get(kind)
        return 2 * long == size and (features is None or each is None or size == 100 + each * features)
    if suffix == ".dbf":
        rows, header, width = struct.unpack("<4xIHH", file.read(12))
        return size - header - rows * width in (0, 1) and features in (None, rows)
    if suffix in (".gpkg", ".sqlite"):
        (page,) = struct.unpack(">16xH", file.read(18))
        file.seek(28)
        return size == (65536 if page == 1 else page) * struct.unpack(">I", file.read(4))[0]
    return None if size else False


def _geojson_of_gdal(file: BinaryIO, size: int, features: int | None) -> bool:
    file.seek(max(0, size - 4))
    if not file.read().endswith(b"]\n}\n"):
        return False
    file.seek(0)
    if (file.readline(), file.readline()) != (b"{\n", b'"type": "FeatureCollection",\n'):
        return False
    found = -1  # what stands before the first feature is none
    for line in file:
        if line == b'"features": [\n':
            found = 0
        elif line.startswith(_FEATURE_OF_GDAL):
            json.loads(line.rstrip(b",\n"))
            found += 1
        elif found >= 0 and line not in (b"]\n", b"}\n"):
            return False
    return found >= 0 if features is None else found == features


def _header(file: BinaryIO, end: bytes) -> list[list[bytes]]:
    """Words of a header's lines, the last of which begins with `end`; the file stands after it."""
    words = []
    for _ in range(10_000):
        line = file.readline(100_000)
        if not line.endswith(b"\n"):
            break
        words.append(line.split())
        if words[-1][:1] == [end]:
            return words
    raise ValueError("the header does not end")


def _lines(file: BinaryIO, count: int, alike: int) -> bool:
    """Whether `count` lines follow, of which the last `alike` have as many words; PDAL 2.2 may write some twice."""
    lines, end = 0, b"\n"
    while block := file.read(1 << 20):
        lines, end = lines + block.count(b"\n"), (end + block)[-100_000:]
    words = [len(line.split()) for line in end.split(b"\n")[-3:-1]]
    return end.endswith(b"\n") and lines == count and (alike < 2 or words[0] == words[-1])


#: How PDAL begins a feature, and what may follow the last brace.
_FEATURE, _AFTER_JSON = b'{ "type":"Feature",', b" \n;)"
#: How GDAL does.
_FEATURE_OF_GDAL = b'{ "type": "Feature",'
_PLY_BYTES = {
    **dict.fromkeys((b"int8", b"uint8", b"char", b"uchar"), 1),
    **dict.fromkeys((b"int16", b"uint16", b"short", b"ushort"), 2),
    **dict.fromkeys((b"int32", b"uint32", b"int", b"uint", b"float", b"float32"), 4),
    **dict.fromkeys((b"int64", b"uint64", b"double", b"float64"), 8),
}
_Judge = Callable[[BinaryIO, int, "int | None", Mapping[str, Any]], "bool | None"]
#: Of PDAL's writers: what judges their files, and by which suffixes PDAL chooses them.
_FORMATS: dict[str, tuple[_Judge, tuple[str, ...]]] = {
    "las": (_las, (".las", ".laz")),
    "copc": (_las, ()),
    "text": (_text, ("", ".csv", ".txt", ".json", ".xyz")),
    "ply": (_ply, (".ply",)),
    "pcd": (_pcd, (".pcd",)),
    "bpf": (_bpf, (".bpf",)),
    "sbet": (_sbet, (".sbet",)),
    "gltf": (_gltf, (".glb",)),
    "ogr": (_vectors, (".shp", ".geojson")),
}
_JUDGES = {f"writers.{name}": judge for name, (judge, _) in _FORMATS.items()}
_BY_SUFFIX = {suffix: judge for judge, suffixes in _FORMATS.values() for suffix in suffixes}
