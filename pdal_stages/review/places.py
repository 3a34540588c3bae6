"""Places whose points are to be explained: from the command line, a CSV file or a vector file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..base.errors import OptionError, StageError
from ..base.las_boxes import FilePoints
from ..base.point_rows import read_point_rows
from ..base.vector import reading, vector
from ..features.cell_means import density
from ..pipeline.inputs_outputs import input_files
from ..pipeline.spatial_reference import reference_of_file

#: Farthest that the nearest point may be, in meters, ...
_FARTHEST_M = 2.0
#: ... or in mean distances between points, where these are larger.
_FARTHEST_SPACINGS = 3.0
#: Meters within which points tell the mean distance between them.
_SPACING_M = 50.0


class AskedPlace(NamedTuple):
    """A place at which a point is looked for, in the coordinates of the cloud."""

    x: float
    y: float
    z: float | None = None

    def nearest(self, cloud: FilePoints, unit: float) -> tuple[int, float]:
        """Return the row of the nearest point and its distance in meters; StageError if far.

        `unit` are the meters of a unit of the coordinates.
        """
        reason, target = "no point at all", np.array([v for v in self if v is not None])
        if len(cloud.number):
            x, y = (unit * (cloud[axis] - at) for axis, at in zip("XY", target[:2], strict=True))
            rows = np.flatnonzero((np.abs(x) <= _SPACING_M) & (np.abs(y) <= _SPACING_M))
            rows = rows if len(rows) else np.arange(len(x))
            xyz = unit * np.column_stack([cloud[axis][rows] for axis in "XYZ"])
            away = np.sqrt(((xyz[:, : len(target)] - unit * target) ** 2).sum(axis=1))
            least, near = int(np.argmin(away)), away < _SPACING_M
            spacing = 1.0 / np.sqrt(density(xyz[near])) if near.any() else 0.0
            if away[least] <= max(_FARTHEST_M, _FARTHEST_SPACINGS * spacing):
                return int(rows[least]), float(away[least])
            reason = f"the nearest is {away[least]:.1f} m away"
            flat = np.hypot(x[rows], y[rows])
            if len(target) == 3 and flat.min() <= _FARTHEST_M:
                height = cloud["Z"][rows[flat.argmin()]]
                reason += f"; without Z {flat.min():.1f} m, at a height of {height:.2f}"
        raise StageError(
            "there is no point near this place",
            where=" ".join(f"{value:.12g}" for value in target),
            found=reason,
            cure="Give X and Y in the cloud's reference system, or name theirs with --crs",
        )


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
    places = _transform(places, crs, cloud) if crs else places
    for place in places:
        if not all(math.isfinite(value) for value in place if value is not None):
            raise OptionError(
                "a place is not of finite numbers in the cloud's reference system",
                found=" ".join(f"{value:.12g}" for value in place if value is not None),
                cure="Check the order of X and Y, and --crs",
            )
    return places


def _read_csv(path: str) -> list[AskedPlace]:
    """Return the points of a CSV file."""
    rows = read_point_rows(path, "point", needs_z=False)
    return [AskedPlace(row.x, row.y, row.z) for row in rows]


def _read_vector(path: str) -> tuple[list[AskedPlace], str]:
    """Return the points of the first layer of a vector file, and its reference system.

    A feature must be one point, so that explanations follow its order.
    """
    shapely, places = vector("shapely"), []
    with reading(path) as name:
        info, _, geometry, _ = vector("pyogrio").raw.read(name, columns=[])
        shapes = shapely.from_wkb(geometry)
        for number, shape in enumerate(shapes, 1):
            parts = [] if shape is None or shape.is_empty else [*shapely.get_parts([shape])]
            if len(parts) != 1 or parts[0].geom_type != "Point":
                kind = "no geometry" if not parts else f"a {shape.geom_type}"
                raise StageError(
                    "a feature is not one point",
                    where=f"{path}, feature {number}",
                    found=kind,
                    cure="Give a layer of points",
                )
            x, y, *z = parts[0].coords[0]
            places.append(AskedPlace(x, y, z[0] if z and math.isfinite(z[0]) else None))
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
