"""A town as a LAS 1.4 or LAZ file."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import numpy as np

from ..base.errors import OptionError, StageError
from ..base.files import whole_files
from ..base.version import __version__
from .town import Town

#: The reference system of a town's file.
WKT = (
    'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",'
    'SPHEROID["GRS 1980",6378137,298.257222101,AUTHORITY["EPSG","7019"]],AUTHORITY["EPSG","6258"]],'
    'PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
    'AUTHORITY["EPSG","4258"]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],'
    'AXIS["Northing",NORTH],AUTHORITY["EPSG","25832"]]'
)


def write_town(town: Town, path: str | os.PathLike) -> None:
    """Write a town to a LAS or LAZ file (by its suffix), whole or not at all."""
    import laspy

    target = Path(path)
    if target.suffix.lower() not in (".las", ".laz"):
        raise OptionError("the output's name must end in .las or .laz", where="write_town", found=str(path))
    if not len(town):
        raise StageError(
            "no pulse hit this town", where="synthetic", cure="Give a larger 'size' or 'density'"
        )
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.array(town.options.origin))
    header.creation_date = datetime.date(2020, 7, 1)  # fixed, so that the same town gives the same bytes
    header.system_identifier, header.generating_software = "generated town", f"pdal-stages {__version__}"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", WKT.encode() + b"\0"))
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(town), header=header))
    las.X, las.Y, las.Z = np.round((town.xyz - header.offsets) * 1000.0).astype(np.int32).T
    for name in (
        "classification",
        "intensity",
        "return_number",
        "number_of_returns",
        "gps_time",
        "point_source_id",
    ):
        las[name] = getattr(town, name)
    las["scan_angle"] = np.round(town.scan_angle / 0.006).astype(np.int16)
    with whole_files(target) as (part,), open(part, "wb") as file:
        las.write(file, do_compress=target.suffix.lower() == ".laz")
