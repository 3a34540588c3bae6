"""`classify` writes copies: a corpus of LAS files, whole and in tiles, byte by byte."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest
from las_corpus import FORMATS, SIZES, LasFile, assert_copy, entry, record, take_apart

from pdal_stages.base.errors import StageError
from pdal_stages.base.las_points import Layout
from pdal_stages.cli import main

#: Dimensions that `classify` appends by default: type and bytes.
ADDED = {"HeightAboveGround": (9, 4), "Reliability": (9, 4)}
WKT = b'PROJCS["x",GEOGCS["g",DATUM["d",SPHEROID["s",6378137,298]],PRIMEM["G",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["metre",1]]\0'
KEYS = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3076, 0, 1, 9001)
SCALARS = tuple(entry(f"kind {kind}".encode(), kind) for kind in range(1, 11))
ARRAYS = tuple(entry(f"array{kind}".encode(), kind) for kind in range(11, 31))


def _bytes(kinds) -> int:
    return sum(((kind - 1) // 10 + 1) * SIZES[(kind - 1) % 10] for kind in kinds)


def corpus() -> dict[str, LasFile]:
    """Return all files by name, each farther from the one before than a model looks."""
    files = {
        f"v{minor}f{kind}{'z' * packed}": LasFile(minor, kind, compressed=packed)
        for minor, kinds in FORMATS.items()
        for kind in kinds
        for packed in (False, True)
    }
    odd = [entry(name, 5) for name in (b"Z", b"Intensity", b"a b/c", "höhe".encode(), b"h\xf6he")]
    odd += [entry(b"n" * 32, 3), entry(b"", 1), entry(b"X", 24), entry(b"PdalStagesSelected", 1)]
    more = {
        "scales": LasFile(scales=(1e-5, 0.25, 0.01)),
        "scalars": LasFile(extra=_bytes(range(1, 11)), described=SCALARS, compressed=True),
        "arrays": LasFile(2, 3, extra=_bytes(range(11, 31)), described=ARRAYS),
        "scaled": LasFile(extra=6, described=(entry(b"s", 3, 8, 0.5), entry(b"t", 6, 24, 2, 7))),
        "undescribed": LasFile(extra=300, compressed=True),
        "half": LasFile(2, 1, extra=9, described=(entry(b"first", 5),)),
        "type0": LasFile(extra=7, described=(entry(b"blob", 0, 5), entry(b"last", 3))),
        "odd": LasFile(extra=5 * 4 + 2 + 1 + 6 + 1, described=tuple(odd), compressed=True),
        "twice": LasFile(
            extra=6, described=(entry(b"two", 5),),
            vlrs=(record(b"LASF_Spec", 4, entry(b"one", 3)), record(b"other", 9, b"between")),
        ),
        "behind": LasFile(extra=4, described=(entry(b"a name", 5),), described_behind=True),
        "records": LasFile(
            vlrs=(record(b"", 0, b""), record(b"odd", 65535, bytes(65535), b"\xe9t\xe9")),
            evlrs=(record(b"MyCompany", 43, bytes(100_000), late=True), record(b"e", 1, b"", late=True)),
            compressed=True,
        ),
        "room": LasFile(2, 2, header_more=b"user bytes", padding=b"\xdd\xcc" * 7, compressed=True),
        "signature": LasFile(0, 1, padding=b"\xdd\xcc"),
        "waves": LasFile(4, 9, waveforms=2560, compressed=True),
        "waves3": LasFile(3, 5, waveforms=1280),
        "chunks": LasFile(compressed=True, variable_chunks=True),
        "accents": LasFile(2, 1, text="Géomètre Ltée".encode("latin-1")),
        "copc": LasFile(
            vlrs=(record(b"copc", 1, bytes(160)), record(b"after", 1, b"x")), compressed=True,
            evlrs=(record(b"copc", 1000, bytes(64), late=True), record(b"kept", 7, b"y", late=True)),
        ),
        "empty": LasFile(count=0), "emptyz": LasFile(count=0, compressed=True),
        "one": LasFile(2, 0, count=1),
    }  # fmt: skip
    files |= more
    for number, file in enumerate(files.values()):
        file.at, file.seed = 400.0 * number, number
    return files


FILES = corpus()


def _name(name: str) -> str:
    return f"{name}.{'laz' if FILES[name].compressed else 'las'}"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """The corpus in a folder."""
    folder = tmp_path_factory.mktemp("corpus")
    for name, file in FILES.items():
        (folder / _name(name)).write_bytes(file.build())
    return folder


@pytest.fixture(scope="module")
def in_tiles(inputs, tmp_path_factory):
    """The corpus classified as one survey in tiles."""
    out = tmp_path_factory.mktemp("tiles")
    assert main(["classify", str(inputs), f"{out}/", "--tile", "1000", "--workers", "0"]) == 0
    return out


@pytest.mark.parametrize("name", FILES)
def test_the_corpus_is_what_it_claims(inputs, name):
    """Laspy, which these files are not made with, reads the same coordinates."""
    if name in ("odd", "arrays", "twice", "type0", "half", "copc"):
        pytest.skip("laspy refuses the names, or reads other fields")
    file = FILES[name]
    las = laspy.read(inputs / _name(name))
    raw = take_apart((inputs / _name(name)).read_bytes()).points
    assert len(las.points) == file.count
    if file.count:
        assert np.array_equal(np.asarray(las.X), raw[:, :4].copy().view("<i4")[:, 0])


@pytest.mark.parametrize("name", FILES)
def test_copies_hold_every_byte(inputs, in_tiles, tmp_path, name):
    source = inputs / _name(name)
    out = tmp_path / _name(name)
    assert main(["classify", str(source), str(out)]) == 0
    whole = assert_copy(source.read_bytes(), out.read_bytes(), ADDED)
    tiled = assert_copy(source.read_bytes(), (in_tiles / _name(name)).read_bytes(), ADDED)
    for dimension, values in whole.items():
        assert np.array_equal(values, tiled[dimension]), dimension
    assert set(whole["Classification"].tolist()) <= {1, 2, 5, 6, 7, 18}


@pytest.mark.parametrize("name", ["v1f1", "v4f7z", "odd", "records", "waves"])
def test_without_dimensions_only_classes_change(inputs, tmp_path, name):
    source, out = inputs / _name(name), tmp_path / "o.laz"
    assert main(["classify", str(source), str(out), "--dimensions", "none"]) == 0
    assert_copy(source.read_bytes(), out.read_bytes(), {})


def test_las_and_laz_become_each_other(inputs, tmp_path):
    for name, target in (("v2f3", "o.laz"), ("v2f3z", "o.las"), ("records", "p.las")):
        source, out = inputs / _name(name), tmp_path / target
        assert main(["classify", str(source), str(out)]) == 0
        assert_copy(source.read_bytes(), out.read_bytes(), ADDED)


def test_others_read_what_was_appended(inputs, tmp_path):
    for name in ("scalars", "v0f1", "v3f5z", "undescribed", "behind"):
        out = tmp_path / _name(name)
        assert main(["classify", str(inputs / _name(name)), str(out)]) == 0
        las = laspy.read(out)
        if name != "behind":  # laspy does not look there
            assert 0 < np.asarray(las["Reliability"]).max() <= 1
        assert Layout.of_file(out).extra_by_name["Reliability"].type == np.float32


# ---- dimensions of ours that the input holds -----------------------------------------------------


def with_dimension(path, name: str, kind: str, values, **options):
    """Write a file that holds an extra dimension."""
    path.write_bytes(LasFile(count=400, **options).build())
    las = laspy.read(path)
    las.add_extra_dim(laspy.ExtraBytesParams(name, kind))
    las[name] = values
    las.write(path)
    return path


def test_other_letters_are_another_dimension(tmp_path):
    values = np.arange(400) + 0.25
    source = with_dimension(tmp_path / "case.las", "heightaboveground", "f8", values)
    for more, out in (
        ([], "a.las"),
        (["--dimensions", "none"], "b.las"),
        (["--tile", "100", "--workers", "0"], "c.las"),
    ):
        assert main(["classify", str(source), str(tmp_path / out), *more]) == 0
        las = laspy.read(tmp_path / out)
        assert np.array_equal(las["heightaboveground"], values)
        assert ("HeightAboveGround" in las.point_format.dimension_names) == (out != "b.las")


@pytest.mark.parametrize(
    "name", ["HeightAboveOpening_5", "PdalStagesSelected", "PdalStagesKeptGround"]
)
def test_dimensions_of_the_run_are_kept_where_they_are_not_written(tmp_path, name):
    values = np.random.default_rng(0).integers(1 << 29, 1 << 30, 400)
    source = with_dimension(tmp_path / "a.las", name, "i4", values)
    for more in ([], ["--where", "Z < 100"], ["--tile", "100", "--workers", "0"]):
        assert main(["classify", str(source), str(tmp_path / "o.las"), *more]) == 0
        assert np.array_equal(laspy.read(tmp_path / "o.las")[name], values)


def test_a_name_made_of_axes_is_no_axis(tmp_path):
    source = with_dimension(tmp_path / "a.las", "XY", "u2", np.arange(400))
    for more in ([], ["--tile", "100", "--workers", "0"]):
        arguments = [str(source), str(tmp_path / "o.las"), "--where", "XY > 300", *more]
        assert main(["classify", *arguments]) == 0
        las = laspy.read(tmp_path / "o.las")
        assert np.array_equal(las["XY"], np.arange(400))
        assert set(np.asarray(las.classification)[:301]) == {1}  # as they came


def test_our_dimension_is_replaced_in_place(tmp_path):
    source = with_dimension(tmp_path / "a.las", "Reliability", "f8", np.full(400, 9.0))
    assert main(["classify", str(source), str(tmp_path / "o.las")]) == 0
    las = laspy.read(tmp_path / "o.las")
    assert las["Reliability"].max() <= 1
    assert list(las.point_format.extra_dimension_names) == ["Reliability", "HeightAboveGround"]


def test_a_type_that_does_not_hold_it_is_refused(tmp_path, capsys):
    source = with_dimension(tmp_path / "a.las", "Reliability", "u1", np.full(400, 9))
    for more in ([], ["--tile", "100", "--workers", "0"]):
        assert main(["classify", str(source), str(tmp_path / "o.las"), *more]) == 1
        said = capsys.readouterr().err
        assert "'Reliability'" in said and "uint8" in said and "--dimensions" in said
        assert not (tmp_path / "o.las").exists()
    assert main(["classify", str(source), str(tmp_path / "o.las"), "--dimensions", "none"]) == 0


# ---- names are names -----------------------------------------------------------------------------


def test_names_are_no_patterns(tmp_path):
    folder = tmp_path / "job #5 [x]"
    folder.mkdir()
    names = ("t[1].las", "t1.las", "a#b.las", "a*.las", "ab.las", "a?c.laz")
    for number, name in enumerate(names):
        LasFile.at = 0
        file = LasFile(at=100.0 * number, seed=number, compressed=name.endswith("z"))
        (folder / name).write_bytes(file.build())
    out = tmp_path / "out #1"
    out.mkdir()
    (out / "a1b.las").write_bytes(b"LASF unrelated")
    assert main(["classify", str(folder), str(out), "--tile", "1000", "--workers", "0"]) == 0
    for name in names:
        assert_copy((folder / name).read_bytes(), (out / name).read_bytes(), ADDED)
        assert main(["classify", str(folder / name), f"{tmp_path}/single/"]) == 0
        assert_copy((folder / name).read_bytes(), (tmp_path / "single" / name).read_bytes(), ADDED)
    assert (out / "a1b.las").read_bytes() == b"LASF unrelated"


def test_files_are_named_as_arguments(tmp_path, capsys):
    (tmp_path / "a.las").write_bytes(LasFile().build())
    (tmp_path / "b.las").write_bytes(b"LASF another")
    for option in ("writers.las.filename", "stage.output.filename", "readers.las.filename"):
        arguments = [str(tmp_path / "a.las"), str(tmp_path / "o.las")]
        assert main(["classify", *arguments, f"--{option}={tmp_path / 'b.las'}"]) == 1
        assert "classify INPUT OUTPUT" in capsys.readouterr().err
        assert (tmp_path / "b.las").read_bytes() == b"LASF another"
        assert not (tmp_path / "o.las").exists()


# ---- reference systems ---------------------------------------------------------------------------


def test_a_reference_that_is_named_is_written(tmp_path):
    for minor, kind in ((2, 1), (4, 1), (4, 6)):
        source, out = tmp_path / "a.las", tmp_path / "o.las"
        source.write_bytes(LasFile(minor, kind, at=500_000).build())
        assert (
            main(["classify", str(source), str(out), "--readers.las.default_srs=EPSG:25832"]) == 0
        )
        numbers = [vlr.record_id for vlr in laspy.read(out).header.vlrs]
        assert (2112 if minor == 4 else 34735) in numbers
        assert laspy.read(out).header.parse_crs().to_epsg() == 25832


def test_damaged_files_are_refused(tmp_path):
    data = LasFile(compressed=True).build()
    (tmp_path / "cut.laz").write_bytes(data[:-200])
    assert main(["classify", str(tmp_path / "cut.laz"), str(tmp_path / "o.laz")]) == 1
    assert not (tmp_path / "o.laz").exists()
    with pytest.raises(StageError, match="extra bytes"):
        data = LasFile(extra=2, described=(entry(b"long", 10),)).build()
        (tmp_path / "b.las").write_bytes(data)
        Layout.of_file(tmp_path / "b.las")
