"""Records of the reference system come out as they went in, where nothing changed it."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from robustness.writing_faults import WKT

from pdal_stages.base.lascheck import check_readable
from pdal_stages.base.projection import projection_of, put_back
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.tiling import run_tiled

HAG = {"type": "filters.hag_minima"}
#: ETRS89 / UTM 32N, with a citation in words of its own: version, key, place, count, value.
KEYS = np.array([1, 1, 0, 3, 1024, 0, 1, 1, 1026, 34737, 12, 0, 3072, 0, 1, 25832], np.uint16)


def write(path, kind="wkt", points=400, seed=0):
    """A file with records, a private one between them, and an extra dimension."""
    modern = kind == "wkt"
    header = laspy.LasHeader(point_format=6 if modern else 3, version="1.4" if modern else "1.2")
    header.scales, header.offsets = np.full(3, 0.01), [500_000, 5_400_000, 0]
    header.add_extra_dim(laspy.ExtraBytesParams("Amplitude", "f4"))
    if modern:
        header.global_encoding.wkt = True
        mine = [laspy.VLR("LASF_Projection", 2112, "of my own program", WKT.encode() + bytes(3))]
    else:
        mine = [
            laspy.VLR("LASF_Projection", 34735, "by hand", KEYS.tobytes()),
            laspy.VLR("LASF_Projection", 34737, "by hand", b"My own grid|\0"),
        ]
    header.vlrs.extend([mine[0], laspy.VLR("me", 7, "notes", b"between"), *mine[1:]])
    rng = np.random.default_rng(seed)
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(points, header=header))
    las.x, las.y = rng.uniform(0, 59.9, (2, points)) + np.array([[500_000], [5_400_000]])
    las.z, las.Amplitude = rng.normal(0, 0.1, points), rng.random(points)
    las.write(path)
    return path


def points_of(path):
    las = laspy.read(path)
    return {name: np.asarray(las[name]).tobytes() for name in ("X", "Y", "Z", "Amplitude", "gps_time")}


@pytest.mark.pdal
@pytest.mark.parametrize("tiles", [None, "file", "tile"])
@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("kind", ["wkt", "geotiff"])
def test_records_come_out_as_they_went_in(tmp_path, kind, suffix, tiles):
    source, out = write(tmp_path / "in.laz", kind), tmp_path / f"o_#.{suffix}"
    stages = [
        {"type": "readers.las", "filename": str(source), "use_eb_vlr": True},
        HAG,
        {"type": "writers.las", "filename": str(out), "forward": "all", "extra_dims": "all"},
    ]
    if tiles:
        assert not run_tiled(stages, 10_000, workers=0, per=tiles).failures
    else:
        Pipeline(stages).execute()
    (made,) = tmp_path.glob("o_*")
    assert projection_of(made) == projection_of(source)
    check_readable(made)
    if tiles != "tile":
        assert points_of(made) == points_of(source)
    records = {(v.user_id, v.record_id) for v in laspy.read(made).header.vlrs}
    assert ("me", 7) in records and ("LASF_Spec", 4) in records
    again = Pipeline([str(made)])  # PDAL reads it
    assert again.execute() == 400
    assert "UTM zone 32N" in str(again.metadata["metadata"]["readers.las"])


@pytest.mark.pdal
@pytest.mark.parametrize(
    "change", ["filter", "writer", "reader", "other input", "newer format", "without forward", "plain"]
)
def test_where_the_reference_may_be_another_it_is_pdals(tmp_path, change):
    source, out = write(tmp_path / "in.las", "geotiff"), tmp_path / "o.las"
    reader = {"type": "readers.las", "filename": str(source)}
    stages = [reader, HAG, {"type": "writers.las", "filename": str(out), "forward": "all"}]
    if change == "filter":
        stages.insert(2, {"type": "filters.reprojection", "out_srs": "EPSG:25833"})
    elif change == "writer":
        stages[-1]["a_srs"] = "EPSG:25833"
    elif change == "reader":
        reader["override_srs"] = "EPSG:25832"
    elif change == "other input":
        Pipeline(
            [
                str(source),
                {"type": "writers.las", "filename": str(tmp_path / "two.las"), "a_srs": "EPSG:25832"},
            ]
        ).execute()
        stages.insert(0, str(tmp_path / "two.las"))
    elif change == "newer format":
        stages[-1] |= {"minor_version": 4, "dataformat_id": 6}
    elif change == "without forward":
        del stages[-1]["forward"]
    else:
        del stages[1]
    Pipeline(stages).execute()
    made = projection_of(out)
    assert made is not None and made != projection_of(source)
    assert not any(b"by hand" in record for record in made.records)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_keeps_all_else(tmp_path, compressed):
    """Also where records follow the points, and where there were none before."""
    path = write(tmp_path / f"a.{'laz' if compressed else 'las'}")
    las = laspy.read(path)
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("me", 9, "after", b"x" * 100)])
    las.write(path)
    wanted, before = projection_of(path), points_of(path)
    las.vlrs.extract("WktCoordinateSystemVlr")
    las.write(path)
    assert projection_of(path) is None and put_back(path, wanted) and projection_of(path) == wanted
    assert points_of(path) == before
    after = laspy.read(path).evlrs
    assert [(v.user_id, v.record_id, v.record_data_bytes()) for v in after] == [("me", 9, b"x" * 100)]
    check_readable(path)
    assert not put_back(path, wanted)  # has them
    other = write(tmp_path / "b.las", "geotiff")
    assert not put_back(other, wanted) and not put_back(path, projection_of(other))
