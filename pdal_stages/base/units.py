"""Length units of a spatial reference: how many meters one unit of x, y and z is."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import OptionError, StageError, suggest
from .grid import compact_keys, places_among

#: Names users write, in meters.
NAMED = {
    **dict.fromkeys(("metre", "meter", "m"), 1.0),
    **dict.fromkeys(("foot", "ft"), 0.3048),
    **dict.fromkeys(("us-ft", "us survey foot"), 1200.0 / 3937.0),
    "centimetre": 0.01,
    "kilometre": 1000.0,
}


#: The smallest plausible unit, in meters: a thousandth of a millimeter. Beyond it and _LARGEST a
#: reference is damaged.
_SMALLEST = 1e-6
#: The largest plausible unit, in meters.
_LARGEST = 1e6


@dataclass(frozen=True)
class Units:
    """Meters per unit of x and y (`horizontal`) and of z (`vertical`).

    `assumed` says that the cloud names no spatial reference and meters were assumed.
    """

    horizontal: float = 1.0
    vertical: float = 1.0
    assumed: bool = False


@dataclass(frozen=True)
class UnitDoubts:
    """Limits beyond which the unit of z is doubted.

    Feet taken for meters make heights and slopes 3.28 times too large.
    """

    #: the tallest trees known are 116 m high; no wood has 1 % of its points above 100 m
    vegetation_m: float = 100.0
    vegetation_share: float = 0.01  #: single points may be birds or tips of masts
    least_points: int = 1000  #: fewer say little
    cell_m: float = 10.0  #: wide enough that walls and noise do not make slopes
    #: of the ground; the steepest of 60 surveyed places, a canyon side in California, had 0.86 (no
    #: command keeps that table)
    median_slope: float = 1.5
    least_cells: int = 20  #: with two neighbors; fewer may be a single cliff
    most_points: int = 200_000  #: a slope is as good from a sample
    #: returns of one pulse are half a meter and more apart, so half of these points are higher
    multiple_share: float = 0.05
    flat_m: float = (
        0.1  #: kilometers taken for meters bring 99 % of the points this close to ground
    )
    elevation_m: float = 10_000.0  #: above it there is no land, and below -10,000 none either


def doubt_vertical_unit(
    height_m: NDArray,
    slope: float,
    vertical: float,
    elevation_m: float = 0.0,
    too_flat: bool = False,
) -> str:
    """Return a warning if vegetation, ground or its slope is too high to be true, else "".

    Parameters
    ----------
    height_m : (n,) array
        Heights of the points of vegetation above the ground, in meters.
    slope : float
        The ground's :func:`median_slope`.
    vertical : float
        The unit of z that was assumed, in meters.
    elevation_m : float
        The points' median elevation, in meters.
    too_flat : bool
        What :func:`is_too_flat` returns.

    Returns
    -------
    str
        The text is the same for all tiles of a survey.
    """
    limits = UnitDoubts()
    high = np.count_nonzero(height_m > limits.vegetation_m)
    if len(height_m) >= limits.least_points and high > limits.vegetation_share * len(height_m):
        share = f"{100 * limits.vegetation_share:g} %"
        what = f"more than {share} of the vegetation is higher than {limits.vegetation_m:g} m"
    elif slope > limits.median_slope:
        what = f"half of the ground rises by more than {limits.median_slope:g} m a meter"
    elif abs(elevation_m) > limits.elevation_m:
        what = (
            f"half of the points are more than {limits.elevation_m:,.0f} m above or below the sea"
        )
    elif too_flat:
        what = (
            f"nearly all points lie within {limits.flat_m:g} m of the ground, though many pulses "
            "have several returns"
        )
    else:
        return ""
    return (
        f"{what}, so the unit of z may be wrong (taken to be {vertical:.6g} m). Override it by a "
        "reference that names the heights' system, such as "
        "--readers.las.override_srs=EPSG:26910+6360 (US survey feet), or by 'vertical_unit' of "
        "each stage"
    )


def is_too_flat(
    height_m: NDArray, returns_of_pulse: NDArray, limits: UnitDoubts = UnitDoubts()
) -> bool:
    """Tell whether points lie too close to the ground for pulses with several returns.

    `height_m` (n,) are heights above the ground in meters, `returns_of_pulse` (n,) how many returns
    the pulse of each point has.
    """
    multiple = np.count_nonzero(returns_of_pulse > 1)
    if len(height_m) < limits.least_points:
        return False
    many = multiple >= limits.multiple_share * len(height_m)
    return bool(many and np.quantile(height_m, 0.99) < limits.flat_m)


def median_slope(xyz_m: NDArray, height_m: NDArray, limits: UnitDoubts = UnitDoubts()) -> float:
    """Return the median slope between mean heights of the terrain in neighboring cells.

    0 where too few cells are neighbors. `xyz_m` (n, 3) and `height_m` (n,), above the terrain, are
    in meters.
    """
    sample = slice(None, None, 1 + len(xyz_m) // limits.most_points)
    cells, lines = compact_keys(xyz_m[sample, :2], limits.cell_m)
    cells, inverse = np.unique(cells, return_inverse=True)
    terrain = np.bincount(inverse, xyz_m[sample, 2] - height_m[sample]) / np.bincount(inverse)
    east, has_east = places_among(cells, cells + 1)
    north, has_north = places_among(cells, cells + lines[-1])
    slopes = np.hypot(terrain[east] - terrain, terrain[north] - terrain) / limits.cell_m
    slopes = slopes[has_east & has_north]
    return float(np.median(slopes)) if len(slopes) >= limits.least_cells else 0.0


def named_unit(name: str, option: str) -> float:
    """Return meters per unit of a unit's name; OptionError for an unknown one."""
    try:
        return NAMED[name.strip().lower()]
    except KeyError:
        cure = f"{suggest(name, NAMED)}Known units: {', '.join(NAMED)}"
        what = f"'{option}' is not a known length unit"
        raise OptionError(what, found=repr(name), cure=cure) from None


def units_of_wkt(
    wkt: str, *, horizontal: str = "", vertical: str = "", place: tuple[float, float] | None = None
) -> Units:
    """Return the length units of a spatial reference in well-known text (WKT 1 or 2).

    Parameters
    ----------
    wkt : str
        Empty where the cloud has no spatial reference: meters are assumed.
    horizontal, vertical : str
        Unit names that overrule the spatial reference. Where it has no vertical part,
        heights are taken to be in the horizontal unit, as LAS files in feet are.
    place : tuple of float, optional
        An x and y among the points: of degrees, their UTM zone is then named.

    Raises
    ------
    StageError
        If x and y are degrees.
    """
    across: float | None = named_unit(horizontal, "horizontal_unit") if horizontal else None
    upward: float | None = named_unit(vertical, "vertical_unit") if vertical else None
    root = parse_wkt(wkt) if wkt.strip() else None
    if root is not None:
        projected = root.find("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS")
        if projected is None:
            _refuse_globe(root, wkt, place)
        if across is None and projected is not None:
            across = projected.unit()
        height = root.find("VERT_CS", "VERTCRS", "VERTICALCRS")
        if upward is None and height is not None:
            upward = height.unit()
    assumed = across is None and root is None
    across = 1.0 if across is None else across
    for meters in (across, upward):
        if meters is not None and not _SMALLEST <= meters <= _LARGEST:
            what = "the spatial reference has an implausible unit of length"
            cure = "Set horizontal_unit and vertical_unit"
            raise StageError(what, found=f"{meters:g} m", cure=cure)
    return Units(across, across if upward is None else upward, assumed)


#: Of latitude on the average, and of longitude at the equator.
METERS_PER_DEGREE = 111_320.0


def is_geographic(wkt: str) -> bool:
    """Return whether x and y of a spatial reference (WKT) are degrees."""
    root = parse_wkt(wkt) if wkt.strip() else None
    if root is None or root.find("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS"):
        return False
    geodetic = root.find(*_GEODETIC)
    return geodetic is not None and not _is_geocentric(geodetic)


#: Keywords of references on the globe. WKT 2 has one for degrees and for geocentric coordinates.
_GEODETIC = ("GEOCCS", "GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "GEODCRS", "GEODETICCRS")


def _is_geocentric(geodetic: WktNode) -> bool:
    """Return whether coordinates on the globe are meters from the earth's center."""
    system = geodetic.find("CS")
    cartesian = system is not None and system.name.lower() == "cartesian"
    return geodetic.keyword == "GEOCCS" or cartesian


def _refuse_globe(root: WktNode, wkt: str, place: tuple[float, float] | None) -> None:
    """Refuse a reference without a projected plane: degrees, or meters from the earth's center."""
    geodetic = root.find(*_GEODETIC)
    if geodetic is None:
        return
    centered = _is_geocentric(geodetic)
    code = f"EPSG:{(place and not centered and utm_code(*place)) or 'CODE'}"
    raise StageError(
        "the coordinates are geocentric (from the earth's center); heights need a vertical axis"
        if centered
        else "the coordinates are geographic (degrees); neighborhoods and grids need meters",
        found=root.name or wkt[:60],
        cure="Add a reprojection before this stage, "
        f'{{"type": "filters.reprojection", "out_srs": "{code}"}}, or '
        "reproject the files first, pdal translate IN OUT reprojection "
        f"--filters.reprojection.out_srs={code} (a UTM zone, or the national grid of the area)",
    )


def refuse_likely_degrees(count: int, x0: float, y0: float, x1: float, y1: float) -> None:
    """Refuse a thousand points or more without a reference whose extent looks like degrees.

    As degrees 0.2 are 22 km, wider than a file; as meters they are too few for so many points.
    """
    on_globe = max(-x0, x1) <= 180.0 and max(-y0, y1) <= 90.0
    if count >= 1000 and on_globe and max(x1 - x0, y1 - y0) < 0.2:
        code = utm_code(x0, y0) or "CODE"
        raise StageError(
            "the coordinates look like degrees, and there is no spatial reference that says "
            "otherwise",
            found=f"x {x0:.6f} to {x1:.6f}, y {y0:.6f} to {y1:.6f}",
            cure="Reproject the files first: pdal translate IN OUT reprojection "
            "--filters.reprojection.in_srs=EPSG:4326 "
            f"--filters.reprojection.out_srs=EPSG:{code}; if they are meters, set horizontal_unit",
        )


def utm_code(longitude: float, latitude: float) -> int | None:
    """Return the EPSG code of the UTM zone (WGS 84) of a place in degrees; None without a zone."""
    if not (-180.0 <= longitude <= 180.0 and -80.0 <= latitude <= 84.0):
        return None
    return (32600 if latitude >= 0 else 32700) + min(60, int((longitude + 180.0) // 6.0) + 1)


@dataclass
class WktNode:
    """One bracketed element of well-known text."""

    keyword: str
    values: list[str]
    children: list[WktNode]

    @property
    def name(self) -> str:
        """Name of the element; empty without one."""
        return self.values[0] if self.values else ""

    def find(self, *keywords: str) -> WktNode | None:
        """Return the first element, this one included, with one of the keywords."""
        if self.keyword in keywords:
            return self
        return next((hit for child in self.children if (hit := child.find(*keywords))), None)

    def unit(self) -> float | None:
        """Return meters per unit of this coordinate system; None without a unit.

        WKT 2 may put the unit on an axis.
        """
        for child in self.children:
            if child.keyword in ("LENGTHUNIT", "UNIT"):
                try:
                    value = float(child.values[1])
                except (IndexError, ValueError):
                    return None
                return value if value > 0 else None
        units = (child.unit() for child in self.children if child.keyword in ("AXIS", "CS"))
        return next((unit for unit in units if unit is not None), None)

    def code(self) -> str:
        """Return the authority's code of this element, as ``EPSG:25832``; empty without one."""
        named = (c.values[:2] for c in self.children if c.keyword in ("AUTHORITY", "ID"))
        codes = [values for values in named if len(values) == 2]
        return ":".join(codes[-1]) if codes else ""


#: Keywords of reference systems, in WKT 1 and 2.
SYSTEMS = frozenset(
    (
        *("PROJCS", "PROJCRS", "PROJECTEDCRS", "COMPD_CS", "COMPOUNDCRS", "BOUNDCRS", "LOCAL_CS"),
        *("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "GEODCRS", "GEODETICCRS", "GEOCCS"),
        *("ENGCRS", "ENGINEERINGCRS", "DERIVEDPROJCRS", "VERT_CS", "VERTCRS", "VERTICALCRS"),
    )
)
#: Deeper text is not well-known text.
_DEEPEST = 100
_TOKEN = re.compile(r'\s*(?:"((?:[^"]|"")*)"|([\w.+-]+)|([\[(])|([\])])|,)')


def parse_wkt(text: str) -> WktNode | None:
    """Parse well-known text into its elements; None where it is not WKT."""
    stack = [WktNode("", [], [])]
    position = 0
    while len(stack) <= _DEEPEST and (match := _TOKEN.match(text, position)):
        position = match.end()
        quoted, bare, opens, closes = match.groups()
        if quoted is not None or bare:
            stack[-1].values.append(bare or quoted)
        elif opens:
            values = stack[-1].values
            stack[-1].children.append(WktNode(values.pop().upper() if values else "", [], []))
            stack.append(stack[-1].children[-1])
        elif closes and len(stack) > 1:
            stack.pop()
    return stack[0].children[0] if stack[0].children else None


def name_of_wkt(wkt: str) -> str:
    """Return the name of a spatial reference in well-known text, with its authority's code."""
    root = parse_wkt(wkt)
    if root is None:
        return ""
    return f"{root.name} ({code})" if (code := root.code()) else root.name
