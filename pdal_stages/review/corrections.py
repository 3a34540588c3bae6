"""Mark points whose class a person changed or confirmed as checked, in the dimension Checked."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base import checks
from ..base.errors import OptionError, StageError
from ..base.files import Output, check_outputs, whole_files
from ..base.grid import places_among
from ..base.las import named_copc
from ..base.las_check import check_complete
from ..base.las_points import LasColumns, Layout
from ..base.vector import Overlay, points_inside, polygons_of, reading, vector
from ..classifier.input_dimensions import CHECKED
from ..pipeline.accuracy_files import paired
from ..pipeline.copies import copy_of, write_copy
from ..pipeline.inputs_outputs import input_files, is_folder, outputs_of
from ..pipeline.point_files import can_read_chunks
from ..pipeline.spatial_reference import reference_of_file
from ..stages.points import Points

#: Share of points without a partner beyond which two files hold different points: large enough for
#: points that a person deleted, small enough to notice another file; not tuned.
MAX_LOST_SHARE = 0.1
#: Farthest that editing moves a point, in steps of each axis' coarser scale, which rounds; not
#: tuned.
MAX_STEPS = 3.0
#: Layer of a review that holds patches.
PATCHES = "patches"
#: Column of that layer, 1 for checked patches.
DONE = "done"
#: Dimensions that distinguish points at the same coordinates, in this order.
_DISTINGUISHING = ("GpsTime", "ReturnNumber", "NumberOfReturns", "Classification")


class _NothingCheckedError(StageError):
    """No point of a file was changed, or lies where everything was checked."""


@dataclass(frozen=True)
class _Pair:
    """A file before and after editing, and the file to write."""

    before: str
    after: str  #: empty where nothing was edited
    output: str


def write_corrections(
    before: str, output: str, after: str = "", areas: Sequence[str] = (), radius: float = 1.0
) -> list[str]:
    """Write the points of files with corrected classes, and mark those that were checked.

    The Reliability of checked points becomes 1. Everything else stays as in `before`, whatever the
    editing program dropped.

    Parameters
    ----------
    before : str
        LAS or LAZ file before editing; or a folder or pattern of such files, of which those are
        written in which anything was checked, all or none.
    output : str
        LAS or LAZ file to write; of several files a folder, or a name with ``#`` for theirs.
    after : str
        The same points after editing, in any order: a file, or a folder or pattern of files with
        the names of those before, or parts of them; empty for none.
    areas : sequence of str
        Files of polygons in which everything was checked, so unchanged classes are right.
    radius : float
        Distance from changed points within which the same holds, meters.

    Returns
    -------
    list of str
        Counts and warnings.
    """
    checks.number("'--around'", radius, 0, 100, unit="m")
    if not after and not areas:
        raise OptionError(
            "there is nothing to mark: neither corrected points nor a checked area",
            cure="Give the corrected file as the second argument, or --area patches.gpkg",
        )
    pairs = _pairs(before, after, output)
    _refuse_files(pairs, areas)
    lines: list[str] = []
    untouched: list[StageError] = []
    missed: dict[str, list[StageError]] = {area: [] for area in areas}
    with ExitStack() as outputs:  # all get their names, or none
        for pair in pairs:
            try:
                result = _correct(pair, missed, radius, outputs)
            except _NothingCheckedError as error:
                untouched.append(error)
                continue
            lines += [f"{pair.before}:"] * (len(pairs) > 1) + result
        for errors in (*missed.values(), untouched):
            if len(errors) == len(pairs):
                raise errors[0]
    if untouched:
        lines.append(
            f"{len(untouched):,} of {len(pairs):,} files were not written: in them nothing "
            "was changed or checked"
        )
    return lines


def _pairs(before: str, after: str, output: str) -> list[_Pair]:
    """Return the files before and after editing, and those to write."""
    files = input_files([before])
    edited = input_files([after]) if after else []
    if len(files) == 1 and not Path(before).is_dir() and not is_folder(output):
        if len(edited) > 1:
            raise StageError(
                "several files are the corrections of one", found=", ".join(edited[:3])
            )
        return [_Pair(files[0], edited[0] if edited else "", output)]
    if is_folder(output):
        os.makedirs(output, exist_ok=True)
        output = os.path.join(output, "#")
    outputs = outputs_of(files, output)
    try:
        partners = {path: other for other, path in paired(edited, files)} if edited else {}
    except StageError as error:
        what = "each corrected file needs one before editing, of which its name tells"
        raise StageError(what, found=error.found, cure=error.cure) from None
    return [
        _Pair(file, partners.get(file, ""), name) for file, name in zip(files, outputs, strict=True)
    ]


def _correct(
    pair: _Pair, missed: dict[str, list[StageError]], radius: float, outputs: ExitStack
) -> list[str]:
    """Write a file, which gets its name when `outputs` are closed; return counts and warnings.

    `missed` has the areas, and of each why files have no point in it.
    """
    before = pair.before
    reference = reference_of_file(before)
    layout = Layout.of_file(before)
    las = LasColumns([(layout, before)])
    xyz = np.column_stack([las[axis] for axis in "XYZ"])
    codes = las["Classification"]
    warnings: list[str] = []
    new = _edited_codes(before, pair.after, las, xyz, codes, warnings) if pair.after else codes
    changed = new != codes
    units = reference.units
    meters = xyz * [units.horizontal, units.horizontal, units.vertical]
    checked = is_near(meters, changed, radius)
    for area, errors in missed.items() if len(xyz) else ():
        try:
            checked |= _in_area(area, xyz, reference.wkt, warnings)
        except _NothingCheckedError as error:
            errors.append(error)
    if CHECKED in las:
        checked |= las[CHECKED] > 0
    if not checked.any():
        raise _NothingCheckedError(
            "nothing was changed, and no point lies in a checked area",
            found=", ".join(filter(None, (pair.after, *missed))),
        )
    _write(layout, las, pair, new, checked, outputs)
    return [*_describe(codes, new, checked), *warnings]


def _describe(codes: NDArray, new: NDArray, checked: NDArray) -> list[str]:
    """Return counts of changed and checked points as lines of text."""
    changed, percent = new != codes, f"{100 * checked.mean():.2f} %"
    counts = f"{len(codes):,} points, {changed.sum():,} changed, {checked.sum():,} checked"
    moves = Counter(zip(codes[changed].tolist(), new[changed].tolist(), strict=True))
    lines = [f"  {old} became {code}{n:>14,}" for (old, code), n in moves.most_common()]
    return [f"{counts} ({percent})", *lines]


def _refuse_files(pairs: Sequence[_Pair], areas: Sequence[str]) -> None:
    """Refuse inputs that cannot be read in parts, and outputs that cannot be written."""
    inputs = [name for pair in pairs for name in (pair.before, pair.after) if name]
    for name in inputs:
        if not can_read_chunks(name):
            raise StageError("corrections are read from LAS and LAZ files", found=name)
    for pair in pairs:
        if named_copc(pair.output):
            what = "corrections are written as LAS or LAZ"
            raise OptionError(what, found=pair.output, cure="Name it .laz")
    check_outputs([Output(pair.output, "output") for pair in pairs], [*inputs, *areas])


def _write(
    layout: Layout,
    las: LasColumns,
    pair: _Pair,
    codes: NDArray[np.uint8],
    checked: NDArray[np.bool_],
    outputs: ExitStack,
) -> None:
    """Write a copy of a file with classes, Checked and Reliability of its points.

    It gets its name when `outputs` are closed.
    """
    values = {"Classification": codes, CHECKED: checked.astype(np.uint8)}
    kinds = {CHECKED: "uint8_t"}
    if "Reliability" in layout.extra_by_name:
        arrays = {"X": las["X"], "Reliability": las["Reliability"]}
        try:  # of per cent, 1 would be next to nothing
            Points(arrays).reliability  # noqa: B018
        except StageError as error:
            raise error.at(pair.before) from None
        values["Reliability"] = np.where(checked, 1.0, arrays["Reliability"])
        kinds["Reliability"] = "float"
    copy = copy_of(pair.before, layout, pair.output, kinds, {})

    def check(partial: Path, final: Path, number: int) -> None:
        check_complete(partial, final, {"type": "writers.las"}, copy.count)

    (part,) = outputs.enter_context(whole_files(pair.output, check=check))
    write_copy(copy, part, values)


def _edited_codes(
    before: str,
    after: str,
    las: LasColumns,
    xyz: NDArray[np.float64],
    codes: NDArray[np.uint8],
    warnings: list[str],
) -> NDArray[np.uint8]:
    """Return the classes of the same points in another file; their former ones where missing."""
    other = LasColumns([(Layout.of_file(after), after)])
    theirs = np.column_stack([other[axis] for axis in "XYZ"])
    steps = np.max([each.parts[0][0].header.scales for each in (las, other)], axis=0)
    names = [name for name in _DISTINGUISHING if name in las and name in other]
    pairs = [(las[name], other[name]) for name in names]
    index = match_points(xyz, theirs, steps, pairs, max_steps=MAX_STEPS)
    lost, extra = int((index < 0).sum()), len(theirs) - int((index >= 0).sum())
    if max(lost, extra) > MAX_LOST_SHARE * len(xyz):
        raise StageError(
            "the two files do not hold the same points",
            found=f"{lost:,} of {len(xyz):,} points of {before} are not in {after}, and "
            f"{extra:,} of its {len(theirs):,} not in the former",
            cure="Save all points from the editing program, in the same reference system",
        )
    if lost:
        warnings.append(f"{lost:,} points are missing in {after}: they keep their class, unchecked")
    if extra:
        warnings.append(f"{extra:,} points of {after} are not in {before}: left out")
    return np.where(index >= 0, other["Classification"][index], codes)


def _in_area(
    area: str, xyz: NDArray[np.float64], wkt: str, warnings: list[str]
) -> NDArray[np.bool_]:
    """Return which points lie in polygons of a file.

    Where polygons have a column `DONE`, as a review's patches do, those with a 1 count.
    """
    file, _, layer = area.partition("|layername=")
    pyogrio = vector("pyogrio")
    with reading(file) as name:
        if not layer and PATCHES in [str(listed) for listed, _ in pyogrio.list_layers(name)]:
            layer = PATCHES
        fields = pyogrio.read_info(name, layer=layer or None)["fields"]
    condition = f"{DONE} = 1" if DONE in fields else ""
    x, y = xyz[:, 0], xyz[:, 1]
    box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
    shapes, note = polygons_of(Overlay(file, layer, 0, ()), wkt, box, where=condition)
    if condition and not shapes:
        raise _NothingCheckedError(
            "no patch is marked as checked",
            where=area,
            cure=f"Set '{DONE}' to 1 where all errors were corrected, e.g. in QGIS",
        )
    if not shapes:
        raise _NothingCheckedError(
            "no polygon of the area overlaps the points",
            where=area,
            found=note or "none within the bounding box of the points",
            cure="Check its reference system; GeoJSON without one is in degrees",
        )
    inside = points_inside(x, y, shapes)
    count = f"{inside.sum():,} points lie in the checked polygons of {file}"
    warnings += [*filter(None, [note]), count]
    return inside


def match_points(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    steps: NDArray[np.float64],
    pairs: Sequence[tuple[NDArray, NDArray]] = (),
    max_steps: float = 0.0,
) -> NDArray[np.int64]:
    """Return the index in `after` of each point of `before`, -1 for none; each is used once.

    Parameters
    ----------
    before, after : (n, 3), (m, 3) float64
        Coordinates.
    steps : (3,) float64
        The coarser of both files' steps of coordinates, of each axis.
    pairs : sequence of pairs of (n,) and (m,) arrays
        Values that distinguish points at the same coordinates; where they differ between the
        files, only the pairing changes.
    max_steps : float
        Points without a partner at their coordinates take the nearest unused one within so many
        steps.
    """
    out, n, m = np.full(len(before), -1, np.int64), len(before), len(after)
    if not n or not m:
        return out
    low = np.minimum(before.min(axis=0), after.min(axis=0))
    cells = np.rint((np.concatenate([before, after]) - low) / steps).astype(np.int64)
    _, place = np.unique(cells, axis=0, return_inverse=True)
    orders, keys = [], []
    for side, places in enumerate(np.split(place.reshape(-1), [n])):
        orders.append(np.lexsort((*(pair[side] for pair in reversed(pairs)), places)))
        ordered = places[orders[-1]]
        # The first point of a place is paired with the first of the same place, and so on.
        rank = np.arange(len(ordered)) - np.searchsorted(ordered, ordered)
        keys.append(ordered * max(n, m) + rank)
    at, exists = places_among(keys[1], keys[0])
    out[orders[0][exists]] = orders[1][at[exists]]
    unused = np.ones(m, bool)
    unused[out[out >= 0]] = False
    lost, free = np.flatnonzero(out < 0), np.flatnonzero(unused)
    if max_steps > 0 and len(lost) and len(free):
        tree = scipy.spatial.cKDTree((after[free] - low) / steps)
        distance, near = tree.query((before[lost] - low) / steps, distance_upper_bound=max_steps)
        good = np.flatnonzero(np.isfinite(distance))
        good = good[np.argsort(distance[good], kind="stable")]
        _, first = np.unique(near[good], return_index=True)  # of several the nearest
        out[lost[good[first]]] = free[near[good[first]]]
    return out


def is_near(
    xyz: NDArray[np.float64], chosen: NDArray[np.bool_], distance: float
) -> NDArray[np.bool_]:
    """Return whether each point (n,) lies within a distance of a chosen one."""
    if distance <= 0 or not chosen.any():
        return chosen.copy()
    limit = np.nextafter(distance, np.inf)
    nearest, _ = scipy.spatial.cKDTree(xyz[chosen]).query(xyz, distance_upper_bound=limit)
    return np.isfinite(nearest)
