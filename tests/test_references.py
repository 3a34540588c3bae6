"""Inputs of meters, feet and degrees beside each other are refused, in tiles and without."""

from __future__ import annotations

import itertools
import re
import struct

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.base.errors import StageError
from pdal_stages.base.units import Units, units_of_wkt
from pdal_stages.base.vector import horizontal_wkt
from pdal_stages.cli import main
from pdal_stages.pipeline.expansion import check_dimensions
from pdal_stages.pipeline.spatial_reference import fault_of_reference, reference_of_file
from pdal_stages.stages.hag_minima import HagMinima
from pdal_stages.synthetic import write_town

pytestmark = pytest.mark.pdal

_SPHERE = 'SPHEROID["WGS 84",6378137,298.257223563]'
_EARTH = f'DATUM["WGS_1984",{_SPHERE}],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]'
DEGREES = f'GEOGCS["WGS 84",{_EARTH}]'
_PLACE = '"latitude_of_origin",0 "scale_factor",0.9996 "false_easting",500000 "false_northing",0'
_PLACE = ",".join(f"PARAMETER[{value}]" for value in _PLACE.split())


def mercator(meridian: int, unit: str) -> str:
    parameters = f'PARAMETER["central_meridian",{meridian}],{_PLACE}'
    return f'PROJCS["p",{DEGREES},PROJECTION["Transverse_Mercator"],{parameters},UNIT[{unit}]]'


METERS, OTHER = mercator(9, '"metre",1'), mercator(15, '"metre",1')
ALIKE = (
    METERS.replace("WGS 84", "GRS 1980")
    .replace("WGS_1984", "ETRS_1989")
    .replace("298.257223563", "298.257222101")
)
FEET = mercator(9, '"US survey foot",0.3048006096012192')


@pytest.fixture()
def inputs(tmp_path, write_las):
    """A function that writes files with these references, side by side; the readers' pattern."""

    def write(*references):
        rng = np.random.default_rng(0)
        for number, wkt in enumerate(references):
            xyz = rng.uniform(0, 1, (500, 3)) * (40, 40, 3) + (500_000 + 40 * number, 5_400_000, 0)
            write_las(
                tmp_path / f"in{number}.las",
                dict(zip("XYZ", xyz.T, strict=True)),
                point_format=6,
                wkt=wkt,
            )
        return str(tmp_path / "in*.las")

    return write


def ways(tmp_path, pattern, *more):
    """The same pipeline whole and in tiles."""
    stages = [{"type": "readers.las", "filename": pattern}, *more, {"type": "filters.hag_minima"}]
    writer = {"type": "writers.las", "extra_dims": "all"}
    yield lambda: ps.run_pipeline([*stages, {**writer, "filename": str(tmp_path / "whole.las")}])
    yield lambda: run_tiled(
        [*stages, {**writer, "filename": str(tmp_path / "o_#.las")}], 40, workers=0
    )


@pytest.mark.parametrize(("one", "two"), [(METERS, FEET), (FEET, None)])
def test_units_of_two_kinds(tmp_path, inputs, one, two):
    for way in ways(tmp_path, inputs(one, two)):
        with pytest.raises(StageError, match="the inputs have different units of length") as caught:
            way()
        message = str(caught.value)
        assert (
            "0.304801 m" in message
            and "1 m" in message
            and "in0.las" in message
            and "in1.las" in message
        )
        assert ("as there is no spatial reference" in message) == (two is None)
    assert not list(tmp_path.glob("o_*")) and not (tmp_path / "whole.las").exists()


def test_degrees_beside_meters(tmp_path, inputs):
    for way in ways(tmp_path, inputs(METERS, DEGREES)):
        with pytest.raises(StageError, match=r"degrees.*in1\.las|in1\.las.*degrees"):
            way()


@pytest.mark.parametrize(
    ("reference", "fault"),
    [
        ("EPSG:4547", ""),  # meters of a Gauss-Kruger zone
        ("EPSG:28992", ""),
        ("EPSG:4326", "degrees"),
        ("EPSG:4326+5773", "degrees"),
        ("NAD27", "degrees"),
        ("EPSG:4978", "geocentric"),
        ("nonsense", ""),  # which PDAL refuses
    ],
)
def test_a_reprojection_to_degrees_before_a_stage(reference, fault):
    assert fault in fault_of_reference(reference)
    assert bool(fault) == bool(fault_of_reference(reference))
    points = {"type": "readers.faux", "count": 9, "mode": "grid", "bounds": "([1,9],[1,9],[1,9])"}
    moved = {"type": "filters.reprojection", "in_srs": "EPSG:4326", "out_srs": reference}
    expanded = ps.Pipeline([points, moved, {"type": "filters.hag_minima"}]).expanded
    if not fault:
        check_dimensions(expanded)
        return
    with pytest.raises(StageError, match=rf"{fault}.*to {re.escape(reference)}"):
        check_dimensions(expanded)


def test_references_of_two_kinds(tmp_path, inputs):
    for way in ways(tmp_path, inputs(METERS, OTHER)):
        with pytest.raises(
            StageError, match="the inputs have different reference systems"
        ) as caught:
            way()
        assert "in0.las" in str(caught.value) and "in1.las" in str(caught.value)


@pytest.mark.parametrize("references", [(METERS, ALIKE), (METERS, None), (FEET, FEET)])
def test_units_of_one_kind(tmp_path, inputs, references):
    for way in ways(tmp_path, inputs(*references)):
        way()
    assert (tmp_path / "whole.las").exists() and len(list(tmp_path.glob("o_*"))) == 2


@pytest.mark.parametrize("references", [(METERS, None, METERS, None), (None, None)])
def test_inputs_without_a_reference_beside_others_are_said(tmp_path, inputs, references):
    inputs(*references)
    stages = [
        {"type": "readers.las", "filename": str(tmp_path / "in*.las")},
        {"type": "filters.hag_minima"},
    ]
    whole = ps.Pipeline(stages)
    whole.execute()
    writer = {"type": "writers.las", "filename": str(tmp_path / "o_#.las")}
    of_tiles = run_tiled([*stages, writer], 40, workers=0).messages
    for messages in ([*map(str, whole.messages)], of_tiles):
        message = [
            entry for entry in messages if "assumed to have that of the other inputs" in entry
        ]
        assert len(message) == (1 if any(references) else 0)
        for line in message:
            assert (
                f"{tmp_path / 'in1.las'}, {tmp_path / 'in3.las'} have no spatial reference" in line
            )


def test_of_what_is_assumed_there_is_one_message(tmp_path, write_las):
    """Also where a tile has points of the input without a reference alone."""
    for number, wkt in enumerate((METERS, None)):
        corner = np.array([5e5 + 400 * number, 5e6, 0])
        xyz = np.random.default_rng(0).uniform(0, 30, (500, 3)) + corner
        arrays = dict(zip("XYZ", xyz.T, strict=True))
        write_las(tmp_path / f"in{number}.las", arrays, point_format=6, wkt=wkt)
    heights = {"type": "filters.hag_morphological"}
    stages = [str(tmp_path / "in*.las"), heights, str(tmp_path / "o_#.las")]
    messages = run_tiled(stages, 100, workers=0).messages
    assert [("assumed to have" in m, "were assumed" in m) for m in messages if "assumed" in m] == [
        (True, False)
    ]


def test_an_output_without_a_reference_is_said(tmp_path, inputs):
    """The log says what was assumed, and that this is not written; `default_srs` writes it."""
    stages = [
        {"type": "readers.las", "filename": inputs(METERS, None)},
        {"type": "filters.hag_minima"},
        {"type": "writers.las", "filename": str(tmp_path / "o_#.las"), "forward": "all"},
    ]
    for options, known in (({}, False), ({"default_srs": METERS}, True)):
        run = run_tiled([{**stages[0], **options}, *stages[1:]], 40, workers=0)
        message = " ".join(run.messages)
        assert ("the output gets none: --readers.las.default_srs=EPSG:CODE" in message) != known
        out = laspy.read(tmp_path / "o_in1.las")
        assert any(entry.user_id == "LASF_Projection" for entry in out.vlrs) == known


def test_objects_of_files_without_a_reference_beside_others(tmp_path, inputs, capsys):
    inputs(METERS, None)
    files = [str(tmp_path / f"in{number}.las") for number in range(2)]
    assert main(["objects", *files, str(tmp_path / "town.geojson")]) == 1  # which have no classes
    assert f"{files[1]} has no spatial reference; it is assumed to have" in capsys.readouterr().err


# ---- units of x and y, and of z, the same for every command -------------------------------------------------

FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
HEIGHTS = 'VERT_CS["NAVD88",VERT_DATUM["North American Vertical Datum 1988",2005],UNIT["metre",1]]'
HEIGHTS_IN_FEET = HEIGHTS.replace('"metre",1', '"foot",0.3048')
#: GeoTIFF keys (3072 and 4096: systems, 3076 and 4099: units) or well-known text, and the units.
KINDS = [
    ({3072: 26910, 3076: 9002, 4099: 9001}, (FOOT, 1.0)),
    ({3072: 26910, 3076: 9003, 4099: 9001}, (SURVEY_FOOT, 1.0)),
    ({3072: 26910, 3076: 9001, 4099: 9002}, (1.0, FOOT)),
    ({3072: 26910, 3076: 9001, 4099: 9003}, (1.0, SURVEY_FOOT)),
    ({3072: 26910, 3076: 9002}, (FOOT, FOOT)),
    ({3072: 26910}, (1.0, 1.0)),
    ({3072: 2992, 4096: 5703}, (FOOT, 1.0)),
    ({3072: 2992, 4096: 6360}, (FOOT, SURVEY_FOOT)),
    ({3072: 26910, 4096: 6360}, (1.0, SURVEY_FOOT)),
    ({3072: 2992}, (FOOT, FOOT)),
    (f'COMPD_CS["a, ""b""",{FEET},{HEIGHTS}]', (SURVEY_FOOT, 1.0)),
    (f'COMPD_CS["both",{METERS},{HEIGHTS_IN_FEET}]', (1.0, FOOT)),
]


def referenced(path, reference):
    """Give a LAS file a spatial reference; its coordinates stay."""
    las = laspy.read(path)
    las.vlrs[:] = [entry for entry in las.vlrs if entry.user_id != "LASF_Projection"]
    las.header.global_encoding.wkt = isinstance(reference, str)
    if isinstance(reference, str):
        las.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(reference))
    else:
        keys = sorted({1024: 1, **reference}.items())
        rows = [struct.pack("<4H", 1, 1, 0, len(keys))]
        rows += [struct.pack("<4H", key, 0, 1, value) for key, value in keys]
        las.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", b"".join(rows)))
    las.write(path)


@pytest.mark.parametrize(("reference", "units"), KINDS)
def test_commands_and_stages_take_the_same_units(
    tmp_path, write_las, monkeypatch, reference, units
):
    n = 200
    xyz = np.random.default_rng(0).uniform(0, 40, (n, 3))
    minor = 4 if isinstance(reference, str) else 2
    path = write_las(
        tmp_path / "in.las", dict(zip("XYZ", xyz.T, strict=True)), 6 if minor == 4 else 1
    )
    referenced(path, reference)
    reference_values = reference_of_file(str(path))
    assert (reference_values.units.horizontal, reference_values.units.vertical) == pytest.approx(
        units
    )
    seen = []
    monkeypatch.setattr(
        HagMinima, "run", lambda self, points, context: seen.append(points.units) or {}
    )
    ps.run_pipeline([str(path), {"type": "filters.hag_minima"}])
    assert seen == [reference_values.units]
    part = horizontal_wkt(reference_values.wkt)
    assert part.startswith("PROJCRS[") and "VERT" not in part
    assert units_of_wkt(part).horizontal == pytest.approx(units[0])
    assert reference_of_file(str(path), "ft", "m").units == Units(FOOT, 1.0)


#: Units of x and y that agree with a system or contradict it, and units or systems of heights.
PLANES = [(3072, 26910), (3072, 2992), (3072, 32767), (1024, 1)]
HEIGHT_KEYS = [(4099, 9001), (4099, 9003), (4096, 6360)]


@pytest.mark.parametrize("minor", [2, 4])
@pytest.mark.parametrize("plane", PLANES)
def test_outputs_keep_the_units_of_their_inputs(tmp_path, write_las, plane, minor):
    """GDAL writes the unit of z for that of x and y into GeoTIFF keys where they differ."""
    path, out = tmp_path / "in.las", tmp_path / "out.las"
    xyz = dict(zip("XYZ", np.random.default_rng(0).uniform(0, 40, (3, 50)), strict=True))
    writer = {"type": "writers.las", "filename": str(out), "forward": "all"}
    writer |= {"minor_version": minor, "dataformat_id": 6 if minor == 4 else 1}
    for unit, height in itertools.product((9001, 9002), HEIGHT_KEYS):
        referenced(write_las(path, xyz, 1), dict([plane, (3076, unit), height]))
        units = reference_of_file(str(path)).units
        if minor == 2 and units.horizontal != units.vertical:
            with pytest.raises(StageError, match=r"\"minor_version\": 4"):
                ps.run_pipeline([str(path), writer])
            continue
        ps.run_pipeline([str(path), writer])
        assert reference_of_file(str(out)).units == reference_of_file(str(path)).units, (
            unit,
            height,
        )


def test_outputs_of_tiles_keep_the_units_of_their_inputs(tmp_path, write_las):
    xyz = dict(zip("XYZ", np.random.default_rng(0).uniform(0, 40, (3, 50)), strict=True))
    path = write_las(tmp_path / "in.las", xyz, 1)
    referenced(path, {3072: 26910, 3076: 9002, 4099: 9001})
    writer = {"type": "writers.las", "filename": str(tmp_path / "o_#.las"), "forward": "all"}
    with pytest.raises(StageError, match=r"\"minor_version\": 4"):
        run_tiled([str(path), {"type": "filters.hag_minima"}, writer], 20, workers=0)
    assert main(["classify", str(path), str(tmp_path / "o_#.las"), "--tile", "20"]) == 0
    assert reference_of_file(str(tmp_path / "o_in.las")).units == Units(FOOT, 1.0)


def test_objects_have_the_same_heights_whichever_way(tmp_path, run, run_job, write_las):
    """Feet across, meters up: by `objects` and by `writers.objects`, also of classified files."""
    pyogrio = pytest.importorskip("pyogrio")
    town = ps.make_town(60.0, 9.0, seed=4, progress=False)
    path = tmp_path / "town.las"
    write_town(town, path)
    las = laspy.read(path)
    z, arrays = np.asarray(las.z), {"X": las.x / FOOT, "Y": las.y / FOOT, "Z": las.z}
    arrays |= {"ReturnNumber": las.return_number, "NumberOfReturns": las.number_of_returns}
    write_las(path, {**arrays, "Classification": las.classification}, point_format=1)
    referenced(path, {3072: 2992, 3076: 9002, 4099: 9001})

    def buildings(name):
        about, _, _, columns = pyogrio.raw.read(tmp_path / name, layer="buildings")
        return about["crs"], dict(zip(about["fields"], columns, strict=True))

    def by_stage(source, name):
        reader = {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}
        writer = {"type": "writers.objects", "filename": str(tmp_path / name)}
        assert run_job([reader, writer])[0] == 0

    def same(one, other):
        assert one[0] == other[0] and one[1].keys() == other[1].keys()
        for name, values in one[1].items():
            np.testing.assert_array_equal(values, other[1][name], name)

    assert run("objects", path, tmp_path / "a.gpkg")[0] == 0
    by_stage(path, "b.gpkg")
    crs, columns = buildings("a.gpkg")
    same((crs, columns), buildings("b.gpkg"))
    assert 3 < columns["h_ridge"].max() < np.ptp(z)
    out = tmp_path / "out.las"
    assert run("classify", path, out)[0] == run("objects", out, tmp_path / "c.gpkg")[0] == 0
    by_stage(out, "d.gpkg")
    same(buildings("c.gpkg"), buildings("d.gpkg"))
    written = laspy.read(out)
    assert 3 < np.percentile(written.HeightAboveGround, 99) < np.ptp(z)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_kilometers_and_millimeters_up_are_doubted(tmp_path, run, write_las, scale):
    """A wood of 8 m, 1,500 m above the sea, whose heights are no meters."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 60, (2, 40_000))
    second = np.arange(40_000) % 2
    z = scale * (1500 + np.where(second, 0.0, rng.uniform(0, 8, 40_000)))
    returns = {"ReturnNumber": 1 + second, "NumberOfReturns": np.full(40_000, 2)}
    arrays = {"X": x + 5e5, "Y": y + 5e6, "Z": z, **returns}
    source = write_las(tmp_path / "in.las", arrays, 1)
    code, _, err = run("classify", source, tmp_path / "out.las")
    assert code == 0 and "the unit of z may be wrong" in err, err
    noise = np.isin(laspy.read(tmp_path / "out.las").classification, (7, 18))
    assert noise.mean() < 0.5


def test_feet_up_that_are_taken_for_meters_are_doubted(tmp_path, run, write_las):
    """A wood of 40 m in feet; with a reference that names the heights' system all is well."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 60, (2, 40_000))
    wood = (np.arange(40_000) % 4 > 0) & (np.hypot(x - 30, y - 30) < 25)
    z = np.where(wood, rng.uniform(36, 40, 40_000), 0.0) / FOOT
    returns = {"ReturnNumber": np.where(wood, 1, 2), "NumberOfReturns": np.full(40_000, 2)}
    source = write_las(tmp_path / "in.las", {"X": x + 5e5, "Y": y + 5e6, "Z": z, **returns}, 1)
    referenced(source, {3072: 26910})
    for words, doubted in ((), True), (("--readers.las.override_srs=EPSG:26910+8228",), False):
        code, _, err = run("classify", source, tmp_path / "out.las", *words)
        assert code == 0 and ("the unit of z may be wrong" in err) == doubted, err
        assert (np.asarray(laspy.read(tmp_path / "out.las").classification) == 5).sum() > 5000


@pytest.mark.parametrize("tile", [(), ("--tile", "50", "--workers", "0")])
@pytest.mark.parametrize("option", ["override_srs", "default_srs"])
def test_a_reference_system_that_nobody_knows_is_refused(tmp_path, write_las, capsys, option, tile):
    """The option is at fault, not the input."""
    arrays = {axis: np.arange(50.0) for axis in "XYZ"}
    path = write_las(tmp_path / "a.las", arrays)
    words = [str(path), str(tmp_path / "out.las"), f"--readers.las.{option}=EPSG:1", *tile]
    assert main(["classify", *words, "--no-progress"]) == 1
    said = capsys.readouterr().err
    assert "reference system" in said and "Give a code, EPSG:CODE" in said, said
    assert "failed" not in said and "EPSG:1'" in said, said
