"""Inputs of meters, feet and degrees beside each other are refused, in tiles and without."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.base.errors import StageError
from pdal_stages.cli import main
from pdal_stages.pipeline.references import reference_of_file

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
        said = str(caught.value)
        assert "0.304801 m" in said and "1 m" in said and "in0.las" in said and "in1.las" in said
        assert ("as there is no spatial reference" in said) == (two is None)
    assert not list(tmp_path.glob("o_*")) and not (tmp_path / "whole.las").exists()


def test_degrees_beside_meters(tmp_path, inputs):
    for way in ways(tmp_path, inputs(METERS, DEGREES)):
        with pytest.raises(StageError, match=r"degrees.*in1\.las|in1\.las.*degrees"):
            way()


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
    for messages in (whole.messages, run_tiled([*stages, writer], 40, workers=0).messages):
        said = [one for one in messages if "assumed to have that of the other inputs" in one]
        assert len(said) == (1 if any(references) else 0)
        for line in said:
            assert (
                f"{tmp_path / 'in1.las'}, {tmp_path / 'in3.las'} have no spatial reference" in line
            )


def test_objects_of_files_without_a_reference_beside_others(tmp_path, inputs, capsys):
    inputs(METERS, None)
    files = [str(tmp_path / f"in{number}.las") for number in range(2)]
    assert main(["objects", *files, str(tmp_path / "town.geojson")]) == 1  # which have no classes
    assert f"{files[1]} has no spatial reference; it is assumed to have" in capsys.readouterr().err


def test_geotiff_keys_of_las_14_in_old_point_formats(tmp_path, write_las):
    path, xyz = tmp_path / "in.las", np.random.default_rng(0).uniform(0, 30, (3, 100))
    for key, value, horizontal in (
        (3072, 2264, 1200 / 3937),
        (3072, 32767, 1.0),
        (4096, 5703, 1.0),
    ):
        las = laspy.read(write_las(path, dict(zip("XYZ", xyz, strict=True)), 1, 4))
        data = struct.pack("<8H", 1, 1, 0, 1, key, 0, 1, value)
        las.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
        las.write(path)
        assert reference_of_file(str(path)).units.horizontal == pytest.approx(horizontal)
