"""Length units in well-known text."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.base.units import (
    Units,
    doubt_vertical_unit,
    is_too_flat,
    parse_wkt,
    units_of_wkt,
)

GEOGCS = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],UNIT["degree",0.0174532925199433]]'
METERS = f'PROJCS["UTM 32N",{GEOGCS},PROJECTION["Transverse_Mercator"],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
FOOT = 0.304800609601219
FEET = METERS.replace('UNIT["metre",1', f'UNIT["US survey foot",{FOOT}')
BOTH = f'COMPD_CS["both",{METERS},VERT_CS["NAVD88",VERT_DATUM["x",2005],UNIT["foot",0.3048]]]'
WKT2 = (
    'PROJCRS["x",BASEGEOGCRS["WGS 84",DATUM["d",ELLIPSOID["e",6378137,298.2,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["c",METHOD["m"]],CS[Cartesian,2],AXIS["e",east,LENGTHUNIT["foot",0.3048]],'
    'AXIS["n",north,LENGTHUNIT["foot",0.3048]]]'
)
LOCAL = 'LOCAL_CS["here",UNIT["odd",{}]]'


def test_units_of_references():
    """Without a vertical part heights are as x and y; WKT 2 may have units on axes; options overrule."""
    assert units_of_wkt(METERS) == Units()
    assert units_of_wkt(FEET) == Units(FOOT, FOOT)
    assert units_of_wkt(BOTH) == Units(1.0, 0.3048)
    assert units_of_wkt(WKT2) == Units(0.3048, 0.3048)
    assert units_of_wkt("") == Units(assumed=True)
    assert units_of_wkt(METERS, vertical="ft") == Units(1.0, 0.3048)
    with pytest.raises(OptionError, match="Did you mean 'metre'"):
        units_of_wkt("", horizontal="mtre")
    for unit in (0.0254, 0.001, 1609.344):
        assert units_of_wkt(LOCAL.format(unit)).horizontal == unit
    for unit in ("1e-300", "1e300", "0.0000001"):
        with pytest.raises(StageError, match="unit of length"):
            units_of_wkt(LOCAL.format(unit))
        assert (
            units_of_wkt(LOCAL.format(unit), horizontal="foot", vertical="foot").horizontal
            == 0.3048
        )


def test_vegetation_too_high_to_be_true_doubts_the_unit_of_z():
    feet = np.linspace(0, 40, 5000) / 0.3048  # of a wood 40 m high, taken for meters
    assert "override_srs" in doubt_vertical_unit(feet, 0.0, 1.0)
    for fine in (np.linspace(0, 95, 5000), feet[:900], np.append(np.zeros(5000), [500.0] * 40)):
        assert not doubt_vertical_unit(fine, 0.0, 1.0)


def test_land_in_the_sky_doubts_the_unit_of_z():
    none = np.zeros(0)
    assert "above or below the sea" in doubt_vertical_unit(none, 0.0, 1.0, 1_200_000.0)
    assert not doubt_vertical_unit(none, 0.0, 1.0, 8_849.0)


def test_a_wood_that_is_flat_doubts_the_unit_of_z():
    wood, returns = np.linspace(0, 40, 5000), np.tile([1, 2], 2500)
    assert is_too_flat(wood / 1000, returns)
    assert not is_too_flat(wood, returns) and not is_too_flat(wood / 1000, np.ones(5000))
    assert "several returns" in doubt_vertical_unit(np.zeros(0), 0.0, 1.0, too_flat=True)


@pytest.mark.parametrize(
    "wkt",
    [
        'GEOCCS["WGS 84",DATUM["d",SPHEROID["e",6378137,298.2]],UNIT["metre",1],AXIS["Geocentric X",OTHER]]',
        'GEODCRS["WGS 84",DATUM["d",ELLIPSOID["e",6378137,298.2]],CS[Cartesian,3],AXIS["x",geocentricX],UNIT["metre",1]]',
    ],
)
def test_the_center_of_the_earth_is_no_place_to_measure_heights_from(wkt):
    with pytest.raises(StageError, match=r"geocentric .*EPSG:CODE"):
        units_of_wkt(wkt, place=(9.0, 50.0))


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ((-5.99, 37.39), 32630),  # Seville
        ((151.2, -33.9), 32756),
        ((180.0, 10.0), 32660),
        ((770600.0, 6277549.0), "CODE"),
    ],
)
def test_degrees_are_refused_and_the_zone_of_the_points_is_named(place, code):
    with pytest.raises(StageError, match=rf"filters\.reprojection.*EPSG:{code}"):
        units_of_wkt(GEOGCS, place=place)


@given(st.text(max_size=60))
def test_any_text_is_survived(text):
    parse_wkt(text)
