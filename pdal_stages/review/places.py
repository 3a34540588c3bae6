"""Places whose points are to be explained: from the command line, a CSV file or a vector file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..base.errors import OptionError, StageError
from ..base.vector import reading, vector
from ..pipeline.inputs_outputs import input_files
from ..pipeline.spatial_reference import reference_of_file
from .explanation import AskedPlace


def read_places(
    cloud: str, numbers: Sequence[float], points: str = "", crs: str = ""
) -> list[AskedPlace]:
    """Return places in the coordinates of a cloud.

    Parameters
    ----------
    cloud : str
        File, folder or pattern.
    numbers : sequence of float
        X, Y and, where it is known, Z of one place.
    points : str
        CSV file or vector file of further places.
    crs : str
        Reference system of X and Y; by default that of the vector file, else the cloud's.
    """
    places = [AskedPlace(*numbers)] if len(numbers) in (2, 3) else []
    if points:
        is_csv = Path(points).suffix.lower() in (".csv", ".txt")
        more, of_file = (_read_csv(points), "") if is_csv else _read_vector(points)
        places, crs = places + more, crs or of_file
    if not places or len(numbers) not in (0, 2, 3):
        raise OptionError(
            "a place is X Y or X Y Z",
            found=" ".join(map(str, numbers)) or "none",
            cure="For example: pdal-stages explain cloud.laz 652034 6862010, or --points FILE",
        )
    return _transform(places, crs, cloud) if crs else places


def _read_csv(path: str) -> list[AskedPlace]:
    """Return the first two or three numbers of each row; the first row may be a heading."""
    with reading(path, "the points cannot be read", "Give rows of x,y or x,y,z") as name:
        rows = np.genfromtxt(name, delimiter=",", encoding="utf-8-sig", ndmin=2)[:, :3]
    rows = rows[int(len(rows) and np.isnan(rows[0, :2]).any()) :]
    if np.isnan(rows[:, :2]).any():
        number = int(np.argmax(np.isnan(rows[:, :2]).any(axis=1)))
        raise StageError(f"point {number + 1} is not x,y or x,y,z", where=path)
    return [AskedPlace(x, y, *(v for v in z if v == v)) for x, y, *z in rows.tolist()]


def _read_vector(path: str) -> tuple[list[AskedPlace], str]:
    """Return the points of the first layer of a vector file, and its reference system."""
    with reading(path) as name:
        info, _, geometry, _ = vector("pyogrio").raw.read(name, columns=[])
        points = vector("shapely").get_parts(vector("shapely").from_wkb(geometry))
        coordinates = [point.coords[0] for point in points]
        places = [AskedPlace(xyz[0], xyz[1], *xyz[2:3]) for xyz in coordinates]
    return places, str(info["crs"] or "")


def _transform(places: Sequence[AskedPlace], crs: str, cloud: str) -> list[AskedPlace]:
    """Return places of another reference system in that of a cloud."""
    pyproj, wkt = vector("pyproj"), reference_of_file(input_files([cloud])[0]).wkt
    if not wkt:
        raise OptionError("the cloud has no reference system", found=cloud, cure="Omit --crs")
    try:
        forward = pyproj.Transformer.from_crs(crs, pyproj.CRS(wkt).to_2d(), always_xy=True)
        x, y = forward.transform([each.x for each in places], [each.y for each in places])
        return [
            AskedPlace(float(a), float(b), each.z) for a, b, each in zip(x, y, places, strict=True)
        ]
    except Exception as error:  # pyproj's own
        raise OptionError("the places cannot be made the cloud's", found=str(error)) from None
