"""Spatial reference records of LAS: WKT for point formats 6 and up, GeoTIFF keys below."""

from __future__ import annotations

import re
import struct

from ..base.errors import OptionError

_ETRS89 = (
    'GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",'
    'SPHEROID["GRS 1980",6378137,298.257222101,AUTHORITY["EPSG","7019"]],AUTHORITY["EPSG","6258"]],'
    'PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4258"]]'
)
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)


def epsg_code(srs: str) -> int | None:
    """The number of ``EPSG:n``; None for 'none' or an empty text."""
    if srs.strip().lower() in ("none", ""):
        return None
    match = re.fullmatch(r"\s*epsg:(\d{4,6})\s*", srs, re.IGNORECASE)
    if not match:
        raise OptionError(
            "'srs' must be EPSG: and a number, or none",
            where="synthetic",
            found=srs,
            cure="For example EPSG:25832",
        )
    return int(match.group(1))


def wkt(srs: str) -> str | None:
    """OGC WKT 1 of a coordinate system.

    UTM zones on ETRS89 (EPSG:25828-25838) and WGS 84 (EPSG:326xx, 327xx) are written by hand; any other needs
    the optional package pyproj.
    """
    code = epsg_code(srs)
    if code is None:
        return None
    if 25828 <= code <= 25838:
        zone, base, name, south = code - 25800, _ETRS89, "ETRS89", False
    elif 32601 <= code <= 32660 or 32701 <= code <= 32760:
        zone, base, name, south = code % 100, _WGS84, "WGS 84", code > 32700
    else:
        try:
            from pyproj import CRS  # type: ignore[import-not-found]
        except ImportError as error:
            raise OptionError(
                "this coordinate system's WKT is not built in",
                where="synthetic",
                found=srs,
                cure="Use a UTM zone (EPSG:25828-25838, 326xx, 327xx), a dataformat_id below 6, which "
                "needs no WKT, or install pyproj",
            ) from error
        try:
            return CRS.from_epsg(code).to_wkt("WKT1_GDAL")
        except Exception as error:
            raise OptionError("unknown coordinate system", where="synthetic", found=srs) from error
    hemisphere = "S" if south else "N"
    return (
        f'PROJCS["{name} / UTM zone {zone}{hemisphere}",{base},PROJECTION["Transverse_Mercator"],'
        f'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",{6 * zone - 183}],'
        f'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
        f'PARAMETER["false_northing",{10000000 if south else 0}],UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
        f'AXIS["Easting",EAST],AXIS["Northing",NORTH],AUTHORITY["EPSG","{code}"]]'
    )


def geo_keys(srs: str) -> bytes | None:
    """A GeoKeyDirectory for a projected system in metres."""
    code = epsg_code(srs)
    if code is None:
        return None
    if code > 65535:
        raise OptionError(
            "GeoTIFF keys hold EPSG numbers up to 65535",
            where="synthetic",
            found=srs,
            cure="Use dataformat_id 6 or above",
        )
    keys = [(1024, 1), (1025, 1), (3072, code), (3076, 9001)]  # projected, area, the system, metre
    directory = struct.pack("<4H", 1, 1, 0, len(keys))
    return directory + b"".join(struct.pack("<4H", key, 0, 1, value) for key, value in keys)
