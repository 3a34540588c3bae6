"""A town as a LAS or LAZ file, written chunk by chunk, whole or not at all."""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import DependencyError, OptionError, StageError
from ..base.files import whole_files
from ..base.version import __version__
from .materials import RGB
from .srs import geo_keys, wkt
from .town import Town, TownOptions, town_chunks

_LOWEST_MINOR = {0: 2, 1: 2, 2: 2, 3: 2, 6: 4, 7: 4, 8: 4}


def _header(options: TownOptions, minor_version: int, dataformat_id: int, true_height: bool) -> Any:
    import laspy

    if dataformat_id not in _LOWEST_MINOR:
        raise OptionError(
            "'dataformat_id' must be 0, 1, 2, 3, 6, 7 or 8", where="write_town", found=dataformat_id
        )
    if minor_version not in (2, 3, 4) or minor_version < _LOWEST_MINOR[dataformat_id]:
        raise OptionError(
            f"point format {dataformat_id} needs 'minor_version' {_LOWEST_MINOR[dataformat_id]} to 4",
            where="write_town",
            found=minor_version,
        )
    header = laspy.LasHeader(version=f"1.{minor_version}", point_format=dataformat_id)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(np.array(options.origin))
    # Fixed, so that the same town gives the same bytes.
    header.creation_date = datetime.date(2020, 7, 1)
    header.system_identifier = "generated town"
    header.generating_software = f"pdal-stages {__version__}"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if dataformat_id >= 6:
        header.global_encoding.wkt = True
        text = wkt(options.srs)
        if text is not None:
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", text.encode() + b"\0"))
    else:
        keys = geo_keys(options.srs)
        if keys is not None:
            header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "GeoKeyDirectoryTag", keys))
    if true_height:
        header.add_extra_dim(laspy.ExtraBytesParams("TrueHeight", "float32", "above the bare ground"))
    return header


def _record(header: Any, town: Town, dataformat_id: int, true_height: bool) -> Any:
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(town), header=header)
    whole = np.round((town.xyz - header.offsets) * 1000.0).astype(np.int64)
    if len(whole) and np.abs(whole).max() >= 2**31:
        raise StageError(
            "coordinates do not fit LAS's 32 bits", where="write_town", found=town.xyz.max(axis=0)
        )
    record["X"], record["Y"], record["Z"] = whole.astype(np.int32).T
    record["classification"] = town.classification
    record["intensity"] = town.intensity
    record["return_number"] = town.return_number
    record["number_of_returns"] = town.number_of_returns
    record["point_source_id"] = town.point_source_id
    record["edge_of_flight_line"] = town.edge_of_flight_line.astype(np.uint8)
    record["scan_direction_flag"] = np.zeros(len(town), dtype=np.uint8)  # right to left
    if dataformat_id >= 6:
        record["scan_angle"] = np.round(town.scan_angle / 0.006).astype(np.int16)
    else:
        record["scan_angle_rank"] = np.round(town.scan_angle).astype(np.int8)
    if dataformat_id not in (0, 2):
        record["gps_time"] = town.gps_time
    if dataformat_id in (2, 3, 7, 8):
        rgb = RGB[town.material].astype(np.float64)
        # A photograph's grain, from the coordinates alone.
        grain = 0.9 + 0.2 * (np.abs(whole).sum(axis=1) * 2654435761 % 1000) / 1000.0
        rgb = np.clip(rgb * grain[:, None], 0, 255).astype(np.uint16) * 257
        record["red"], record["green"], record["blue"] = rgb.T
        if dataformat_id == 8:
            record["nir"] = np.minimum(town.intensity.astype(np.int64) * 24, 65535).astype(np.uint16)
    if true_height:
        record["TrueHeight"] = town.height_above_ground
    return record


def write_town(
    town: Town | TownOptions | Iterable[Town],
    path: str | os.PathLike,
    *,
    minor_version: int = 4,
    dataformat_id: int = 6,
    true_height: bool = False,
    threads: int | None = None,
) -> dict[int, int]:
    """Write a town to a LAS or LAZ file (by its suffix); the file appears whole or not at all.

    Parameters
    ----------
    town : Town, TownOptions or iterable of Town
        Points; or options, to generate and write in memory that does not grow with the town.
    path : path
    minor_version, dataformat_id : int
        LAS 1.2 to 1.4; point format 0 to 3 or 6 to 8.
    true_height : bool
        Add the extra dimension ``TrueHeight``, metres above the bare ground.

    Returns
    -------
    dict
        Points written by class code.
    """
    import laspy

    target = Path(path)
    if target.suffix.lower() not in (".las", ".laz"):
        raise OptionError("the output's name must end in .las or .laz", where="write_town", found=str(path))
    compress = target.suffix.lower() == ".laz"
    if compress and not laspy.LazBackend.detect_available():
        raise DependencyError(
            "LAZ needs a compressor for laspy", where="write_town", cure="pip install 'laspy[lazrs]'"
        )
    if not target.parent.is_dir():
        raise OptionError("the output's folder does not exist", where="write_town", found=str(target.parent))
    pieces: Iterable[Town]
    if isinstance(town, TownOptions):
        options, pieces = town, town_chunks(town, threads=threads)
    elif isinstance(town, Town):
        options, pieces = town.options, [town]
    else:
        iterator = iter(town)
        first = next(iterator, None)
        if first is None:
            raise StageError("there are no points to write", where="write_town")
        options = first.options

        def chained():
            yield first
            yield from iterator

        pieces = chained()
    header = _header(options, minor_version, dataformat_id, true_height)
    counts = np.zeros(256, dtype=np.int64)
    with whole_files(target) as (partial,):
        with laspy.open(partial, mode="w", header=header, do_compress=compress) as writer:
            for piece in pieces:
                writer.write_points(_record(writer.header, piece, dataformat_id, true_height))
                counts += np.bincount(piece.classification, minlength=256)
        if not counts.any():
            raise StageError(
                "no pulse hit this town", where="write_town", cure="Give a larger 'size' or 'density'"
            )
    return {int(code): int(counts[code]) for code in np.flatnonzero(counts)}
