"""A town as a LAS 1.4 or LAZ file, written chunk by chunk, whole or not at all."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..base.errors import OptionError, StageError
from ..base.files import whole_files
from ..base.version import __version__
from .town import Town, TownOptions, town_chunks

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


def write_town(town: Town | TownOptions, path: str | os.PathLike, *, threads=None) -> dict[int, int]:
    """Write a town to a LAS or LAZ file (by its suffix), whole or not at all; the points written by class code.

    Options instead of points are generated and written in memory that does not grow with the town.
    """
    import laspy

    target = Path(path)
    if target.suffix.lower() not in (".las", ".laz"):
        raise OptionError("the output's name must end in .las or .laz", where="write_town", found=str(path))
    options = town.options if isinstance(town, Town) else town
    pieces = [town] if isinstance(town, Town) else town_chunks(town, threads=threads)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.array(options.origin))
    header.creation_date = datetime.date(2020, 7, 1)  # fixed, so that the same town gives the same bytes
    header.system_identifier, header.generating_software = "generated town", f"pdal-stages {__version__}"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", WKT.encode() + b"\0"))
    counts = np.zeros(256, dtype=np.int64)
    compress = target.suffix.lower() == ".laz"
    with (
        whole_files(target) as (part,),
        _plain_errors(),
        laspy.open(part, mode="w", header=header, do_compress=compress) as writer,
    ):
        for piece in pieces:
            record = laspy.ScaleAwarePointRecord.zeros(len(piece), header=writer.header)
            whole = np.round((piece.xyz - header.offsets) * 1000.0).astype(np.int32)
            record["X"], record["Y"], record["Z"] = whole[:, 0], whole[:, 1], whole[:, 2]
            for name in ("classification", "intensity", "return_number", "number_of_returns"):
                record[name] = getattr(piece, name)
            record["gps_time"], record["point_source_id"] = piece.gps_time, piece.point_source_id
            record["scan_angle"] = np.round(piece.scan_angle / 0.006).astype(np.int16)
            writer.write_points(record)
            counts += np.bincount(piece.classification, minlength=256)
        if not counts.any():
            cure = "Give a larger 'size' or 'density'"
            raise StageError("no pulse hit this town", where="synthetic", cure=cure)
    return {int(code): int(counts[code]) for code in np.flatnonzero(counts)}


@contextlib.contextmanager
def _plain_errors() -> Iterator[None]:
    """The compressor says with an error of its own that it could not write."""
    import lazrs

    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(errno.EIO, str(error)) from None
