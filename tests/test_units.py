"""Length units in well-known text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.base.units import Units, parse_wkt, units_of_wkt, utm_code

GEOGCS = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],UNIT["degree",0.0174532925199433]]'
)
METERS = (
    f'PROJCS["UTM 32N",{GEOGCS},PROJECTION["Transverse_Mercator"],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)
FEET = METERS.replace('UNIT["metre",1', 'UNIT["US survey foot",0.304800609601219')
VERTICAL = 'VERT_CS["NAVD88",VERT_DATUM["x",2005],UNIT["{}",{}]]'
WKT2 = (
    'PROJCRS["x",BASEGEOGCRS["WGS 84",DATUM["d",ELLIPSOID["e",6378137,298.2,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["c",METHOD["m"]],CS[Cartesian,2],AXIS["e",east,LENGTHUNIT["foot",0.3048]],'
    'AXIS["n",north,LENGTHUNIT["foot",0.3048]]]'
)


def test_meters_and_feet():
    assert units_of_wkt(METERS) == Units()
    feet = units_of_wkt(FEET)
    assert feet.horizontal == pytest.approx(1200 / 3937)
    assert feet.vertical == feet.horizontal  # no vertical part: as x and y


def test_compound_systems_have_two_units():
    mixed = units_of_wkt(f'COMPD_CS["both",{METERS},{VERTICAL.format("foot", 0.3048)}]')
    assert (mixed.horizontal, mixed.vertical) == (1.0, 0.3048)


def test_wkt2_units_may_sit_on_axes():
    assert units_of_wkt(WKT2).horizontal == 0.3048


def test_options_overrule():
    units = units_of_wkt(METERS, vertical="ft")
    assert (units.horizontal, units.vertical) == (1.0, 0.3048)
    with pytest.raises(OptionError, match="Did you mean 'metre'"):
        units_of_wkt("", horizontal="mtre")


def test_degrees_are_refused_with_the_cure():
    with pytest.raises(StageError, match=r"filters\.reprojection"):
        units_of_wkt(GEOGCS)


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
    ("place", "name", "code"),
    [
        ((-5.99, 37.39), "ETRS89", 25830),  # Seville
        ((-5.99, 37.39), "WGS 84", 32630),
        ((3.87, 43.61), "RGF93", 32631),
        ((-123.07, 44.05), "NAD83(HARN)", 26910),
        ((151.2, -33.9), "GDA94", 32756),
        ((5.3, 60.4), "ETRS89", 25832),  # Bergen
        ((180.0, 10.0), "", 32660),
        ((770600.0, 6277549.0), "", None),
    ],
)
def test_the_zone_of_the_points_is_named(place, name, code):
    assert utm_code(*place, name) == code
    with pytest.raises(StageError) as caught:
        units_of_wkt(GEOGCS.replace("WGS 84", name or "WGS 84"), place=place)
    assert f"EPSG:{code or 'CODE'}" in str(caught.value)


@given(st.text(max_size=60))
def test_any_text_is_survived(text):
    parse_wkt(text)
