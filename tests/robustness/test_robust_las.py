"""LAS and LAZ files of every version and point format, damaged ones, and dimensions whose names are
ours."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest
from robustness_kit import HAG, job, las, scene
from test_robust_clouds import METERS

from pdal_stages.base.errors import StageError
from pdal_stages.pipeline.spatial_reference import reference_of, reference_of_file

pytestmark = pytest.mark.pdal

STAGES = [
    HAG,
    {"type": "filters.multiscalefeatures", "neighborhoods": "c1", "feature_set": "Linearity"},
]


def pipeline(tmp_path, source, model, *stages):
    """Heights, one feature, classes, to out.las with the input's version and point format."""
    reader = {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}
    stages = stages or (*STAGES, {"type": "filters.modelclassifier", "model": str(model)})
    return ["pipeline", job(tmp_path, reader, *stages, las(tmp_path / "out.las"))]


def check(tmp_path):
    out = laspy.read(tmp_path / "out.las")
    assert len(out) == 600 and np.isin(out.classification, [2, 6]).all()
    assert np.mean(np.asarray(out.classification) == scene()["Classification"]) > 0.8
    assert np.allclose(np.asarray(out["HeightAboveGround"]).max(), 5, atol=0.3)
    return out


# Each format in LAS 1.4, and the highest of each version.
FORMATS = [(0, 0), (0, 1), (1, 1), (2, 3), (3, 5), *((4, form) for form in range(11))]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("version", "point_format"), FORMATS)
def test_versions_and_formats(command, tmp_path, write_las, model, version, point_format, suffix):
    waves = point_format in (4, 5, 9, 10)
    if suffix == ".laz" and (waves or version <= 1):
        pytest.skip("lazrs and laspy do not write such LAZ")
    written = max(version, 3 if waves else 2)
    rng = np.random.default_rng(point_format)
    arrays = scene() | {
        "Intensity": rng.integers(0, 65535, 600),
        "UserData": rng.integers(0, 255, 600),
    }
    arrays |= {name: rng.random(600) < 0.1 for name in ("Synthetic", "KeyPoint", "Withheld")}
    if point_format not in (0, 2):
        arrays["GpsTime"] = rng.uniform(0, 1e6, 600)
    if point_format in (2, 3, 5, 7, 8, 10):
        arrays["Red"] = rng.integers(0, 65535, 600)
    how = {
        "point_format": point_format,
        "minor_version": written,
        "wkt": METERS if point_format > 5 else None,
    }
    source = write_las(
        tmp_path / f"in{suffix}", {**arrays, "Mine": np.arange(600, dtype=np.int32)}, **how
    )
    if version <= 1:
        data = bytearray(source.read_bytes())
        data[25] = version
        source.write_bytes(bytes(data))
    done = command(*pipeline(tmp_path, source, model))
    if waves:  # which no PDAL reads
        command.refused(done, "waveforms", "laspy.convert")
        return
    command.runs(done)
    out, before = check(tmp_path), laspy.read(source)
    for name in set(before.point_format.dimension_names) - {"classification"}:
        assert np.array_equal(np.asarray(out[name]), np.asarray(before[name])), name
    assert (
        out.header.point_format.id == point_format
        and out.header.parse_crs() == before.header.parse_crs()
    )
    assert np.array_equal(
        [out.header.scales, out.header.offsets], [before.header.scales, before.header.offsets]
    )
    # PDAL writes no LAS 1.0, newer PDAL LAS 1.4 where it is not told otherwise
    assert out.header.version.minor == version if version else out.header.version.minor in (2, 4)
    if version <= 1:
        command.runs(
            ["classify", source, tmp_path / "t.las", "--model", model, "--tile", 20, "--workers", 0]
        )
        assert len(laspy.read(tmp_path / "t.las")) == 600


def test_extra_bytes_of_every_type(command, tmp_path, write_las, model):
    kinds = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
    extra = {f"Mine_{kind}": np.arange(600).astype(kind) for kind in kinds}
    source = write_las(
        tmp_path / "in.las",
        {**scene(), **extra, "GpsTime": np.linspace(1e8, 1e8 + 5, 600)},
        point_format=6,
    )
    command.runs(pipeline(tmp_path, source, model))
    out = check(tmp_path)
    assert all(np.array_equal(out[name], values) for name, values in extra.items())
    assert np.array_equal(out.gps_time, np.linspace(1e8, 1e8 + 5, 600))


OURS = ["HeightAboveGround", "Reliability", "Linearity_c1", "Margin", "Probability_2"]


@pytest.mark.parametrize("kind", ["u1", "i8", "f8"])
def test_dimensions_named_like_ours(command, tmp_path, write_las, model, kind):
    """An earlier run's, or another program's: overwritten, with the fractions kept whatever the
    type was."""
    before = {name: np.full(600, 77).astype(kind) for name in OURS}
    classify = {
        "type": "filters.modelclassifier",
        "model": str(model),
        "margin": True,
        "probabilities": True,
    }
    words, outputs = pipeline(tmp_path, tmp_path / "in.las", model, *STAGES, classify), []
    for arrays in ({**scene(), **before}, scene()):
        write_las(tmp_path / "in.las", arrays, point_format=6)
        command.runs(words)
        outputs.append(check(tmp_path))
        (tmp_path / "out.las").unlink()
    out, fresh = outputs
    for name in OURS:
        # Heights kept in 64 bits can fall on the other side of a tree's threshold, for a point or
        # two.
        assert np.isclose(out[name], fresh[name], rtol=1e-6).mean() >= 0.99, name
    assert np.ptp(np.asarray(fresh["Linearity_c1"])) > 0.1


def test_a_height_of_another_type_and_where(command, tmp_path, write_las, model):
    """Points outside keep their value."""
    before = {"HeightAboveGround": np.full(600, 77, np.uint8)}
    source = write_las(tmp_path / "in.las", {**scene(), **before}, point_format=6)
    command.runs(pipeline(tmp_path, source, model, {**HAG, "where": "Classification == 2"}))
    height = np.asarray(laspy.read(tmp_path / "out.las")["HeightAboveGround"])
    ground = scene()["Classification"] == 2
    assert (height[~ground] == 77).all() and (height[ground] < 1).all()


# ---- damaged files -------------------------------------------------------------------------------------------


@pytest.fixture()
def good(tmp_path, write_las):
    return write_las(tmp_path / "in.las", scene(), point_format=3)


def damaged(path, edit):
    data = bytearray(path.read_bytes())
    changed = edit(data)
    path.write_bytes(bytes(data if changed is None else changed))
    return path


def header(name, value):
    places = {"count": ("<I", 107), "offset": ("<I", 96), "length": ("<H", 105), "format": ("<B", 104), "vlrs": ("<I", 100),
              "minor": ("<B", 25), "signature": ("<4s", 0), "scale": ("<d", 131), "header": ("<H", 94)}  # fmt: skip
    kind, at = places[name]
    return lambda data: struct.pack_into(kind, data, at, value)


def table(data) -> int:
    """Return the offset of the chunk table of a LAZ file."""
    return struct.unpack_from("<q", data, struct.unpack_from("<I", data, 96)[0])[0]


def after(number=1, place=None, length=10):
    """Give the records after the points another number, place or length; with one good record at
    the end."""

    def edit(data):
        end = len(data)
        data += struct.pack("<H16sHQ32s", 0, b"test", 1, length, b"") + bytes(10)
        struct.pack_into("<QI", data, 235, end if place is None else place, number)

    return edit


def zero(data):
    """The header that a program leaves that ends before it is done."""
    struct.pack_into("<I", data, 107, 0)
    struct.pack_into("<Q", data, 247, 0)
    if data[104] & 0xC0:
        struct.pack_into("<q", data, struct.unpack_from("<I", data, 96)[0], -1)


#: file and its point format, edit, what the message must hold
DAMAGED = {
    "empty": (".las 3", lambda d: b"", "not a LAS file"),
    "cut in the header": (".las 3", lambda d: d[:100], "not a LAS file"),
    "a text file": (".las 3", lambda d: b"X Y Z\n1 2 3\n" * 50, "not a LAS file"),
    "cut in the points": (".las 3", lambda d: d[: len(d) // 2], "it is cut short"),
    "four billion points in the header": (".las 3", header("count", 2**32 - 1), "it is cut short"),
    "points that begin beyond the end": (".las 3", header("offset", 10**9), "it is cut short"),
    "points that begin in the header": (".las 3", header("offset", 10), "inside the header"),
    "point length of 0": (".las 3", header("length", 0), "shorter than their format"),
    "point format 77": (".las 3", header("format", 77 & 63), "point format is not known"),
    "version 1.9": (".las 3", header("minor", 9), "version is not known"),
    "a million records before the points": (".las 3", header("vlrs", 10**6), "more records than there is room for"),
    "scale of NaN": (".las 3", header("scale", float("nan")), "not valid numbers"),
    "a scale that is no length": (".las 6", lambda d: d.__setitem__(slice(149, 155), bytes(6)), "not valid numbers"),
    "header of an older version": (".las 6", header("header", 227), "its header is too short"),
    "four billion records after the points": (".las 6", after(2**32 - 1), "not where it says"),
    "records after the points at byte 0": (".las 6", after(place=0), "not where it says"),
    "records after the points at 2^64 - 1": (".las 6", after(place=2**64 - 1), "not where it says"),
    "a record of 2^62 bytes after the points": (".las 6", after(length=2**62), "do not end within"),
    "no points in the header": (".las 6", zero, "counts no points, but the file holds some"),
    "LAZ: cut in the points": (".laz 3", lambda d: d[: len(d) // 2], "it is cut short"),
    "LAZ: cut in the chunk table": (".laz 3", lambda d: d[:-4], "LAS file"),
    "LAZ: chunk table beyond the end": (".laz 3", lambda d: struct.pack_into("<q", d, struct.unpack_from("<I", d, 96)[0], 10**12), "cut short"),
    "LAZ: more points in the header": (".laz 3", header("count", 60_000), "60,000 counted, 50,000 held"),
    "LAZ: a million chunks": (".laz 3", lambda d: struct.pack_into("<I", d, table(d) + 4, 10**6), "more chunks than there is room for"),
    "LAZ: no chunks": (".laz 3", lambda d: struct.pack_into("<I", d, table(d) + 4, 0), "do not fill the file"),
    "LAZ: chunk table of version 7": (".laz 3", lambda d: struct.pack_into("<I", d, table(d), 7), "unknown version"),
    "LAZ: another size in the chunk table": (".laz 3", lambda d: d.__setitem__(table(d) + 9, d[table(d) + 9] ^ 0x40), "LAS file"),
    "LAZ: no record of the compression": (".laz 3", lambda d: d.__setitem__(d.index(b"laszip "
                                                                                    b"encoded"), ord("k")), "no record of how"),
    "LAZ: no points in the header": (".laz 6", zero, "counts no points, but the file holds some"),
    "LAZ: another count in the header": (".laz 6", lambda d: struct.pack_into("<Q", d, 247, 599), "599 counted, 600 held"),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged(command, tmp_path, write_las, model, case):
    kind, edit, says = DAMAGED[case]
    suffix, point_format = kind.split()
    source = damaged(
        write_las(tmp_path / f"in{suffix}", scene(), point_format=int(point_format)), edit
    )
    command.refused(pipeline(tmp_path, source, model), f"in{suffix}", says)
    if case in ("cut in the points", "a text file", "LAZ: another count in the header"):
        path = job(tmp_path, source, HAG, tmp_path / "out.las")
        done = command("pipeline", path, "--tile", "20", "--workers", 0)
        command.before = command.files()  # the marks of the run stay, for --resume
        command.refused(done, f"in{suffix}", "not a LAS or LAZ file" if "text" in case else says)
        assert not (tmp_path / "out.las").exists()


@pytest.mark.parametrize(("version", "at", "end"), [(2, 179, 227), (4, 255, 375)])
def test_a_header_torn_behind_its_count(command, tmp_path, write_las, model, version, at, end):
    """All points are there; what else is not is told: the box."""
    source = write_las(tmp_path / "in.las", scene(), point_format=3 if version == 2 else 6)
    damaged(source, lambda d: d.__setitem__(slice(at, end), bytes(end - at)))
    done = command.runs(pipeline(tmp_path, source, model))
    assert ("its header is all zeros" in done.err) == (version == 2)
    assert len(laspy.read(tmp_path / "out.las")) == 600


def test_fewer_points_in_the_header(command, tmp_path, good, model):
    """The points of the header, and a warning on the bytes beyond."""
    damaged(good, header("count", 100))
    done = command.runs(pipeline(tmp_path, good, model, *STAGES))
    assert "bytes beyond the 100 points" in done.err
    assert len(laspy.read(tmp_path / "out.las")) == 100


def test_a_record_after_the_points(command, tmp_path, write_las, model):
    source = damaged(write_las(tmp_path / "in.las", scene(), point_format=6), after())
    command.runs(pipeline(tmp_path, source, model))
    check(tmp_path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_file_without_points(command, tmp_path, write_las, suffix):
    none = {name: values[:0] for name, values in scene().items()}
    source = write_las(tmp_path / f"in{suffix}", none, point_format=6)
    command.runs(pipeline(tmp_path, source, None, HAG))
    assert len(laspy.read(tmp_path / "out.las")) == 0


def test_cut_short_whoever_reads_it(tmp_path, write_las):
    """Newer PDAL crashes of such a file, so it is asked for nothing of it: not for a reference, nor
    for dimensions."""
    cut = damaged(write_las(tmp_path / "cut.laz", scene(5000)), lambda d: d[:-100])
    reader = {"type": "readers.las", "filename": str(cut), "count": 1}
    for read in (lambda: reference_of(reader), lambda: reference_of_file(str(cut))):
        with pytest.raises(StageError, match=r"cut\.laz: the LAS file is damaged: it is cut short"):
            read()
