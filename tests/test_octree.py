"""Octrees of COPC files and EPT sources that PDAL would crash of, walk without end, or leave points out of."""

from __future__ import annotations

import contextlib
import json
import struct

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.base.octrees import check_copc, check_ept

#: Where COPC's record and the points begin; bytes of a chunk; where they end.
INFO = 429
BEGIN = 589
CHUNK = 40
END = 757


def copc(part=0, field=5, value=END, entry=0) -> bytes:
    """Return what is looked at of a COPC file of four nodes, the last in a page of its own; with one number changed.

    `part`: 0 the record, 1 the first page, 2 the second.
    """
    keys = [(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 0, 1), (2, 3, 1, 2)]
    nodes = [[*key, BEGIN + 8 + n * CHUNK, CHUNK, 5 + n] for n, key in enumerate(keys)]
    pages = [*nodes[:3], [*keys[3], END + 128, 32, -1]], [nodes[3]]
    info = [50.0, 50.0, 50.0, 50.0, 1.0, END, 128]
    (pages[part - 1][entry] if part else info)[field] = value
    head = bytearray(BEGIN)
    struct.pack_into("<4s20xBB68xHIIBHI", head, 0, b"LASF", 1, 4, 375, BEGIN, 1, 6 | 0x80, 30, 0)
    struct.pack_into("<12d20xQ", head, 131, *[0.01] * 3, *[0.0] * 3, *[100.0, 0.0] * 3, 26)
    struct.pack_into("<2x16sHH32x5dQQ", head, 375, b"copc", 1, 160, *info)
    parts = [bytes(head), struct.pack("<Q", END)]
    parts += [bytes(30) + struct.pack("<I", 5 + n) + bytes(CHUNK - 34) for n in range(4)]
    return b"".join([*parts, *(struct.pack("<4iQ2i", *entry) for page in pages for entry in page)])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((1, 0, 5), "node (0, 0, 0, 0) is not in its page"), ((1, 0, 3, 1), "is in no other"),
        ((1, 1, 2, 2), "node (1, 2, 0, 1)"), ((1, 0, 2**31 - 1, 2), "node (2147483647, 1"), ((1, 6, -2, 1), "of -2 points"),
        ((1, 6, 7, 1), "7 points in 40 bytes"), ((1, 6, 0, 1), "7 points in 40 bytes"), ((1, 4, 2**63, 1), "7 points"),
        ((1, 5, 2**31 - 1, 1), "6 points"), ((2, 6, 0), "18 points, the header"), ((1, 5, -32, 3), "a page of -32"),
        ((1, 4, 2**62, 3), "a page of 32 bytes"), ((2, 6, -1), "is not in its page"), ((1, 4, END, 3), "twice"),
        ((0, 4, 0.0), "0 apart"), ((0, 0, np.nan), "around nan"), ((0, 3, 1.0), "a cube of 2"), ((0, 6, 31), "a page of 31"),
    ],
    ids=str,
)  # fmt: skip
def test_damaged_octrees_of_copc_files(tmp_path, change, says):
    path = tmp_path / "a.copc.laz"
    path.write_bytes(copc())
    check_copc(path)
    path.write_bytes(copc(*change))
    with pytest.raises(StageError, match="the octree of the COPC file is damaged") as caught:
        check_copc(path)
    assert says in str(caught.value)


def test_any_bytes_are_an_octree_or_an_error(tmp_path):
    rng, whole, path = np.random.default_rng(0), copc(), tmp_path / "a.copc.laz"
    for _ in range(500):
        data = bytearray(whole)
        for at in rng.choice(len(whole) - INFO, rng.integers(1, 4)) + INFO:
            data[at] = rng.integers(256)
        path.write_bytes(data)
        with contextlib.suppress(StageError):
            check_copc(path)


SCHEMA = [{"name": name, "type": "signed", "size": 4, "scale": 1, "offset": 0} for name in "XYZ"]
ABOUT = {"bounds": [0, 0, 0, 9, 9, 9], "boundsConforming": [0, 0, 0, 9, 9, 9], "points": 3, "schema": SCHEMA, "span": 128,
         "dataType": "binary", "hierarchyType": "json", "version": "1.0.0", "srs": {}}  # fmt: skip


@pytest.mark.pdal
@pytest.mark.parametrize(
    ("root", "page", "says"),
    [
        ({}, {}, ""), ({"a-b": 1}, {}, "invalid literal"), ({"1-../../x": 4}, {}, "invalid literal"),
        ({"1-1-1-1": 3}, {}, "No such"), ({"1-1-1-1": -1}, {}, "No such file"), ({}, {"1-0-1-0": -1}, "not in its page"),
        ({"0-0-0-0": 99999999999}, {}, "99,999,999,999 points in 0-0-0-0.bin, of 24 bytes"),
    ],
)  # fmt: skip
def test_damaged_hierarchies_of_ept_sources(tmp_path, root, page, says):
    (tmp_path / "ept-hierarchy").mkdir()
    pages = {"0-0-0-0": {"0-0-0-0": 2, "1-0-1-0": -1, **root}, "1-0-1-0": {"1-0-1-0": 1, **page}}
    for name, entries in pages.items():
        (tmp_path / f"ept-hierarchy/{name}.json").write_text(json.dumps(entries))
    (tmp_path / "ept-data").mkdir()
    (tmp_path / "ept-data/0-0-0-0.bin").write_bytes(struct.pack("<6i", *range(6)))
    (tmp_path / "ept-data/1-0-1-0.bin").write_bytes(struct.pack("<3i", 1, 500, 1))
    (tmp_path / "ept.json").write_text(json.dumps(ABOUT))
    reader = {"type": "readers.ept", "filename": str(tmp_path / "ept.json")}
    if not says:
        assert (
            check_ept(reader["filename"]) == ABOUT and len(ps.run_pipeline([reader]).arrays[0]) == 3
        )
        return
    with pytest.raises(StageError, match="the EPT source is damaged") as caught:
        ps.run_pipeline([reader])
    assert says in str(caught.value)
