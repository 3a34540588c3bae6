"""The table of chunks at the end of a LAZ file, decoded and held against the file.

PDAL from 2.7 on waits forever for a point that no chunk of the table holds, and ends the process where the
table leads it astray. Layout: "LAZ specification 1.4", chunk table; coding: A. Said, Introduction to Arithmetic
Coding, HP Labs HPL-2004-76.
"""

from __future__ import annotations

import struct
from bisect import bisect_right

#: More chunks than this (ten billion points in chunks of the usual size) are not decoded one by one.
MOST_DECODED = 200_000
#: Points of a chunk; 50,000 are usual.
_LARGEST = 2**24
_TOP = 2**32


def what_is_wrong(
    table: bytes, room: int, *, points: int, point_bytes: int, chunk_points: int | None
) -> tuple[str, str] | None:
    """Why a chunk table cannot be right: (what, found); None where it can.

    Parameters
    ----------
    table : bytes
        The file from the table on.
    room : int
        Bytes between the place of the first chunk and the table.
    points, point_bytes : int
        As the file's header has them.
    chunk_points : int or None
        Points of every chunk but the last; None where the table tells for each.
    """
    if len(table) < 8:
        return "it is cut short", f"{len(table)} bytes of its table of chunks"
    version, count = struct.unpack_from("<II", table)
    if version:
        return "its table of chunks is of an unknown version", str(version)
    if chunk_points is not None and chunk_points > _LARGEST:  # for which lazrs takes memory at once
        return "its chunks are larger than any program makes them", f"{chunk_points:,} points"
    if count * point_bytes > room:  # a chunk begins with a whole point
        return "it has more chunks than there is room for", f"{count:,} chunks in {room:,} bytes"
    if count > MOST_DECODED:
        return None
    try:
        sizes, counts = decode(table[8:], count, variable=chunk_points is None)
    except EOFError:
        return "it is cut short", f"its table of {count:,} chunks does not end"
    if sum(sizes) != room:
        return "its chunks do not fill the file", f"{sum(sizes):,} bytes in chunks, {room:,} bytes there"
    held = count * chunk_points if chunk_points is not None else sum(counts)
    if held < points:
        return "it has fewer points than its header counts", f"at most {held:,} of {points:,}"
    if chunk_points is None and held > points:
        return "its chunks hold more points than its header counts", f"{held:,}, not {points:,}"
    return None


def decode(data: bytes, count: int, *, variable: bool) -> tuple[list[int], list[int]]:
    """Bytes of each chunk, and its points where they vary.

    Raises
    ------
    EOFError
        If the data end before the table does.
    """
    if not count:
        return [], []
    decoder = _Decoder(data)
    of_counts, of_sizes = _Whole(decoder), _Whole(decoder)
    of_sizes.corrections, of_sizes.bit = of_counts.corrections, of_counts.bit
    sizes, counts = [], []
    for _ in range(count):
        if variable:
            counts.append(of_counts.read())
        sizes.append(of_sizes.read())
    return sizes, counts


class _Symbols:
    """Adaptive frequencies of a set of symbols."""

    limit, shift = 2**15, 15

    def __init__(self, number: int) -> None:
        self.counts = [1] * number
        self.total = 0
        self._update(number)
        self.cycle = self.left = (number + 6) >> 1

    def _update(self, seen: int) -> None:
        self.total += seen
        if self.total > self.limit:
            self.counts = [(n + 1) >> 1 for n in self.counts]
            self.total = sum(self.counts)
        scale, below = 2**31 // self.total, 0
        self.starts = []
        for n in self.counts:
            self.starts.append((scale * below) >> (31 - self.shift))
            below += n

    def saw(self, symbol: int) -> None:
        self.counts[symbol] += 1
        self.left -= 1
        if not self.left:
            self._update(self.cycle)
            self.cycle = self.left = min((5 * self.cycle) >> 2, (len(self.counts) + 6) << 3)


class _Bit:
    """Adaptive frequency of a bit."""

    def __init__(self) -> None:
        self.zeros, self.total, self.share = 1, 2, 2**12
        self.cycle = self.left = 4

    def saw(self, bit: int) -> None:
        self.zeros += not bit
        self.left -= 1
        if not self.left:
            self.total += self.cycle
            if self.total > 2**13:
                self.total, self.zeros = (self.total + 1) >> 1, (self.zeros + 1) >> 1
                self.total += self.zeros == self.total
            self.share = (self.zeros * (2**31 // self.total)) >> 18
            self.cycle = self.left = min((5 * self.cycle) >> 2, 64)


class _Decoder:
    """Arithmetic decoding of bytes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        self._length = _TOP - 1
        self._value = 0
        for _ in range(4):
            self._value = self._value << 8 | self._byte()

    def _byte(self) -> int:
        if self._at >= len(self._data):
            raise EOFError
        self._at += 1
        return self._data[self._at - 1]

    def _narrow(self, start: int, length: int) -> None:
        self._value -= start
        self._length = length
        while self._length < 2**24:
            self._value = (self._value << 8 | self._byte()) % _TOP
            self._length = max(self._length << 8, 1) % _TOP

    def symbol(self, model: _Symbols) -> int:
        before, unit = self._length, self._length >> model.shift
        found = bisect_right(model.starts, self._value // unit) - 1
        start = model.starts[found] * unit
        end = model.starts[found + 1] * unit if found + 1 < len(model.starts) else before
        self._narrow(start, end - start)
        model.saw(found)
        return found

    def bit(self, model: _Bit) -> int:
        split = model.share * (self._length >> 13)
        found = int(self._value >= split)
        self._narrow(split if found else 0, self._length - split if found else split)
        model.saw(found)
        return found

    def raw(self, bits: int) -> int:
        if bits > 19:
            low = self.raw(16)
            return self.raw(bits - 16) << 16 | low
        unit = self._length >> bits
        found = self._value // unit
        self._narrow(found * unit, unit)
        return found


class _Whole:
    """Whole numbers of 32 bits, each coded as its difference from the one before."""

    def __init__(self, decoder: _Decoder) -> None:
        self._decoder = decoder
        self._intervals = _Symbols(33)
        self.corrections = [_Symbols(1 << min(bits, 8)) for bits in range(1, 33)]
        self.bit = _Bit()
        self._last = 0

    def read(self) -> int:
        self._last = (self._last + self._correction()) % _TOP
        return self._last

    def _correction(self) -> int:
        bits = self._decoder.symbol(self._intervals)
        if bits == 0:
            return self._decoder.bit(self.bit)
        if bits == 32:
            return -(2**31)
        high = self._decoder.symbol(self.corrections[bits - 1])
        if bits > 8:
            high = high << (bits - 8) | self._decoder.raw(bits - 8)
        return high + 1 if high >= 1 << (bits - 1) else high - (1 << bits) + 1
