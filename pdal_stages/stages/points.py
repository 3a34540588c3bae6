"""The points a stage works on: PDAL's arrays, in meters, with class codes freed of flag bits."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT, OVERLAP
from ..base.dimensions import is_height
from ..base.errors import DimensionError, OptionError, StageError
from ..base.messages import Count, Message, Report, Topic, shorten
from ..base.units import Units, refuse_likely_degrees, units_of_wkt
from .options import Selection
from .where_expression import Expression

#: Which stage makes a dimension that a user may lack.
MAKERS = {
    "HeightAboveGround": (
        'Add {"type": "filters.hag_morphological"} before this stage, or the stage that the model '
        "was trained with"
    ),
    "Reference": 'Keep the labels before classifying: {"type": "filters.ferry", "dimensions": '
    '"Classification=>Reference"}',
    "Ground": 'Add {"type": "filters.hag_morphological", "ground": true} before this stage',
}
#: How names of dimensions begin that runs use for themselves.
RESERVED = "PdalStages"
#: The dimension in which `classify` marks the points that its `where` selects.
SELECTED = "PdalStagesSelected"
#: Steps to which coordinates are rounded; scales of LAS files are whole numbers of them, as a rule.
_STEPS_PER_UNIT = 1e6
#: Dimensions that points of LAS files have.
LAS_DIMENSIONS = (
    *("X", "Y", "Z", "Intensity", "ReturnNumber", "NumberOfReturns", "ScanDirectionFlag"),
    *("EdgeOfFlightLine", "Classification", "ClassFlags", "Synthetic", "KeyPoint", "Withheld"),
    *("Overlap", "ScanAngleRank", "ScanChannel", "UserData", "PointSourceId", "GpsTime"),
    *("Red", "Green", "Blue", "Infrared"),
)
#: Flags of a point, in the order of their bits.
_FLAGS = ("Synthetic", "KeyPoint", "Withheld", "Overlap")
#: How far rounding may take a share beyond 0 or 1.
_SHARE_ROUNDING = 1e-5


def warning_of_no_match(where: str) -> Message:
    """Return the warning that a condition holds for no point."""
    return Message(f"'where' matches no points: {shorten(where)}", Topic.NOTHING_MATCHES)


class CodeLimit(NamedTuple):
    """Why class codes above :data:`..base.asprs.LEGACY_LIMIT` do not fit."""

    problem: str
    cure: str


@dataclass(eq=False)
class Points:
    """One view of points, as a stage sees it."""

    arrays: Mapping[str, NDArray]  #: PDAL's dimensions, one value per point
    wkt: str = ""  #: the spatial reference, empty where there is none
    where: Expression | None = None  #: points the stage acts on
    #: Names of the horizontal and the vertical unit; empty where the spatial reference says it.
    unit_names: tuple[str, str] = ("", "")
    #: Whether the three flag bits of LAS 1.0-1.3 sit inside `Classification`.
    legacy_flags: bool = False
    #: Whether class 12 (overlap) of LAS 1.0-1.3 may be read as class 0 with the flag Overlap, as
    #: PDAL from 2.6 on does.
    overlap_as_flag: bool = False
    #: In tiles: how many meters each point lies outside the tile; negative for points inside, which
    #: alone are counted (:meth:`tally`).
    meters_outside: NDArray | None = None
    #: In tiles: the points whose results are used.
    used: NDArray[np.bool_] | None = None
    code_limit: CodeLimit | None = None  #: as in :class:`.base.StageContext`

    def __post_init__(self) -> None:
        """Evaluate `where`."""
        self._source = self.arrays
        self.count = len(self.arrays["X"]) if "X" in self.arrays else 0
        self.report = Report({"points": self.count})
        self.mask = self.used
        if self.where is not None:
            codes = {"Classification": self.class_codes} if self.legacy_flags else {}
            flags = self._flags_of(self.where)
            self.mask = self.where.evaluate(ChainMap(codes, flags, cast(dict, self.arrays)))
            if self.used is not None:
                self.mask &= self.used
            self.report.figures["where"] = int(np.count_nonzero(self.mask))
            # Where `classify` marked no point, the stage that marks them has said so.
            if self.count and not self.report.figures["where"] and SELECTED not in self.where.text:
                self.report.warnings.append(warning_of_no_match(self.where.text))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Return which points (n,) lie inside `where`; all without one."""
        return np.ones(self.count, bool) if self.mask is None else self.mask

    def tally(self, count: Count, points: NDArray[np.bool_]) -> None:
        """Report the number of these points (n,), in a tile without its surroundings."""
        number = self._number(points)
        self.report.counts[count] = self.report.figures[count.name] = number

    def _number(self, points: NDArray[np.bool_]) -> int:
        """Return the number of these points (n,), in a tile without its surroundings."""
        outside = self.meters_outside
        return int(np.count_nonzero(points if outside is None else points & (outside < 0)))

    @cached_property
    def units(self) -> Units:
        """Return meters per unit; degrees are refused, an assumption is reported."""
        x, y = (self.arrays[axis] for axis in "XY") if self.count else (np.zeros(0), np.zeros(0))
        place = (float(x[0]), float(y[0])) if self.count else None
        units = units_of_wkt(
            self.wkt, horizontal=self.unit_names[0], vertical=self.unit_names[1], place=place
        )
        if units.assumed and self.count:
            text = "the points have no spatial reference: meters were assumed"
            self.report.note(text, Topic.METERS_ASSUMED)
            refuse_likely_degrees(self.count, x.min(), y.min(), x.max(), y.max())
        return units

    @cached_property
    def xyz(self) -> NDArray[np.float64]:
        """Return coordinates in meters, shape (n, 3); errors as of :attr:`axes`."""
        return np.column_stack(self.axes)

    @cached_property
    def axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return coordinates in meters, x, y and z each by itself.

        They are rounded to a millionth of the unit of the file: the same coordinates under another
        scale and offset differ by the rounding of `X * scale + offset`, which puts points on the
        edge of a cell on either side of it.

        Raises
        ------
        StageError
            If any is NaN or infinite, with the count.
        """
        x, y, z = axes = [self._in_meters(name, self._array(name)) for name in "XYZ"]
        if not all(np.isfinite(values).all() for values in axes):
            bad = int(np.count_nonzero(~(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))))
            raise StageError(
                "coordinates are not finite (NaN or infinite)",
                found=f"{bad:,} of {self.count:,} points",
                cure="Drop them first: pdal translate IN OUT range "
                "--filters.range.limits='X[:1e9],Y[:1e9],Z[-1e5:1e5]'; "
                'in a pipeline: {"type": "filters.range", "limits": "X[:1e9],Y[:1e9],Z[-1e5:1e5]"}',
            )
        return x, y, z

    def _in_meters(self, name: str, values: NDArray) -> NDArray[np.float64]:
        """Return values (n,) of an axis in meters, rounded."""
        with np.errstate(over="ignore"):  # such coordinates are refused
            rounded = np.asarray(values) * _STEPS_PER_UNIT
        np.rint(rounded, out=rounded)
        rounded /= _STEPS_PER_UNIT
        unit = self.units.vertical if name == "Z" else self.units.horizontal
        return rounded if unit == 1.0 else rounded * unit

    def coordinates(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the coordinates (m, 3) of some points in meters, also once others are forgotten.

        They are read anew, so that nobody holds those of all points meanwhile.
        """
        axes = [self._in_meters(name, np.asarray(self._source[name])[rows]) for name in "XYZ"]
        return np.column_stack(axes)

    def keep_only(self, names: Iterable[str]) -> None:
        """Forget the other dimensions, which nobody reads any more; keep `xyz`."""
        self.xyz  # noqa: B018  before they are gone
        self.__dict__.pop("axes", None)
        kept, arrays = set(names), self.arrays
        self.arrays = {name: arrays[name] for name in arrays if name in kept}

    def take_xyz(self) -> NDArray[np.float64]:
        """Return :attr:`xyz` and forget it, so that the caller can free its memory."""
        xyz = self.xyz
        del self.__dict__["xyz"]
        self.__dict__.pop("axes", None)
        return xyz

    def missing(self, name: str, hint: str | None = None) -> DimensionError:
        """Return the error on a dimension that the points do not have."""
        return DimensionError(
            f"the dimension '{name}' is missing",
            found=", ".join(self.arrays),
            cure=hint
            or MAKERS.get(name, "Add the stage that makes it, or leave it out of the options"),
        )

    def _array(self, name: str) -> NDArray:
        if name not in self.arrays:
            raise self.missing(name)
        return self.arrays[name]

    def dimension(self, name: str, *, meters: bool = True) -> NDArray:
        """Return the values (n,) of a dimension; heights in the unit of Z are converted to meters.

        Raises
        ------
        DimensionError
            If the points do not have it, naming the stage that makes it.
        """
        if name == "Classification":
            return self.class_codes
        values = self._array(name)
        if meters and is_height(name) and self.units.vertical != 1.0:
            return values * self.units.vertical
        return values

    @cached_property
    def class_codes(self) -> NDArray[np.uint8]:
        """Return `Classification` (n,) without the flag bits of LAS 1.0-1.3."""
        return self.codes_of("Classification")

    def codes_of(self, name: str) -> NDArray[np.uint8]:
        """Return a dimension (n,) that holds class codes, checked and freed of flag bits.

        A copy made by ``filters.ferry`` carries the flag bits along, so they are taken off it too.
        """
        values = np.asarray(self._array(name))
        with np.errstate(invalid="ignore"):
            codes = values.astype(np.uint8)
        if values.dtype != np.uint8 and (wrong := codes != values).any():
            raise DimensionError(
                f"'{name}' must hold class codes (whole numbers of 0 to 255)",
                found=str(values[wrong][0]),
            )
        return codes & np.uint8(LEGACY_LIMIT) if self.legacy_flags else codes

    @cached_property
    def reliability(self) -> NDArray[np.float32] | None:
        """Return `Reliability` (n,), NaN where it is not known; None where there is none.

        Raises
        ------
        DimensionError
            For values that are no share of 1, such as per cent.
        """
        if "Reliability" not in self.arrays:
            return None
        values = np.asarray(self.arrays["Reliability"])
        # Averages of shares may leave 0 to 1 by rounding.
        beyond = (values < -_SHARE_ROUNDING) | (values > 1 + _SHARE_ROUNDING)
        if beyond.any():
            count = f"{np.count_nonzero(beyond):,} of {self.count:,} points"
            raise DimensionError(
                "'Reliability' must be the probability of a point's class, 0 to 1",
                found=f"{np.nanmin(values):g} to {np.nanmax(values):g}; {count} lie beyond",
                cure="Scale it, or leave it out: pdal-stages review computes one where there is "
                "none. Of per cent: pdal translate IN OUT assign "
                "--filters.assign.value='Reliability = Reliability / 100'",
            )
        return np.clip(values, 0, 1).astype(np.float32, copy=False)

    def flag(self, name: str) -> NDArray:
        """Return a flag of each point (n,), 0 or 1; before PDAL 2.6 it is a bit of a dimension."""
        if name in self.arrays:
            return self.arrays[name]
        bit = _FLAGS.index(name)
        if "ClassFlags" in self.arrays:
            return self.arrays["ClassFlags"] >> np.uint8(bit) & 1
        if self.legacy_flags and name != "Overlap":
            return self.arrays["Classification"] >> np.uint8(LEGACY_LIMIT.bit_length() + bit) & 1
        return np.zeros(self.count, np.uint8)

    def _flags_of(self, where: Expression) -> dict[str, NDArray]:
        """Return the flags (n,) that a condition names and old PDAL has no dimension for."""
        held = ("ClassFlags" in self.arrays and _FLAGS) or (self.legacy_flags and _FLAGS[:3]) or ()
        wanted = {name.lower() for name in where.names}
        return {
            name: self.flag(name)
            for name in held
            if name.lower() in wanted and name not in self.arrays
        }

    def chosen(self, selection: Selection) -> NDArray[np.bool_]:
        """Return which points (n,) a selection takes."""
        chosen = np.zeros(self.count, bool)
        if selection.codes and "Classification" in self.arrays:
            chosen |= np.isin(self.class_codes, np.array(selection.codes, np.uint8))
            if OVERLAP in selection.codes and self.overlap_as_flag:
                chosen |= (self.class_codes == 0) & (self.flag("Overlap") != 0)
        for span in selection.spans:
            name = span.dimension
            values = self.flag(name) if name in _FLAGS else self.dimension(name, meters=False)
            chosen |= span.contains(values)
        return chosen

    def ignored(self, selection: Selection) -> NDArray[np.bool_]:
        """Return which points (n,) a selection takes; report how many lie inside `where`."""
        chosen = self.chosen(selection)
        inside = chosen if self.mask is None else chosen & self.mask
        self.report.figures["ignored"] = self._number(inside)
        return chosen

    def usable(self, ignored: Selection) -> NDArray[np.bool_]:
        """Return which points (n,) inside `where` are not ignored; report how many are."""
        return self.inside & ~self.ignored(ignored)

    def changeable(self, ignored: Selection, kept: Selection) -> NDArray[np.bool_]:
        """Return which points (n,) may get another class; report how many are ignored."""
        return self.usable(ignored) & ~self.chosen(kept)

    def wanting(self, name: str, created_before: bool) -> NDArray[np.bool_]:
        """Return which points (n,) get a height: inside `where`, or without one (0)."""
        return self.inside if created_before else self.inside | (self.arrays[name] == 0)

    def with_codes(self, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return class codes (n,) with each point's flag bits, and count codes in the report."""
        self.report.codes = class_counts(codes)
        limit = self.code_limit
        flags: np.uint8 | NDArray[np.uint8] = np.uint8(0)
        if self.legacy_flags:
            flags = np.asarray(self.arrays["Classification"], np.uint8) & ~np.uint8(LEGACY_LIMIT)
            if flags.any():
                limit = limit or CodeLimit(
                    f"class codes above {LEGACY_LIMIT} do not fit: the points were read from LAS "
                    "1.0-1.3, and some have the synthetic, key-point or withheld flag in the byte "
                    "of the class",
                    "Convert the input to LAS 1.4 first (minor_version 4, dataformat_id 6)",
                )
        if limit and (largest := codes.max(initial=0)) > LEGACY_LIMIT:
            raise OptionError(limit.problem, found=f"code {largest}", cure=limit.cure)
        return codes | flags


def class_counts(codes: NDArray[np.uint8]) -> dict[str, int]:
    """Return the number of points by class code, as metadata has it; no code with 0."""
    return {str(code): n for code, n in enumerate(np.bincount(codes).tolist()) if n}
