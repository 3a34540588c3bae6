"""LAZ files as writers leave them after a write that failed: a hole of zeros, or bytes lost and the rest moved up."""

from __future__ import annotations

import json
import struct
import subprocess

import numpy as np
import pytest

from pdal_stages.base.chunks import laz_chunks
from pdal_stages.base.complete import check_complete
from pdal_stages.base.errors import StageError
from pdal_stages.base.las import read_header
from pdal_stages.base.lascheck import check_readable
from pdal_stages.base.readback import chunks_are_whole

COUNT = 120_000
FORMATS = (0, 1, 3, 6, 7, 8)


def cloud(kind: str, count: int = COUNT) -> dict:
    rng = np.random.default_rng(5)
    if kind == "one place":
        xyz = np.full((count, 3), 7.5)
    elif kind == "ends in one place":
        xyz = np.vstack([rng.uniform(0, 100, (count // 100, 3)), np.full((count - count // 100, 3), 7.5)])
    else:
        xyz = rng.uniform(0, 100, (count, 3))
    arrays = dict(zip("XYZ", xyz.T, strict=True))
    if kind == "with features":
        arrays |= {"Rel": xyz[:, 2].astype("f4"), "Label": rng.integers(0, 9, count).astype("u1")}
    return arrays


@pytest.mark.parametrize("point_format", FORMATS)
@pytest.mark.parametrize("kind", ["scattered", "with features", "one place", "ends in one place"])
def test_whole_files_are_taken(tmp_path, write_las, point_format, kind):
    path = write_las(tmp_path / "a.laz", cloud(kind), point_format)
    assert chunks_are_whole(path, read_header(path))


@pytest.mark.pdal
@pytest.mark.parametrize("count", [1, 2, 3, 49_999, 50_000, 50_001])
def test_whole_files_of_pdal_are_taken(tmp_path, pdal_program, count):
    for point_format in FORMATS:
        path = tmp_path / f"{point_format}.laz"
        version = {"minor_version": 2 if point_format < 6 else 4, "dataformat_id": point_format}
        for mode in ("ramp", "constant", "uniform"):
            faux = {"type": "readers.faux", "count": count, "mode": mode, "bounds": "([1,100],[1,100],[1,9])"}
            stages = [
                faux,
                {"type": "writers.las", "filename": str(path), "extra_dims": "OffsetTime=uint32", **version},
            ]
            (tmp_path / "job.json").write_text(json.dumps(stages))
            subprocess.run([pdal_program, "pipeline", tmp_path / "job.json"], check=True)
            assert check_complete(path, path, stages[1], count), (point_format, mode)


@pytest.mark.data
def test_whole_files_of_others_are_taken(data_dir):
    paths = sorted(data_dir.glob("*/*.laz"))
    assert paths and all(chunks_are_whole(path, read_header(path)) for path in paths)


@pytest.mark.parametrize("point_format", FORMATS)
def test_a_hole_before_the_table_is_seen(tmp_path, write_las, point_format):
    for kind in ("with features", "scattered"):
        path = write_las(tmp_path / "a.laz", cloud(kind), point_format)
        found = laz_chunks(path, read_header(path))
        end = found.begin + sum(found.sizes)
        content = path.read_bytes()
        for length in (40, 200, 5_000, 65_536, found.sizes[-1], found.sizes[-1] + 100, sum(found.sizes[1:])):
            path.write_bytes(content[: end - length] + bytes(length) + content[end:])
            try:
                check_readable(path)  # which looks at header, table and the last chunk's own count
            except StageError:
                continue
            assert not chunks_are_whole(path, read_header(path)), (kind, length)


def test_a_hole_over_points_of_one_place_is_seen(tmp_path, write_las):
    for point_format in (3, 7):
        path = write_las(tmp_path / "a.laz", cloud("one place"), point_format)
        found = laz_chunks(path, read_header(path))
        end, content = found.begin + sum(found.sizes), path.read_bytes()
        for length in (found.sizes[-1], sum(found.sizes[1:])):
            path.write_bytes(content[: end - length] + bytes(length) + content[end:])
            assert not chunks_are_whole(path, read_header(path)), (point_format, length)


@pytest.mark.parametrize("point_format", FORMATS)
def test_lost_bytes_are_seen(tmp_path, write_las, point_format):
    """The table as PDAL writes it then: chunks that end beyond the loss are told to be shorter."""
    import lazrs

    path = write_las(tmp_path / "a.laz", cloud("with features"), point_format)
    header, content = read_header(path), path.read_bytes()
    found = laz_chunks(path, header)
    rng = np.random.default_rng(point_format)
    ends = found.begin + np.cumsum(found.sizes)
    for _ in range(25):
        begin = int(rng.integers(found.begin, ends[-1] - 10))
        lost = int(min(rng.choice([1, 7, 4096, 50_000]), ends[-1] - begin))
        # An end that is known before the loss, or after it.
        known = np.where(ends <= begin + lost * rng.integers(0, 2), ends, ends - lost)
        if (np.diff(known, prepend=found.begin) <= 0).any():
            continue
        table = _table(np.diff(known, prepend=found.begin), lazrs, found.record)
        data = content[found.begin : begin] + content[begin + lost : ends[-1]]
        head = content[: header.offset] + struct.pack("<q", found.begin + len(data))
        path.write_bytes(head + data + table)
        with pytest.raises(StageError, match="could not be written completely"):
            check_complete(path, path, {"type": "writers.las", "filename": str(path)}, COUNT)


def _table(sizes, lazrs, record: bytes) -> bytes:
    import io

    out = io.BytesIO()
    lazrs.write_chunk_table(out, [(0, int(size)) for size in sizes], lazrs.LazVlr(record))
    return out.getvalue()
