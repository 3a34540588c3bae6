"""What newer versions of PDAL and python-pdal bring: each test knows which it needs, and says so where it skips."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from block_scene import ground_and_block

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.terrain import hag_minima

pytestmark = pytest.mark.pdal
HAG = {"type": "filters.hag_minima"}


def needs(*version: int) -> None:
    """Skip below a version of PDAL."""
    if pdal_env.version() < version:
        wanted, result = (".".join(map(str, v)) for v in (version, pdal_env.version()))
        pytest.skip(f"needs PDAL {wanted}, found {result}")


def scene(n=2000, seed=3):
    return {
        **ground_and_block(n, seed, 50.0, at=(500_000, 5_400_000, 100)),
        "Intensity": np.random.default_rng(seed).integers(0, 999, n).astype(np.uint16),
        "GpsTime": np.arange(n, dtype=float),
        "Mine": np.arange(n, dtype=np.int32),
    }


@pytest.fixture()
def cloud(tmp_path, write_las):
    return write_las(tmp_path / "in.laz", scene(), point_format=6, scale=0.01)


def heights(las):
    return hag_minima(np.asarray(las.x), np.asarray(las.y), np.asarray(las.z))


# ---- formats -----------------------------------------------------------------------------------------------


def test_copc_is_written(cloud, tmp_path):
    """With the header and the extra dimensions of the input and ours, and still a COPC file afterwards."""
    needs(2, 4, 0)
    out = tmp_path / "out.copc.laz"
    writer = {"type": "writers.copc", "filename": str(out), "forward": "all", "extra_dims": "all"}
    ps.run_pipeline(
        [{"type": "readers.las", "filename": str(cloud), "use_eb_vlr": True}, HAG, writer]
    )
    before, after = laspy.read(cloud), laspy.read(out)
    assert any(v.user_id == "copc" for v in after.header.vlrs)
    assert not list(tmp_path.glob(".*"))
    order, other = np.argsort(before.gps_time), np.argsort(after.gps_time)
    for name in ("X", "Y", "Z", "intensity", "classification", "Mine"):
        assert np.array_equal(np.asarray(after[name])[other], np.asarray(before[name])[order]), name
    assert np.allclose(
        np.asarray(after["HeightAboveGround"])[other], heights(before)[order], atol=1e-5
    )
    part = [
        {
            "type": "readers.copc",
            "filename": str(out),
            "bounds": "([500000,500010],[5400000,5400010])",
        },
        HAG,
    ]
    read = ps.run_pipeline(part).arrays[0]
    assert 0 < len(read) < len(before) and read["X"].max() <= 500_010
    damaged = bytearray(out.read_bytes())
    damaged[429 + 48] ^= 1  # the size of the first page
    out.write_bytes(damaged)
    for read in (str(out), part[0]):
        with pytest.raises(StageError, match="the octree of the COPC file is damaged"):
            ps.run_pipeline([read])


# ---- python-pdal -------------------------------------------------------------------------------------------


def test_what_cannot_stream_says_so(cloud, pdal_module):
    """Our stages see all points at once: python-pdal's iterators refuse, and the process goes on."""
    pipeline = pdal_module.Reader.las(str(cloud)) | ps.Filter.hag_minima()
    assert not pipeline.streamable
    with pytest.raises(RuntimeError, match="stream"):
        list(pipeline.iterator(chunk_size=100))
    assert pipeline.execute() == 2000


def test_every_join_that_python_pdal_lets_us_have(cloud, pdal_module):
    """With | between its objects and ours, on either side."""
    head, reader = pdal_module.Filter.head(count=5), pdal_module.Reader.las(str(cloud))
    assert (pdal_module.Pipeline([reader]) | ps.Filter.hag_minima() | head).execute() == 5
    assert (reader | (ps.Filter.hag_minima() | head)).execute() == 5
    grown = reader.pipeline()
    grown |= ps.Filter.hag_minima()
    assert grown.execute() == 2000
    for nothing in (3, "in.laz"):
        with pytest.raises(TypeError):
            ps.Filter.hag_minima() | nothing
