"""The command ``corrections``: points whose class a person changed or confirmed, marked as checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import LEGACY_LIMIT
from ..base.errors import OptionError, StageError
from ..base.files import Output, check_outputs, whole_files
from ..base.grid import places_among
from ..base.las import named_copc
from ..base.polygons import Overlay, points_inside, polygons_of
from ..base.vector import reading, vector
from ..classifier.input_dimensions import CHECKED
from ..pipeline.las_chunks import can_read_chunks, laspy_header, read_chunks
from ..pipeline.las_output import finish
from ..pipeline.spatial_reference import reference_of_file

#: If more than this share of the points has no partner, the files hold different points.
_MOST_LOST = 0.1
#: The layer of ``review``, and its column for patches that were checked.
_PATCHES, _DONE = "patches", "done"


def write_corrections(
    before: str, output: str, after: str = "", areas: Sequence[str] = (), around: float = 1.0
) -> list[str]:
    """Mark what was checked, and write the points of `before` with the classes of `after`; returns messages.

    The Reliability of checked points becomes 1. Everything else stays as in `before`, whatever the editing program dropped.

    `after` is a file of the same points after editing, empty for none. `areas` are files of polygons in which everything was
    checked, so what was not changed is right; the same holds within `around` meters of a changed point.
    """
    import laspy

    checks.number("'--around'", around, 0, 100, unit="m")
    if not after and not areas:
        raise OptionError(
            "there is nothing to mark: neither corrected points nor a checked area",
            cure="Give the corrected file as the second argument, or --area patches.gpkg",
        )
    for name in filter(None, (before, after)):
        if not can_read_chunks(name):
            raise StageError("corrections are read from LAS and LAZ files", found=name)
    if named_copc(output):
        raise OptionError(
            "corrections are written as LAS or LAZ", found=output, cure="Name it .laz"
        )
    check_outputs([Output(output, "output")], [*filter(None, (before, after)), *areas])
    reference = reference_of_file(before)
    units = reference.units
    las = _read(before)
    xyz = np.column_stack([las.x, las.y, las.z])
    codes = np.asarray(las.classification).astype(np.uint8)
    notes: list[str] = []
    new = _codes_of(before, after, las, xyz, codes, notes) if after else codes
    changed = new != codes
    checked = near_any(xyz * [units.horizontal, units.horizontal, units.vertical], changed, around)
    for area in areas:
        checked |= _inside(area, xyz, reference.wkt, notes)
    if CHECKED in las.point_format.extra_dimension_names:
        checked |= np.asarray(las[CHECKED]) > 0
    elif CHECKED in las.point_format.dimension_names:
        raise StageError(f"'{CHECKED}' is a dimension of another kind", where=before)
    if not checked.any():
        raise StageError(
            "nothing was changed, and no point lies in a checked area",
            found=", ".join(filter(None, (after, *areas))),
        )
    if las.header.point_format.id < 6 and new.max() > LEGACY_LIMIT:
        raise StageError(
            f"classes above {LEGACY_LIMIT} do not fit the file, which is of LAS 1.0-1.3",
            where=before,
            found=f"class {int(new.max())}",
            cure="Convert it to LAS 1.4 first (minor_version 4, dataformat_id 6)",
        )
    if CHECKED not in las.point_format.extra_dimension_names:
        las.add_extra_dim(laspy.ExtraBytesParams(CHECKED, "uint8", "1: a person has checked it"))
    las.classification, las[CHECKED] = new, checked.astype(np.uint8)
    if (
        "Reliability" in las.point_format.extra_dimension_names
    ):  # of another class, or of less than a person
        las["Reliability"] = np.where(checked, 1.0, las["Reliability"])
    with whole_files(output) as (part,):
        las.write(str(part))
        finish(part, [before])
    lines = [
        f"{len(codes):,} points, {changed.sum():,} changed, {checked.sum():,} checked ({100 * checked.mean():.2f} %)"
    ]
    moves = Counter(zip(codes[changed].tolist(), new[changed].tolist(), strict=True))
    lines += [f"  {one} became {other}{n:>14,}" for (one, other), n in moves.most_common()]
    return [*lines, *notes]


def _read(path: str) -> Any:
    """A whole file as laspy holds it; a COPC file as plain LAZ."""
    import laspy

    header = laspy_header(path)
    out = laspy.LasData(header)
    if points := [one.array for one in read_chunks(path)]:
        joined = np.concatenate(points)
        out.points = laspy.ScaleAwarePointRecord(
            joined, header.point_format, header.scales, header.offsets
        )
    return out


def _codes_of(
    before: str,
    after: str,
    las: Any,
    xyz: NDArray[np.float64],
    codes: NDArray[np.uint8],
    notes: list[str],
) -> NDArray[np.uint8]:
    """The classes of the same points in another file; their own where they are missing there."""
    other = _read(after)
    theirs = np.column_stack([other.x, other.y, other.z])
    step = float(max(*las.header.scales, *other.header.scales))
    both = {*las.point_format.dimension_names} & {*other.point_format.dimension_names}
    named = [
        n for n in ("gps_time", "return_number", "number_of_returns", "classification") if n in both
    ]
    more = [(np.asarray(las[n]), np.asarray(other[n])) for n in named]
    found = partners(xyz, theirs, step, more, apart=3.0 * step)
    lost, extra = int((found < 0).sum()), len(theirs) - int((found >= 0).sum())
    if lost > _MOST_LOST * len(xyz) or extra > _MOST_LOST * len(xyz):
        raise StageError(
            "the two files do not hold the same points",
            found=f"{lost:,} of {len(xyz):,} points of {before} are not in {after}, and "
            f"{extra:,} of its {len(theirs):,} not in the former",
            cure="Save all points from the program they were corrected in, in the same reference system",
        )
    if lost:
        notes.append(f"{lost:,} points are missing in {after}: they keep their class, unchecked")
    if extra:
        notes.append(f"{extra:,} points of {after} are not in {before}: left out")
    return np.where(found >= 0, np.asarray(other.classification).astype(np.uint8)[found], codes)


def _inside(area: str, xyz: NDArray[np.float64], wkt: str, notes: list[str]) -> NDArray[np.bool_]:
    """Which points lie in the polygons of a file; for patches of ``review``, only in those marked as checked."""
    file, _, layer = area.partition("|layername=")
    pyogrio = vector("pyogrio")
    with reading(file) as name:
        if not layer and _PATCHES in [str(one) for one, _ in pyogrio.list_layers(name)]:
            layer = _PATCHES
        fields = pyogrio.read_info(name, layer=layer or None)["fields"]
    done = f"{_DONE} = 1" if _DONE in fields else ""
    x, y = xyz[:, 0], xyz[:, 1]
    box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
    shapes, note = polygons_of(Overlay(file, layer, 0, ()), wkt, box, where=done)
    if done and not shapes:
        raise StageError(
            "no patch is marked as checked",
            where=area,
            cure=f"Set '{_DONE}' to 1 where all errors were corrected, e.g. in the attribute table of QGIS",
        )
    if not shapes:
        raise StageError(
            "no polygon of the area overlaps the points",
            where=area,
            found=note or "none within the bounding box of the points",
            cure="Check its reference system; GeoJSON without one is in degrees",
        )
    inside = points_inside(x, y, shapes)
    told = f"{inside.sum():,} points lie in the checked polygons of {file}"
    notes += [*filter(None, [note]), told]
    return inside


def partners(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    step: float,
    more: Sequence[tuple[NDArray, NDArray]] = (),
    apart: float = 0.0,
) -> NDArray[np.int64]:
    """For each point of `before` its index in `after`, -1 where there is none; each of `after` is used once.

    Coordinates, (n, 3) and (m, 3), are multiples of `step`, the coarser of both files'. Pairs of arrays, `more`, distinguish
    points at the same coordinates: times, return numbers, then classes; where these no longer agree, only the pairing
    changes. Points without a partner at their coordinates take the nearest unused one within `apart`.
    """
    from scipy.spatial import cKDTree

    out, n, m = np.full(len(before), -1, np.int64), len(before), len(after)
    if not n or not m:
        return out
    low = np.minimum(before.min(axis=0), after.min(axis=0))
    places = np.rint((np.concatenate([before, after]) - low) / step).astype(np.int64)
    _, name = np.unique(places, axis=0, return_inverse=True)
    orders, keys = [], []
    for side, named in enumerate(np.split(name.reshape(-1), [n])):
        orders.append(np.lexsort((*(pair[side] for pair in reversed(more)), named)))
        ordered = named[orders[-1]]
        # The first of a place is paired with the first of the same place, and so on.
        keys.append(
            ordered * max(n, m) + np.arange(len(ordered)) - np.searchsorted(ordered, ordered)
        )
    at, there = places_among(keys[1], keys[0])
    out[orders[0][there]] = orders[1][at[there]]
    left = np.ones(m, bool)
    left[out[out >= 0]] = False
    lost, free = np.flatnonzero(out < 0), np.flatnonzero(left)
    if apart > 0 and len(lost) and len(free):
        far, near = cKDTree(after[free]).query(before[lost], distance_upper_bound=apart)
        good = np.flatnonzero(np.isfinite(far))
        good = good[np.argsort(far[good], kind="stable")]
        _, first = np.unique(near[good], return_index=True)  # of several the nearest
        out[lost[good[first]]] = free[near[good[first]]]
    return out


def near_any(
    xyz: NDArray[np.float64], chosen: NDArray[np.bool_], within: float
) -> NDArray[np.bool_]:
    """(n,) whether each point lies `within` so many meters of a chosen one."""
    from scipy.spatial import cKDTree

    if within <= 0 or not chosen.any():
        return chosen.copy()
    far, _ = cKDTree(xyz[chosen]).query(xyz, distance_upper_bound=np.nextafter(within, np.inf))
    return np.isfinite(far)
