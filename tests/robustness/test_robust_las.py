"""LAS and LAZ files of every version and point format, damaged ones, and dimensions whose names are ours."""

from __future__ import annotations

import struct
import subprocess

import laspy
import numpy as np
import pytest
from conftest import scene
from robustness_kit import job

pytestmark = pytest.mark.pdal

STAGES = [
    {"type": "filters.hag_minima"},
    {"type": "filters.multiscalefeatures", "neighborhoods": "c1", "feature_set": "Linearity"},
]


def pipeline(tmp_path, source, model, *stages, **writer):
    """Heights, one feature, classes, to out.las; "forward" keeps version and point format."""
    return job(
        tmp_path,
        {"type": "readers.las", "filename": str(source), "use_eb_vlr": True},
        *(stages or (*STAGES, {"type": "filters.modelclassifier", "model": str(model)})),
        {
            "type": "writers.las",
            "filename": str(tmp_path / "out.las"),
            "extra_dims": "all",
            "forward": "all",
            **writer,
        },
    )


def check(tmp_path, n=600):
    out = laspy.read(tmp_path / "out.las")
    assert len(out) == n
    assert (
        np.isin(out.classification, [2, 6]).all()
        and np.mean(np.asarray(out.classification) == scene()["Classification"]) > 0.8
    )
    assert np.allclose(np.asarray(out["HeightAboveGround"]).max(), 5, atol=0.3)
    return out


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("version", "point_format"),
    [
        (v, f)
        for v, top in ((0, 1), (1, 1), (2, 3), (3, 5), (4, 10))
        for f in range(top + 1)
        if v in (0, 4) or f == top
    ],
)
def test_versions_and_formats(cell, tmp_path, write_las, model, version, point_format, suffix):
    waves = point_format in (4, 5, 9, 10)
    if waves and suffix == ".laz":
        pytest.skip("lazrs does not write LAZ with wave packets")
    source = tmp_path / f"in{suffix}"
    if version <= 1 and suffix == ".laz":
        pytest.skip("laspy does not write LAZ of LAS 1.0 and 1.1")
    source = write_las(
        source,
        scene(),
        point_format=point_format,
        minor_version=max(version, 2) if not waves or version == 4 else 3,
    )
    if version <= 1:
        data = bytearray(source.read_bytes())
        data[25] = version
        source.write_bytes(bytes(data))
    it = cell("LAS files", f"LAS 1.{version}, point format {point_format}, {suffix[1:].upper()}")
    done = it.command("pipeline", pipeline(tmp_path, source, model))
    if waves:  # which no PDAL reads
        it.refused(done, "waveforms", "laspy.convert")
        return
    kept = version >= 1
    it.runs(
        done,
        "classes; version and point format are kept"
        if kept
        else "classes; written as LAS 1.2, as PDAL writes no LAS 1.0",
    )
    out = check(tmp_path)
    # newer PDAL writes LAS 1.4 where it is not told otherwise
    assert out.header.point_format.id == point_format
    assert out.header.version.minor == version if kept else out.header.version.minor in (2, 4)


@pytest.mark.parametrize("kind", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"])
def test_extra_bytes_of_every_type(cell, tmp_path, write_las, model, kind):
    values = np.arange(600).astype(kind)
    source = write_las(tmp_path / "in.las", {**scene(), "Mine": values}, point_format=6)
    cell("LAS files", f"extra bytes of type {np.dtype(kind).name}").runs(
        ["pipeline", pipeline(tmp_path, source, model)], "come out as they went in"
    )
    assert np.array_equal(check(tmp_path)["Mine"], values)


def test_scaled_extra_bytes(cell, tmp_path, model):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), [500_000, 5_400_000, 0]
    header.add_extra_dim(
        laspy.ExtraBytesParams(name="Scaled", type="i2", scales=np.array([0.01]), offsets=np.array([5.0]))
    )
    las = laspy.LasData(header)
    data = scene()
    las.x, las.y, las.z, las.classification = data["X"], data["Y"], data["Z"], data["Classification"]
    las["Scaled"] = np.arange(600) * 0.01
    las.write(tmp_path / "in.las")
    cell("LAS files", "extra bytes with a scale and an offset").runs(
        ["pipeline", pipeline(tmp_path, tmp_path / "in.las", model)], "come out with the same values"
    )
    assert np.allclose(check(tmp_path)["Scaled"], las["Scaled"])


OURS = ["HeightAboveGround", "Reliability", "Linearity_c1", "Margin", "Probability_2"]


@pytest.mark.parametrize("kind", ["u1", "i2", "u4", "i8", "f4", "f8"])
def test_dimensions_named_like_ours(cell, tmp_path, write_las, model, kind):
    """An earlier run's, or another program's: overwritten, with the fractions kept whatever the type was."""
    before = {name: np.full(600, 77).astype(kind) for name in OURS}
    source = write_las(tmp_path / "in.las", {**scene(), **before}, point_format=6)
    classify = {"type": "filters.modelclassifier", "model": str(model), "margin": True, "probabilities": True}
    it = cell("LAS files", f"dimensions named like ours of type {np.dtype(kind).name}")
    it.runs(
        ["pipeline", pipeline(tmp_path, source, model, *STAGES, classify)], "are overwritten, fractions kept"
    )
    out = check(tmp_path)
    clean = write_las(tmp_path / "in.las", scene(), point_format=6)
    (tmp_path / "out.las").unlink()
    it.command("pipeline", pipeline(tmp_path, clean, model, *STAGES, classify))
    fresh = check(tmp_path)
    for name in OURS:
        # Heights kept in 64 bits can fall on the other side of a tree's threshold, for a point or two.
        assert np.isclose(out[name], fresh[name], rtol=1e-6).mean() >= 0.99, name
    assert np.ptp(np.asarray(fresh["Linearity_c1"])) > 0.1


def test_a_height_of_another_type_and_where(cell, tmp_path, write_las, model):
    before = {"HeightAboveGround": np.full(600, 77, np.uint8)}
    source = write_las(tmp_path / "in.las", {**scene(), **before}, point_format=6)
    stage = {"type": "filters.hag_minima", "where": "Classification == 2"}
    cell("LAS files", "'where' over a dimension that is there already").runs(
        ["pipeline", pipeline(tmp_path, source, model, stage)], "points outside keep their value"
    )
    out = laspy.read(tmp_path / "out.las")
    ground = scene()["Classification"] == 2
    assert (np.asarray(out["HeightAboveGround"])[~ground] == 77).all()
    assert (np.asarray(out["HeightAboveGround"])[ground] < 1).all()


def test_only_gps_time(cell, tmp_path, write_las, model):
    source = write_las(
        tmp_path / "in.las", {**scene(), "GpsTime": np.linspace(1e8, 1e8 + 5, 600)}, point_format=1
    )
    cell("LAS files", "GPS time and no colors").runs(
        ["pipeline", pipeline(tmp_path, source, model)], "times are kept"
    )
    assert np.array_equal(check(tmp_path).gps_time, np.linspace(1e8, 1e8 + 5, 600))


# ---- damaged files -------------------------------------------------------------------------------------------


@pytest.fixture()
def good(tmp_path, write_las):
    return write_las(tmp_path / "in.las", scene(), point_format=3)


def damaged(path, edit):
    data = bytearray(path.read_bytes())
    path.write_bytes(bytes(edit(data) or data))
    return path


def header(name, value):
    places = {"count": ("<I", 107), "offset": ("<I", 96), "length": ("<H", 105), "format": ("<B", 104), "vlrs": ("<I", 100),
              "minor": ("<B", 25), "signature": ("<4s", 0), "scale": ("<d", 131), "header": ("<H", 94)}  # fmt: skip
    kind, at = places[name]

    def edit(data):
        struct.pack_into(kind, data, at, value)

    return edit


DAMAGED = [
    ("LAS: empty file", None),
    ("LAS: cut in the header", lambda d: d[:100]),
    ("LAS: cut in the points", lambda d: d[: len(d) // 2]),
    ("LAS: cut in the last point", lambda d: d[:-3]),
    ("LAS: more points in the header than in the file", header("count", 6000)),
    ("LAS: four billion points in the header", header("count", 2**32 - 1)),
    ("LAS: points that begin beyond the end", header("offset", 10**9)),
    ("LAS: points that begin in the header", header("offset", 10)),
    ("LAS: point length of 0", header("length", 0)),
    ("LAS: point length shorter than the format", header("length", 10)),
    ("LAS: point format 77", header("format", 77)),
    ("LAS: version 1.9", header("minor", 9)),
    ("LAS: another signature", header("signature", b"NOPE")),
    ("LAS: a million records before the points", header("vlrs", 10**6)),
    ("LAS: scale of NaN", header("scale", float("nan"))),
    ("LAS: scale of infinity", header("scale", float("inf"))),
    ("LAS: a text file named .las", lambda d: b"X Y Z\n1 2 3\n" * 50),
]


@pytest.mark.parametrize(("case", "edit"), DAMAGED, ids=[row[0] for row in DAMAGED])
def test_damaged_las(cell, tmp_path, model, good, case, edit):
    if edit is None:
        good.write_bytes(b"")
    else:
        damaged(good, edit)
    it = cell("LAS files", case)
    says = (
        "not a LAS file"
        if case.rpartition(" ")[2] in ("file", "header", "signature", ".las") and "points" not in case
        else "damaged"
    )
    it.refused(["pipeline", pipeline(tmp_path, good, model)], "in.las", says)


def test_fewer_points_in_the_header(cell, tmp_path, good, model):
    damaged(good, header("count", 100))
    done = cell("LAS files", "LAS: fewer points in the header than in the file").runs(
        ["pipeline", pipeline(tmp_path, good, model, *STAGES)],
        "the points of the header, and a warning on the bytes beyond",
    )
    assert "bytes beyond the 100 points" in done.err
    assert len(laspy.read(tmp_path / "out.las")) == 100


LAZ = [
    ("LAZ: cut in the header", lambda d: d[:100]),
    ("LAZ: cut in the points", lambda d: d[: len(d) // 2]),
    ("LAZ: cut in the chunk table", lambda d: d[:-4]),
    ("LAZ: chunk table beyond the end", None),
    ("LAZ: more points in the header than in the file", header("count", 60_000)),
    ("LAZ: a million chunks", lambda d: struct.pack_into("<I", d, table(d) + 4, 10**6)),
    ("LAZ: no chunks", lambda d: struct.pack_into("<I", d, table(d) + 4, 0)),
    ("LAZ: chunk table of version 7", lambda d: struct.pack_into("<I", d, table(d), 7)),
    ("LAZ: another size in the chunk table", lambda d: d.__setitem__(table(d) + 9, d[table(d) + 9] ^ 0x40)),
    ("LAZ: no record of the compression", lambda d: d.__setitem__(d.index(b"laszip encoded"), ord("k"))),
]


def table(data) -> int:
    """Where the chunk table of a LAZ file is."""
    return struct.unpack_from("<q", data, struct.unpack_from("<I", data, 96)[0])[0]


@pytest.mark.parametrize(("case", "edit"), LAZ, ids=[row[0] for row in LAZ])
def test_damaged_laz(cell, tmp_path, write_las, model, case, edit):
    source = write_las(tmp_path / "in.laz", scene(), point_format=3)
    if edit is None:
        damaged(source, lambda d: struct.pack_into("<q", d, struct.unpack_from("<I", d, 96)[0], 10**12))
    else:
        damaged(source, edit)
    it = cell("LAS files", case)
    it.refused(["pipeline", pipeline(tmp_path, source, model)], "in.laz", "LAS file")


def after(number=None, place=None, length=None):
    """Give the records after the points another number, place or length; with one good record at the end."""

    def edit(data):
        end = len(data)
        data += struct.pack("<H16sHQ32s", 0, b"test", 1, 10 if length is None else length, b"") + bytes(10)
        struct.pack_into("<QI", data, 235, end if place is None else place, 1 if number is None else number)

    return edit


def zero(data):
    """The header that a program leaves that ends before it is done."""
    struct.pack_into("<I", data, 107, 0)
    if data[25] >= 4:
        struct.pack_into("<Q", data, 247, 0)
    if data[104] & 0xC0:
        struct.pack_into("<q", data, struct.unpack_from("<I", data, 96)[0], -1)


def torn(at):
    """A header of which nothing was written from a place on, but zeros."""

    def edit(data):
        data[at:375] = bytes(375 - at)

    return edit


NEWER = [
    ("LAS 1.4: four billion records after the points", ".las", after(2**32 - 1), "not where it says"),
    ("LAS 1.4: records after the points at byte 0", ".las", after(place=0), "not where it says"),
    ("LAS 1.4: records after the points at 2^62", ".las", after(place=2**62), "not where it says"),
    ("LAS 1.4: records after the points at 2^64 - 1", ".las", after(place=2**64 - 1), "not where it says"),
    ("LAS 1.4: a record of 2^62 bytes after the points", ".las", after(length=2**62), "do not end within"),
    ("LAZ 1.4: records after the points at 2^62", ".laz", after(place=2**62), "not where it says"),
    ("LAS 1.4: no points in the header, many in the file", ".las", zero, "counts no points, but holds some"),
    ("LAZ 1.4: no points in the header, many in the file", ".laz", zero, "counts no points, but holds some"),
    ("LAS 1.4: a header torn in its count", ".las", torn(248), "counts fewer points than it holds"),
    ("LAZ 1.4: a header torn in its count", ".laz", torn(248), "counts other points than it holds"),
    ("LAZ 1.4: another count in the header", ".laz", lambda d: struct.pack_into("<Q", d, 247, 599), "599 counted, 600 held"),
    ("LAS 1.4: the length of an older header", ".las", header("header", 227), "its header is too short"),
    ("LAS 1.4: scales torn", ".las", lambda d: d.__setitem__(slice(149, 155), bytes(6)), "not valid numbers"),
]  # fmt: skip


@pytest.mark.parametrize(("case", "suffix", "edit", "says"), NEWER, ids=[row[0] for row in NEWER])
def test_damaged_headers_of_las_1_4(cell, tmp_path, write_las, model, case, suffix, edit, says):
    source = damaged(write_las(tmp_path / f"in{suffix}", scene(), point_format=6), edit)
    it = cell("LAS files", case)
    it.refused(["pipeline", pipeline(tmp_path, source, model)], f"in{suffix}", "damaged", says)
    tiled = job(
        tmp_path,
        str(source),
        {"type": "filters.hag_minima"},
        {"type": "writers.las", "filename": str(tmp_path / "o_#.las")},
    )
    done = it.command("pipeline", tiled, "--tile", 20, "--workers", 0)
    assert done.code == 1 and says in done.err


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_a_header_torn_behind_its_count(cell, tmp_path, write_las, model, version):
    """All points are there; what else is not is told: the box, and points beyond the count."""
    point_format, at, end = (3, 179, 227) if version == "1.2" else (6, 255, 375)
    source = write_las(tmp_path / "in.las", scene(), point_format=point_format)
    source = damaged(source, lambda d: d.__setitem__(slice(at, end), bytes(end - at)))
    done = cell("LAS files", f"LAS {version}: a header torn behind its count").runs(
        ["pipeline", pipeline(tmp_path, source, model)], "all points, told where the box is missing"
    )
    assert ("its header is all zeros" in done.err) == (version == "1.2")
    assert len(laspy.read(tmp_path / "out.las")) == 600


def test_bytes_after_the_points_of_a_newer_file(cell, tmp_path, write_las, model):
    counted = {**scene(), "ReturnNumber": np.ones(600, np.uint8), "NumberOfReturns": np.ones(600, np.uint8)}
    source = write_las(tmp_path / "in.las", counted, point_format=6)
    source = damaged(source, lambda d: d + bytes(30 * 7))
    done = cell("LAS files", "LAS 1.4: points beyond the count").runs(
        ["pipeline", pipeline(tmp_path, source, model)], "the points of the header, and a warning"
    )
    assert "210 bytes beyond the 600 points" in done.err


def test_a_record_after_the_points(cell, tmp_path, write_las, model):
    source = damaged(write_las(tmp_path / "in.las", scene(), point_format=6), after())
    cell("LAS files", "LAS 1.4: a record after the points").runs(
        ["pipeline", pipeline(tmp_path, source, model)], "classes"
    )
    check(tmp_path)


def test_a_file_without_points(cell, tmp_path, write_las):
    none = {name: values[:0] for name, values in scene().items()}
    for suffix in (".las", ".laz"):
        source = write_las(tmp_path / f"in{suffix}", dict(none), point_format=6)
        it = cell("LAS files", f"{suffix[1:].upper()}: a file without points")
        it.runs(
            ["pipeline", pipeline(tmp_path, source, None, {"type": "filters.hag_minima"})],
            "a file without points",
        )
        assert len(laspy.read(tmp_path / "out.las")) == 0


def test_header_texts_in_latin_1(cell, tmp_path, good, model, pdal_program):
    damaged(
        good,
        lambda d: d.__setitem__(slice(26, 58), "Vermessungsb\u00fcro".encode("latin-1").ljust(32, b"\0")),
    )
    it = cell("LAS files", "header texts in Latin-1")
    done = it.command("pipeline", pipeline(tmp_path, good, model))
    if done.code == 0:  # not every PDAL stumbles
        it.runs(done, "classes")
    else:
        it.refused(done, "the system identifier", "not UTF-8", "Vermessungsb", "pdal translate")
        subprocess.run([pdal_program, "translate", good, tmp_path / "clean.las"], check=True)
        assert it.command("pipeline", pipeline(tmp_path, tmp_path / "clean.las", model)).code == 0
    check(tmp_path)


TILED = [
    ("cut in the points", lambda d: d[: len(d) // 2], "it is cut short"),
    ("point length of 0", header("length", 0), "points are shorter than their format"),
    ("a text file named .las", lambda d: b"X Y Z\n1 2 3\n" * 50, "not a LAS or LAZ file"),
]


@pytest.mark.parametrize(("case", "edit", "says"), TILED, ids=[row[0] for row in TILED])
def test_damaged_in_tiles(cell, tmp_path, good, case, edit, says):
    damaged(good, edit)
    path = job(tmp_path, str(good), STAGES[0], str(tmp_path / "out.las"))
    it = cell("LAS files", f"LAS in tiles: {case}")
    done = it.command("pipeline", path, "--tile", "20")
    it.before = it.files()  # the marks of the run stay, for --resume
    it.refused(done, "in.las", says)
    assert not (tmp_path / "out.las").exists()


@pytest.mark.pdal
def test_cut_short_whoever_reads_it(tmp_path, write_las):
    """Newer PDAL crashes of such a file, so it is asked for nothing of it: not for a reference, nor for dimensions."""

    from pdal_stages.base.errors import StageError
    from pdal_stages.pipeline.parts import reference_and_wkt
    from pdal_stages.pipeline.references import reference_of

    xyz = np.random.default_rng(0).uniform(0, 50, (5000, 3))
    whole = write_las(tmp_path / "whole.laz", dict(zip("XYZ", xyz.T, strict=True)))
    cut = tmp_path / "cut.laz"
    cut.write_bytes(whole.read_bytes()[:-100])
    reader = {"type": "readers.las", "filename": str(cut)}
    for read in (
        lambda: reference_of({**reader, "count": 1}),
        lambda: reference_and_wkt(str(cut)),
    ):
        with pytest.raises(StageError, match=r"cut\.laz: the LAS file is damaged: it is cut short"):
            read()
