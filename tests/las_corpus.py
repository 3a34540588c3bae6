"""LAS and LAZ files of all kinds, built byte by byte, and how a copy may differ from its input.

Nothing here uses the package: the layout of headers, records and points is that of LAS 1.4 R15.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field

import lazrs
import numpy as np

POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
#: Point formats of each minor version.
FORMATS = {0: (0, 1), 1: (0, 1), 2: range(4), 3: range(6), 4: range(11)}
SIZES = (1, 1, 2, 2, 4, 4, 8, 8, 4, 8)  #: of the types 1 to 10 of extra bytes


def entry(
    name: bytes, kind: int, options: int = 0, scale: float = 0.0, shift: float = 0.0
) -> bytes:
    """Describe extra bytes."""
    head = struct.pack("<HBB32s4x", 7, kind, options, name)
    return (
        head
        + bytes(72)
        + struct.pack("<3d", scale, 0, 0)
        + struct.pack("<3d", shift, 0, 0)
        + b"what".ljust(32, b"\0")
    )


def record(user: bytes, number: int, data: bytes, title: bytes = b"", late: bool = False) -> bytes:
    """Return a variable-length record, before or behind the points."""
    kind = "<H16sHQ32s" if late else "<H16sHH32s"
    return struct.pack(kind, 0xAABB if not late else 3, user, number, len(data), title) + data


@dataclass
class LasFile:
    """What a file is made of."""

    minor: int = 4
    point_format: int = 6
    extra: int = 0  #: extra bytes of a point
    described: tuple[bytes, ...] = ()  #: descriptions of them
    described_behind: bool = False  #: in a record behind the points
    vlrs: tuple[bytes, ...] = ()
    evlrs: tuple[bytes, ...] = ()
    scales: tuple[float, float, float] = (0.001, 0.001, 0.001)
    header_more: bytes = b""  #: between the header and the records
    padding: bytes = b""  #: between the records and the points
    compressed: bool = False
    variable_chunks: bool = False
    waveforms: int = 0  #: bytes of a record with waveforms
    text: bytes = b"pdal_stages corpus"
    encoding: int = 0
    count: int = 250
    at: float = 0.0  #: where it lies, m
    flags: bool = True
    seed: int = field(default=0)

    def records(self) -> np.ndarray:
        """Return the points (n, bytes): flat ground with a block, and random bytes elsewhere."""
        rng = np.random.default_rng([self.seed, self.minor, self.point_format])
        size = POINT_BYTES[self.point_format] + self.extra
        raw = rng.integers(0, 256, (self.count, size), np.uint8)
        x, y = rng.uniform(0, 16, (2, self.count))
        block = (abs(x - 8) < 4) & (abs(y - 8) < 4)
        z = np.where(block, 6.0, 0.02 * x)
        place = np.column_stack([x + self.at, y, z]) / self.scales
        raw[:, :12] = np.rint(place).astype("<i4").view(np.uint8).reshape(-1, 12)
        if self.point_format < 6:
            raw[:, 14] = 0b00_001_001
            raw[:, 15] = (raw[:, 15] & 0b11100000 if self.flags else 0) | 1
            raw[:, 15] &= 0b01111111 if rng.integers(2) else 0xFF
        else:
            raw[:, 14] = 0x11
            raw[:, 15] = raw[:, 15] & 0b11001011 if self.flags else 0
            raw[:, 16] = 1
        if self.point_format in (4, 5, 9, 10):  # no waveform
            at = POINT_BYTES[self.point_format] - 29
            raw[:, at] = 0
        times = {1: 20, 3: 20, 4: 20, 5: 20}.get(
            self.point_format, 22 if self.point_format > 5 else 0
        )
        if times:
            values = np.sort(rng.uniform(1e5, 2e5, self.count)).astype("<f8")
            raw[:, times : times + 8] = values.view(np.uint8).reshape(-1, 8)
        return raw

    def build(self) -> bytes:
        """Return the bytes of the file."""
        raw = self.records()
        size = HEADER_BYTES[self.minor]
        vlrs = list(self.vlrs)
        evlrs = list(self.evlrs)
        if self.described:
            data = b"".join(self.described)
            target = evlrs if self.described_behind else vlrs
            target.append(record(b"LASF_Spec", 4, data, b"Extra bytes", self.described_behind))
        points = raw.tobytes()
        if self.compressed:
            coding = lazrs.LazVlr.new_for_compression(
                self.point_format, self.extra, self.variable_chunks
            )
            vlrs.append(record(b"laszip encoded", 22204, coding.record_data(), b"by lazrs"))
        head = bytearray(size) + self.header_more
        before = b"".join(vlrs) + self.padding
        offset = len(head) + len(before)
        if self.compressed:
            stream = io.BytesIO()
            stream.write(bytes(offset))
            encoder = lazrs.LasZipCompressor(stream, coding)
            if self.variable_chunks:
                parts = np.array_split(raw, [60, 130])
                encoder.compress_chunks([part.tobytes() for part in parts])
            else:
                encoder.compress_many(points)
            encoder.done()
            points = stream.getvalue()[offset:]
        after = offset + len(points)
        behind = b"".join(evlrs)
        waves = record(b"LASF_Spec", 65535, bytes(range(256)) * (self.waveforms // 256), late=True)
        if self.waveforms and self.minor >= 4:
            evlrs.append(waves)
        tail = behind + (waves if self.waveforms else b"")
        head[:4] = b"LASF"
        struct.pack_into("<HH", head, 4, 17, self.encoding)
        head[8:24] = bytes(range(16))
        head[24:26] = bytes([1, self.minor])
        head[26:58], head[58:90] = self.text.ljust(32, b"\0"), b"a program".ljust(32, b"\0")
        kind = self.point_format | (0x80 if self.compressed else 0)
        old = self.point_format < 6
        struct.pack_into(
            "<HHHIIBHI", head, 90, 33, 2020, len(head), offset, len(vlrs), kind, raw.shape[1],
            self.count if old else 0,
        )  # fmt: skip
        if old:
            struct.pack_into("<5I", head, 111, self.count, 0, 0, 0, 0)
        place = raw[:, :12].copy().view("<i4") * np.array(self.scales)
        low, high = (place.min(axis=0), place.max(axis=0)) if self.count else (np.zeros(3),) * 2
        box = [value for axis in range(3) for value in (high[axis], low[axis])]
        struct.pack_into("<12d", head, 131, *self.scales, 0, 0, 0, *box)
        if self.minor >= 3 and self.waveforms:
            struct.pack_into("<Q", head, 227, after + len(behind))
        if self.minor >= 4:
            struct.pack_into("<QIQ", head, 235, after if evlrs else 0, len(evlrs), self.count)
            struct.pack_into("<Q", head, 255, self.count)
        return bytes(head) + before + points + tail


# ---- reading a file, for the comparison ----------------------------------------------------------


@dataclass
class Parts:
    """A file taken apart."""

    head: bytes
    more: bytes
    vlrs: list[tuple[bytes, bytes, bytes]]  #: key, head without length, data
    padding: bytes
    points: np.ndarray  #: (n, bytes), decompressed
    evlrs: list[tuple[bytes, bytes, bytes]]
    waveforms: bytes


def take_apart(data: bytes) -> Parts:
    """Return the parts of a file."""
    size, offset, count, kind, length, points = struct.unpack_from("<HIIBHI", data, 94)
    minor = data[25]
    after = late = 0
    if minor >= 4:
        after, late, points = struct.unpack_from("<QIQ", data, 235)
    vlrs, at, coding = [], size, b""
    for _ in range(count):
        (n,) = struct.unpack_from("<H", data, at + 20)
        key, body = data[at + 2 : at + 20], data[at + 54 : at + 54 + n]
        if key[:14] == b"laszip encoded":
            coding = body
        vlrs.append((key, data[at : at + 20] + data[at + 22 : at + 54], body))
        at += 54 + n
    if kind & 0x80:
        raw = np.empty((points, length), np.uint8)
        stream = io.BytesIO(data)
        stream.seek(offset)
        lazrs.LasZipDecompressor(stream, coding).decompress_many(raw.reshape(-1))
    else:
        raw = np.frombuffer(data, np.uint8, points * length, offset).reshape(points, length)
    evlrs, place = [], after
    for _ in range(late):
        (n,) = struct.unpack_from("<Q", data, place + 20)
        evlrs.append(
            (
                data[place + 2 : place + 20],
                data[place : place + 20] + data[place + 28 : place + 60],
                data[place + 60 : place + 60 + n],
            )
        )
        place += 60 + n
    waves = struct.unpack_from("<Q", data, 227)[0] if minor >= 3 else 0
    standard = HEADER_BYTES[minor]
    return Parts(
        data[:standard],
        data[standard:size],
        vlrs,
        data[at:offset],
        raw,
        evlrs,
        data[waves:] if waves else b"",
    )


#: Bytes of the header that follow from the points and records.
_FREE = [*range(96, 107), *range(227, 247)]


def size_of(entry: bytes) -> int:
    """Return how many bytes of a point a description is about."""
    kind = entry[2]
    return ((kind - 1) // 10 + 1) * SIZES[(kind - 1) % 10] if kind else entry[3]


def assert_copy(
    before: bytes, after: bytes, added: dict[str, tuple[int, int]]
) -> dict[str, np.ndarray]:
    """Check that a file is a copy of another, but for what may change; return the new dimensions.

    `added` maps the names of appended dimensions, in order, to their type and size in bytes.
    """
    old, new = take_apart(before), take_apart(after)
    head = [
        (a, b) for n, (a, b) in enumerate(zip(old.head, new.head, strict=True)) if n not in _FREE
    ]
    assert all(a == b for a, b in head)
    assert (old.more, old.padding, old.waveforms) == (new.more, new.padding, new.waveforms)
    special = (b"laszip encoded", b"LASF_Spec\0\0\0\0\0\0\0\4\0", b"copc")
    for a, b in ((old.vlrs, new.vlrs), (old.evlrs, new.evlrs)):
        kept = [[each for each in side if not each[0].startswith(special)] for side in (a, b)]
        assert kept[0] == kept[1]
    entries = []
    for side in (old, new):
        data = b"".join(e[2] for e in (*side.vlrs, *side.evlrs) if e[0].startswith(special[1]))
        entries.append([data[k : k + 192] for k in range(0, len(data), 192)])
    if added:
        assert entries[1][: len(entries[0])] == entries[0]
        described = sum(map(size_of, entries[1][: -len(added)]))
        assert described == old.points.shape[1] - POINT_BYTES[old.head[104] & 0x3F]
        names = [each[4:36].split(b"\0")[0].decode() for each in entries[1][-len(added) :]]
        kinds = [each[2] for each in entries[1][-len(added) :]]
        assert (names, kinds) == ([*added], [kind for kind, _ in added.values()])
    else:
        assert entries[0] == entries[1]
    pf, width = old.head[104] & 0x3F, old.points.shape[1]
    assert new.points.shape == (len(old.points), width + sum(size for _, size in added.values()))
    at = 15 if pf < 6 else 16
    same = np.ones(width, bool)
    same[at] = False
    assert np.array_equal(old.points[:, same], new.points[:, :width][:, same])
    if pf < 6:
        assert np.array_equal(old.points[:, at] & 0xE0, new.points[:, at] & 0xE0)
    values = {"Classification": new.points[:, at] & (0x1F if pf < 6 else 0xFF)}
    for name, (kind, size) in added.items():
        raw = np.ascontiguousarray(new.points[:, width : width + size])
        values[name] = raw.view({9: "<f4", 10: "<f8", 1: "u1"}[kind])[:, 0]
        width += size
    return values
