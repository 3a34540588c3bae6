"""Extra bytes that PDAL overwrites, drops or refuses, own dimensions that stages make anew, and odd
LAS headers."""

from __future__ import annotations

import json
import struct
import subprocess

import laspy
import numpy as np
import pytest
from robustness_kit import HAG, job, las, scene

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.base.las_repair import extra_dimensions
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.pdal import reader_of

pytestmark = pytest.mark.pdal

TILES = ["--tile", 20, "--workers", 0]
DOORS = {"whole": [], "tiles": TILES}


def with_titles(path, titles: dict[str, str]):
    """Rename extra bytes in the record that describes them."""
    data = path.read_bytes()
    for name, title in titles.items():
        assert data.count(name.encode() + b"\0") == 1
        old, new = (text.encode("latin-1").ljust(32, b"\0") for text in (name, title))
        data = data.replace(old, new)
    path.write_bytes(data)
    return path


def described(path, name: str, kind: int, options: int = 0):
    """Give extra bytes another type and options."""
    data = bytearray(path.read_bytes())
    at = data.index(name.encode() + b"\0") - 2
    data[at : at + 2] = bytes([kind, options])
    path.write_bytes(bytes(data))
    return path


def undescribed(path, last: int):
    """Take the last descriptions of extra bytes out; the gap is before the points."""
    data, cut = bytearray(path.read_bytes()), 192 * last
    at = data.index(b"LASF_Spec\0") - 2
    (offset,), (length,) = (
        struct.unpack_from("<I", data, 96),
        struct.unpack_from("<H", data, at + 20),
    )
    struct.pack_into("<H", data, at + 20, length - cut)
    end = at + 54 + length
    data[end - cut : offset] = data[end:offset] + bytes(cut)
    path.write_bytes(bytes(data))
    return path


def classified(command, source, target, model, *more):
    command.runs(["classify", source, target, "--model", model, "--no-noise", *more])
    return laspy.read(target)


def is_same(one, other):
    assert list(one.point_format.dimension_names) == list(other.point_format.dimension_names)
    for name in one.point_format.dimension_names:
        assert np.array_equal(np.asarray(one[name]), np.asarray(other[name])), name


# ---- names of dimensions -------------------------------------------------------------------------


@pytest.mark.parametrize("point_format", [1, 2, 6, 8])
def test_real_values_stay_whatever_extra_bytes_are_called(tmp_path, write_las, point_format):
    """All of PDAL's names, in its letters and in small ones, and laspy's."""
    rng = np.random.default_rng(3)
    arrays = scene(50) | {"Intensity": rng.integers(1, 60_000, 50)}
    arrays |= {"GpsTime": rng.uniform(1, 9, 50)} if point_format != 2 else {}
    arrays |= {"Red": rng.integers(1, 60_000, 50)} if point_format in (2, 8) else {}
    values = np.linspace(0.5, 20.5, 50)
    plain = write_las(tmp_path / "plain.las", {**arrays, "Qqq": values}, point_format=point_format)
    (right,) = pdal_env.execute([reader_of(str(plain), "in")]).arrays
    names = [entry["name"] for entry in pdal_env.bindings().dimensions]
    names += [name.lower() for name in names] + ["gps_time", "raw_classification", "nir"]
    assert len(names) > 150
    for name in names:
        path = tmp_path / "named.las"
        path.write_bytes(plain.read_bytes())
        with_titles(path, {"Qqq": name})
        (points,) = pdal_env.execute([reader_of(str(path), "in")]).arrays
        for dimension in set(right.dtype.names) - {"Qqq"}:
            assert np.array_equal(points[dimension], right[dimension]), (name, dimension)
        (read_as,) = extra_dimensions(path)
        among = {entry.lower(): entry for entry in points.dtype.names}
        assert np.array_equal(points[among[read_as.lower()]], values), name


@pytest.mark.parametrize("title", ["Z", "X", "Intensity", "classification", "GpsTime"])
def test_every_door_reads_them_under_another_name(command, tmp_path, write_las, model, title):
    values = np.linspace(-7.5, 90, 600)
    plain = write_las(tmp_path / "plain.las", {**scene(), "Qqq": values}, point_format=6)
    right = classified(command, plain, tmp_path / "right.las", model)
    source = tmp_path / "in.las"
    source.write_bytes(plain.read_bytes())
    with_titles(source, {"Qqq": title})
    job(tmp_path, source, HAG, {"type": "filters.modelclassifier", "model": str(model)},
        las(tmp_path / "job.las"))  # fmt: skip
    for name, words in {
        "whole.las": ["classify", source, tmp_path / "whole.las", "--model", model, "--no-noise"],
        "t.laz": ["classify", source, tmp_path / "t.laz", "--model", model, "--no-noise", *TILES],
        "job.las": ["pipeline", tmp_path / "job.json"],
    }.items():
        done = command.runs(words)
        assert f"{title} as Extra_{title}" in done.err
        out = laspy.read(tmp_path / name)
        assert np.array_equal(out.xyz, right.xyz)
        assert np.array_equal(out.classification, right.classification)
        assert np.array_equal(out.gps_time, right.gps_time)
        assert np.array_equal(out[f"Extra_{title}"], values)


def test_stock_pdal_is_told(tmp_path, write_las, pdal_program):
    """PDAL has overwritten the coordinates before a stage of ours sees them."""
    source = write_las(tmp_path / "in.las", {**scene(), "Qqq": np.ones(600)}, point_format=6)
    with_titles(source, {"Qqq": "Z"})
    expanded = tmp_path / "expanded.json"
    expanded.write_text(json.dumps(json.loads(ps.Pipeline([str(source), HAG]).json)["pipeline"]))
    done = subprocess.run(
        [pdal_program, "pipeline", str(expanded)], capture_output=True, text=True, check=False
    )
    assert done.returncode and "PDAL has overwritten these (found Z)" in done.stderr


# ---- arrays, type 0, bytes without a description, odd names -----------------------------------------------


def odd(path, write_las, version=4, point_format=6):
    """One of each; the values by the names that outputs have."""
    n = 600
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(n, 3)).astype(np.float32)
    hidden, width, last = rng.integers(0, 255, (n, 3), np.uint8), np.arange(n), rng.random(n)
    header = laspy.LasHeader(point_format=point_format, version=f"1.{version}")
    header.scales, header.offsets = np.full(3, 0.001), [500_000, 5_400_000, 0]
    for name, kind in {"normal": "3f4", "hidden": "3u1", "width": "u2", "dist": "f8"}.items():
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind))
    header.add_extra_dim(
        laspy.ExtraBytesParams("scaled", "i2", scales=np.array([0.1]), offsets=np.array([5.0]))
    )
    header.add_extra_dim(laspy.ExtraBytesParams("last", "f8"))
    cloud, data = laspy.LasData(header), scene()
    cloud.x, cloud.y, cloud.z = (data[axis] for axis in "XYZ")
    cloud.classification = data["Classification"]
    cloud["normal"], cloud["hidden"], cloud["width"], cloud["dist"] = normals, hidden, width, last
    cloud["scaled"], cloud["last"] = np.arange(n) / 10, last
    cloud.write(path)
    with_titles(path, {"width": "Pulse width", "dist": "Distance (m)", "scaled": "H\u00f6he"})
    described(path, "hidden", 0, 3)
    undescribed(path, 1)
    as_bytes = last.view(np.uint8).reshape(n, 8)
    return {
        **{f"normal{k}": normals[:, k] for k in range(3)},
        **{f"hidden_{k}": hidden[:, k] for k in range(3)},
        "Pulse width": width, "Distance (m)": last, "H\u00f6he": np.arange(n) / 10,
        **{f"Undescribed_{k}": as_bytes[:, k] for k in range(8)},
    }  # fmt: skip


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("version", "point_format"), [(2, 1), (4, 3), (4, 6)])
def test_nothing_is_dropped(command, tmp_path, write_las, model, version, point_format, suffix):
    source = tmp_path / f"in{suffix}"
    right = odd(source, write_las, version, point_format)
    reader = {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}
    command.runs(["pipeline", job(tmp_path, reader, HAG, las(tmp_path / "o.las")), "--validate"])
    outputs = []
    where = ["--where", "Z > 99"]
    for door, words in {**DOORS, "some": where, "some tiles": [*where, *TILES]}.items():
        target = tmp_path / f"{door}{suffix}"
        out = classified(command, source, target, model, *words)
        assert list(out.point_format.extra_dimension_names)[: len(right)] == list(right)
        for name, those in right.items():
            assert np.allclose(out[name], those, rtol=1e-12), (door, name)
        outputs.append(out)
    is_same(outputs[0], outputs[1])
    is_same(outputs[2], outputs[3])


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [(31, 0, "no known type"), (30, 0, "shorter than the descriptions")],
)
def test_descriptions_that_do_not_fit(command, tmp_path, write_las, model, kind, options, says):
    source = write_las(tmp_path / "in.las", {**scene(), "Mine": np.ones(600)}, point_format=6)
    described(source, "Mine", kind, options)
    command.refused(["classify", source, tmp_path / "o.las", "--model", model], "in.las", says)


def test_several_files_by_a_pattern(command, tmp_path, write_las):
    """One of them is read as a copy, the other as it is."""
    for n, title in enumerate(["Qqq", "Pulse width"]):
        path = tmp_path / f"in{n}.las"
        write_las(path, {**scene(), "Qqq": np.full(600, n + 1.0)}, point_format=6)
        with_titles(path, {"Qqq": title})
    reader = {"type": "readers.las", "filename": f"{tmp_path}/in*.las"}
    command.runs(["pipeline", job(tmp_path, reader, HAG, las(tmp_path / "out.las"))])
    out = laspy.read(tmp_path / "out.las")
    assert len(out) == 1200
    values = np.column_stack([out["Qqq"], out["Pulse width"]])
    assert np.array_equal(np.unique(values, axis=0, return_counts=True)[1], [600, 600])
    assert np.array_equal(np.unique(values, axis=0), [[0, 2], [1, 0]])


def test_two_of_one_name(command, tmp_path, write_las, model):
    """PDAL holds one dimension of a name, laspy refuses the file: the second one gets another
    name."""
    extra = {"Qqq": np.full(600, 1.0), "Rrr": np.full(600, 2.0)}
    source = write_las(tmp_path / "in.las", {**scene(), **extra}, point_format=6)
    with_titles(source, {"Qqq": "Same", "Rrr": "Same"})
    outputs = [
        classified(command, source, tmp_path / f"{door}.las", model, *words)
        for door, words in DOORS.items()
    ]
    is_same(*outputs)
    assert (outputs[0]["Same"] == 1).all() and (outputs[0]["Extra_Same"] == 2).all()


# ---- dimensions of the input that stages make, too ----------------------------------------------


def test_a_file_that_was_classified_before(command, tmp_path, write_las):
    """What stages make on the way stays as it was in the input."""
    earlier = {name: np.full(600, 77, np.uint8) for name in ("Reliability", "Ground")}
    earlier["HeightAboveOpening_5"] = np.full(600, 77.5)
    source = write_las(tmp_path / "in.las", {**scene(), **earlier}, point_format=6, wkt=None)
    outputs = []
    for door, words in DOORS.items():
        target = tmp_path / f"{door}.las"
        command.runs(["classify", source, target, *words])
        outputs.append(laspy.read(target))
        assert (np.asarray(outputs[-1]["Ground"]) == 77).all()
        assert (np.asarray(outputs[-1]["HeightAboveOpening_5"]) == 77.5).all()
        assert np.asarray(outputs[-1]["Reliability"]).max() <= 1
    is_same(*outputs)
    again = tmp_path / "again.las"
    command.runs(["classify", tmp_path / "whole.las", again])
    assert np.array_equal(laspy.read(again).classification, outputs[0].classification)


# ---- points compressed one by one -----------------------------------------------------------------


def pointwise(path):
    """Make of a LAZ file of one chunk what LASzip 1 wrote: no table of chunks."""
    data = bytearray(path.read_bytes())
    offset = struct.unpack_from("<I", data, 96)[0]
    (table,) = struct.unpack_from("<q", data, offset)
    struct.pack_into("<H", data, data.index(b"laszip encoded") + 52, 1)
    path.write_bytes(bytes(data[:offset] + data[offset + 8 : table]))
    return path


def test_laz_without_chunks(command, tmp_path, write_las, model):
    if pdal_env.version() >= (2, 4):
        pytest.skip(
            "PDAL from 2.4 on decodes LAZ without chunks no longer: 'Unexpected end of file'"
        )
    plain = write_las(tmp_path / "plain.laz", {**scene(), "Mine": np.arange(600.0)}, point_format=3)
    source = tmp_path / "in.laz"
    source.write_bytes(plain.read_bytes())
    pointwise(source)
    right = classified(command, plain, tmp_path / "right.las", model)
    is_same(classified(command, source, tmp_path / "whole.las", model), right)
    is_same(classified(command, source, tmp_path / "tiles.las", model, *TILES), right)


# ---- headers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("version", [2, 4])
def test_texts_in_latin_1(command, tmp_path, write_las, model, door, version):
    source = write_las(
        tmp_path / "in.las", {**scene(), "Mine": np.ones(600)}, 6 if version == 4 else 3
    )
    data = bytearray(source.read_bytes())
    text = "Vermessungsb\u00fcro".encode("latin-1").ljust(32, b"\0")
    data[26:58] = data[58:90] = text
    at = data.index(b"LASF_Spec\0")
    data[at + 20 : at + 52] = text  # a record's description
    if version == 4:
        struct.pack_into("<QI", data, 235, len(data), 1)
        data += struct.pack("<H16sHQ32s", 0, "\u00fcber".encode("latin-1"), 1, 4, text) + b"abcd"
    source.write_bytes(bytes(data))
    out = classified(command, source, tmp_path / "out.las", model, *DOORS[door])
    assert len(out) == 600 and (np.asarray(out["Mine"]) == 1).all()


BROKEN = [
    'COMPD_CS["NAD83 / UTM + NAVD88","cut',
    'COMPD_CS["x",PROJCS["broken"],VERT_CS["y"]]',
    'PROJCS["WGS 84 / UTM"',
]


@pytest.mark.parametrize("wkt", BROKEN)
def test_a_broken_reference(command, tmp_path, write_las, model, wkt):
    source = write_las(tmp_path / "in.las", scene(), point_format=6, wkt=wkt)
    right = "--readers.las.override_srs=EPSG:25832"
    for door, words in DOORS.items():
        command_words = ["classify", source, tmp_path / f"{door}.las", "--model", model, *words]
        done = command(*command_words)
        if done.code:  # newer PDAL may take it as none
            assert "reference in the file cannot be read" in done.err
            assert "--readers.las.override_srs=EPSG:CODE" in done.err
            assert not (tmp_path / f"{door}.las").exists()
        command.runs([*command_words, right])
        assert laspy.read(tmp_path / f"{door}.las").header.parse_crs().to_epsg() == 25832


def test_the_file_source_id(command, tmp_path, write_las):
    """That of the input; 0 of LAS 1.0, which has none, and where inputs differ."""
    ids = {}
    for name, version, source_id in (("a", 0, 9), ("b", 2, 7), ("c", 2, 7), ("d", 2, 8)):
        path = write_las(tmp_path / f"{name}.las", scene(), point_format=1)
        data = bytearray(path.read_bytes())
        data[25] = version
        struct.pack_into("<H", data, 4, source_id)
        path.write_bytes(bytes(data))
        ids[name] = path
    for names, right in {"a": 0, "b": 7, "bc": 7, "bd": 0}.items():
        out = tmp_path / f"{names}_out.las"
        command.runs(["pipeline", job(tmp_path, *(ids[n] for n in names), HAG, las(out))])
        if pdal_env.version() < (2, 4, 0) or names != "a":
            assert laspy.read(out).header.file_source_id == right, names


def test_who_wrote_a_record_that_says_too_much(tmp_path, write_las):
    """A number of records beyond those there are: no points are read as records, as PDAL does."""
    path = write_las(tmp_path / "in.las", {**scene(), "Mine": np.ones(600)}, point_format=3)
    data = bytearray(path.read_bytes())
    (offset,) = struct.unpack_from("<I", data, 96)
    data[offset:offset] = bytes(54 * 4)  # room
    struct.pack_into("<II", data, 96, offset + 54 * 4, 9)
    path.write_bytes(bytes(data))
    try:
        run = pdal_env.execute([reader_of(str(path), "in")])
    except StageError as error:
        assert "more records" in str(error)
    else:
        assert run.count == 600 and (run.arrays[0]["Mine"] == 1).all()
