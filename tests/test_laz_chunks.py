"""The chunk tables of LAZ files."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base import chunks
from pdal_stages.base.lascheck import check_readable

lazrs = pytest.importorskip("lazrs")
NUMBERS = st.integers(0, 2**31 - 1) | st.integers(0, 300) | st.sampled_from([50_000, 2**16, 2**24 - 1])


def written(table: list[tuple[int, int]], variable: bool) -> bytes:
    """A chunk table of (points, bytes) by lazrs."""
    file = io.BytesIO()
    lazrs.write_chunk_table(file, table, lazrs.LazVlr.new_for_compression(3, 0, variable))
    return file.getvalue()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(NUMBERS, NUMBERS), max_size=40), st.booleans())
def test_a_table_is_read_as_it_was_written(table, variable):
    data = written(table, variable)
    assert struct.unpack_from("<II", data) == (0, len(table))
    sizes, counts = chunks.decode(data, variable=variable)
    assert sizes == [size for _, size in table]
    assert counts == ([count for count, _ in table] if variable else [])


def test_a_long_table():
    rng = np.random.default_rng(0)
    table = [(50_000, int(n)) for n in rng.normal(3e5, 3e4, 5000)]
    assert chunks.decode(written(table, False), variable=False)[0] == [size for _, size in table]


def test_what_is_wrong():
    table = [(100, 2000), (60, 1300), (40, 900)]
    data = written(table, True)
    said = {"points": 200, "point_bytes": 20, "chunk_points": None}
    assert chunks.what_is_wrong(data, 4200, **said) is None
    assert "fill the file" in chunks.what_is_wrong(data, 4201, **said)[0]
    assert "fewer points" in chunks.what_is_wrong(data, 4200, **{**said, "points": 201})[0]
    assert "more chunks" in chunks.what_is_wrong(data, 4200, **{**said, "point_bytes": 1401})[0]
    assert "unknown version" in chunks.what_is_wrong(b"\1" + data[1:], 4200, **said)[0]
    fixed = written(table, False)
    assert chunks.what_is_wrong(fixed, 4200, points=300, point_bytes=20, chunk_points=100) is None
    wrong = chunks.what_is_wrong(fixed, 4200, points=301, point_bytes=20, chunk_points=100)
    assert wrong == ("it has fewer points than its header counts", "at most 300 of 301")


def test_a_beginning_that_no_encoder_writes():
    data = bytearray(written([(100, 2000)], True))
    data[8:12] = b"\xff" * 4
    said = {"points": 100, "point_bytes": 20, "chunk_points": None}
    assert chunks.what_is_wrong(bytes(data), 2000, **said)[0] == "it is cut short"


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 40), st.integers(0, 255))
def test_any_damage_is_an_answer(place, byte):
    """No damage of a table makes the check raise; cut anywhere, the table is refused."""
    data = bytearray(written([(100, 2000 + 37 * i) for i in range(12)], True))
    room = sum(2000 + 37 * i for i in range(12))
    said = {"points": 1200, "point_bytes": 20, "chunk_points": None}
    assert chunks.what_is_wrong(bytes(data), room, **said) is None
    assert chunks.what_is_wrong(bytes(data[: place % (len(data) - 3)]), room, **said)
    data[place % len(data)] = byte
    chunks.what_is_wrong(bytes(data), room, **said)


@pytest.mark.data
def test_real_files(data_dir):
    files = sorted(data_dir.rglob("*.laz"))
    assert files
    for path in files:
        assert check_readable(path) is None, path
