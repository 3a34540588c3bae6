"""Extra bytes that PDAL overwrites, drops or refuses, own dimensions that stages make anew, and odd
LAS headers."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest
from las_corpus import LasFile, assert_copy, entry
from robustness_kit import HAG, job, las, scene

from pdal_stages.pipeline import pdal as pdal_env

pytestmark = pytest.mark.pdal

TILES = ["--tile", 20, "--workers", 0]
DOORS = {"whole": [], "tiles": TILES}


def described(path, name: str, kind: int, options: int = 0):
    """Give extra bytes another type and options."""
    data = bytearray(path.read_bytes())
    at = data.index(name.encode() + b"\0") - 2
    data[at : at + 2] = bytes([kind, options])
    path.write_bytes(bytes(data))
    return path


def classified(command, source, target, model, *more):
    command.runs(["classify", source, target, "--model", model, "--no-noise", *more])
    return laspy.read(target)


def is_same(one, other):
    assert list(one.point_format.dimension_names) == list(other.point_format.dimension_names)
    for name in one.point_format.dimension_names:
        assert np.array_equal(np.asarray(one[name]), np.asarray(other[name])), name


# ---- what PDAL would misread ---------------------------------------------------------------------

#: Extra bytes that PDAL drops or overwrites, and a word of the reason.
MISREAD = {
    "type0": (LasFile(extra=7, described=(entry(b"blob", 0, 5), entry(b"last", 3))), "leaves out"),
    "half": (LasFile(2, 1, extra=9, described=(entry(b"first", 5),)), "leaves out"),
    "Z": (LasFile(extra=8, described=(entry(b"Z", 10),)), "overwrite"),
    "intensity": (LasFile(2, 3, extra=2, described=(entry(b"intensity", 3),)), "overwrite"),
    "waves": (LasFile(3, 5), "waveforms"),
    "accents": (LasFile(2, 1, text="Géomètre".encode("latin-1")), "UTF-8"),
}


@pytest.mark.parametrize("name", MISREAD)
def test_pipelines_refuse_what_pdal_would_misread(command, tmp_path, name):
    """Before any work, whole and in tiles; `classify` takes the same file."""
    file, word = MISREAD[name]
    source = tmp_path / "in.las"
    source.write_bytes(file.build())
    stages = job(tmp_path, source, HAG, las(tmp_path / "o_#.las"))
    for words in DOORS.values():
        command.refused(["pipeline", stages, *words], word, "pdal-stages classify")
    assert not list(tmp_path.glob("o_*"))
    command.runs(["classify", source, tmp_path / "o.las"])
    added = {"HeightAboveGround": (9, 4), "Reliability": (9, 4)}
    assert_copy(source.read_bytes(), (tmp_path / "o.las").read_bytes(), added)


def test_names_that_are_patterns(command, tmp_path, write_las):
    for name in ("t[1].las", "t1.las"):
        write_las(tmp_path / name, scene(), point_format=6)
    stages = job(tmp_path, tmp_path / "t[1].las", HAG, las(tmp_path / "o.las"))
    command.refused(["pipeline", stages], "for a pattern", "t[1].las")


def test_two_types_of_one_dimension(command, tmp_path, write_las):
    for number, values in enumerate((np.arange(600) / 7, np.arange(600, dtype=np.int32))):
        write_las(tmp_path / f"{number}.las", {**scene(), "amp": values}, point_format=6)
    files = [tmp_path / "0.las", tmp_path / "1.las"]
    stages = job(tmp_path, *files, HAG, las(tmp_path / "o.las"))
    command.refused(["pipeline", stages], "'amp'", "float64", "int32")
    words = ["--per", "tile", *TILES]
    command.refused(["classify", *files, f"{tmp_path}/out/", *words], "'amp'", "float64", "int32")
    command.runs(["classify", *files, f"{tmp_path}/out/", *TILES])
    for number, kind in enumerate(("f8", "i4")):
        assert laspy.read(tmp_path / "out" / f"{number}.las")["amp"].dtype == kind


@pytest.mark.parametrize(
    ("kind", "options", "says"),
    [(31, 0, "no known type"), (30, 0, "shorter than the descriptions")],
)
def test_descriptions_that_do_not_fit(command, tmp_path, write_las, model, kind, options, says):
    source = write_las(tmp_path / "in.las", {**scene(), "Mine": np.ones(600)}, point_format=6)
    described(source, "Mine", kind, options)
    command.refused(["classify", source, tmp_path / "o.las", "--model", model], "in.las", says)


# ---- dimensions of the input that stages make, too ----------------------------------------------


def test_a_file_that_was_classified_before(command, tmp_path, write_las):
    """What stages make on the way stays as it was in the input."""
    earlier = {"Reliability": np.full(600, 77.0), "Ground": np.full(600, 77, np.uint8)}
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
    out = tmp_path / "out.las"
    command.runs(["classify", source, out, "--model", model, "--no-noise", *DOORS[door]])
    added = {"HeightAboveGround": (9, 4), "Reliability": (9, 4)}
    assert_copy(source.read_bytes(), out.read_bytes(), added)


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


def test_other_commands_take_names_as_they_are(command, tmp_path):
    """`accuracy`, `review` and `train` read the file that is named, with what PDAL would misread."""
    for name, seed in (("t[1].las", 1), ("t1.las", 2)):
        file = LasFile(2, 1, seed=seed, flags=False, count=600, text="Géomètre".encode("latin-1"))
        (tmp_path / name).write_bytes(file.build())
    out = tmp_path / "out"
    command.runs(["classify", tmp_path / "t[1].las", f"{out}/"])
    named = out / "t[1].las"
    assert "100.00 %" in command.runs(["accuracy", named, "--reference", named]).out
    command.refused(["accuracy", named, "--reference", tmp_path / "t1.las"], "the same points")
    pytest.importorskip("pyogrio")
    command.runs(["review", named, tmp_path / "review.gpkg"])
