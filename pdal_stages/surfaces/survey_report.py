"""The report by which a survey is accepted: density, voids, strips, control points, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base import checks
from ..base.errors import StageError
from ..base.files import HTML, JSON, Output, check_outputs, write_json, write_whole
from ..base.grid import GridWindow
from ..base.json_types import JsonObject
from ..base.point_rows import read_point_rows
from ..base.version import __version__
from ..pipeline.inputs_outputs import input_files
from ..tiling.jobs import Job
from ..tiling.options import TilingOptions
from ..tiling.tile_records import RecordRun, Tile, cells_in_tile, record_run
from .cells import EMPTY, STEPS, SurfaceOptions, lowest
from .make_surfaces import CellSurvey, enclose
from .report_page import Rasters, render_report
from .survey_cells import ReportRules, combine, compare_strips, figures_of, reduce_for_report
from .triangulation import Box, heights_at

#: Width of pictures in pixels, and voids and control points that are listed, as many as fit a page.
_WIDTH, _LISTED = 820, 10
#: NSSDA: 95 % of normally distributed errors are smaller than this times their RMSE.
NSSDA = 1.96
#: How rasters of tiles become one, and what a cell without points holds.
_MERGES = {
    "all": (np.add, 0), "last": (np.add, 0),
    "void": (np.maximum, 0), "picture": (np.maximum, EMPTY),
}  # fmt: skip
#: x, y, z and name of a control point.
Control = tuple[float, float, float, str]


def write_report(
    inputs: Sequence[str],
    page: str,
    json_file: str = "",
    density: float = 0.0,
    void: float = 4.0,
    control: str = "",
    tiling: TilingOptions | None = None,
    progress: bool | None = None,
) -> JsonObject:
    """Write the report of a survey as an HTML page, and return it as JSON types.

    Parameters
    ----------
    inputs : sequence of str
        LAS, LAZ or COPC files, folders or patterns.
    page : str
        The HTML file.
    json_file : str
        A JSON file with the same figures; empty for none.
    density : float
        Points per square meter that were ordered; 0 if none were.
    void : float
        Area in m2 of a cell that should hold a point.
    control : str
        CSV file of control points: x, y, z in the units of the cloud, and a name.
    tiling : TilingOptions, optional
        As of ``classify``.
    progress : bool, optional
        Whether to show progress on stderr.
    """
    checks.number("--density", density, 0, 1e6)
    checks.number("--void", void, 0.01, 1e4, unit="m2")
    points = read_control(control) if control else []
    outputs = [Output(page, "report", HTML)] + [Output(json_file, "json", JSON)] * bool(json_file)
    files = input_files(inputs)
    check_outputs(outputs, [*files, *([control] if control else [])])
    chosen, folder = replace(tiling or TilingOptions(), per="tile"), Path(page).absolute().parent
    survey = CellSurvey("report", files, folder, chosen, SurfaceOptions())
    with record_run(survey, chosen, folder, progress) as run:
        result, rasters = _measure(run, density, void, points)
    write_whole(page, render_report(result, rasters).encode(errors="backslashreplace"), "report")
    if json_file:
        write_json(json_file, result, "json")
    return result


def read_control(path: str) -> list[Control]:
    """Return the control points of a CSV file: x, y, z and a name, with or without a heading."""
    rows = read_point_rows(path, "control point", needs_z=True)
    numbered = enumerate(rows, 1)
    return [
        (row.x, row.y, float(row.z or 0.0), row.name or str(number)) for number, row in numbered
    ]


def _measure(
    run: RecordRun, ordered: float, void: float, control: Sequence[Control]
) -> tuple[JsonObject, Rasters]:
    """Reduce all tiles; return the figures, and rasters to draw."""
    survey, unit = run.survey, run.survey.unit
    units = survey.reference.units
    run.read_inputs()
    x0, y0, x1, y1 = survey.find_lone_points().others
    rules = ReportRules(
        density=10.0 / unit,
        void=math.sqrt(void) / unit,
        strip=1.0 / unit,
        picture=max(max(x1 - x0, y1 - y0) / _WIDTH, 2.0 / math.sqrt(survey.density.each)),
        around_control=10.0 / unit,
        vertical=units.vertical / units.horizontal,
    )
    places = np.array([point[:2] for point in control]).reshape(-1, 2)
    settings = {**asdict(rules), "places": places.tolist()}
    reduce = partial(reduce_for_report, rules=rules, control=places)
    jobs = run.reduce("report", settings, reduce)
    files: dict[str, list[Any]] = {}
    for path, described in (item for job in jobs for item in job.record["files"].items()):
        files.setdefault(path, []).append(described)
    by_file = {path: combine(files[path]) for path in survey.paths if path in files}
    rasters = Rasters(rules, unit, {name: _merge(run, jobs, name) for name in _MERGES})
    strips, rasters.strips = _strips(run, jobs, rules, units.vertical)
    result = {
        "version": __version__,
        "reference": survey.reference.name,
        "meters_per_unit": {"horizontal": units.horizontal, "vertical": units.vertical},
        "survey": figures_of(combine([*by_file.values()])),
        "files": {path: figures_of(described) for path, described in by_file.items()},
        "repeated": sum(job.record["repeated"] for job in jobs),
        **_density(rasters, ordered),
        "strips": strips,
        "control": _control(run, jobs, control, rules, units.vertical) if control else None,
    }
    return result, rasters


def _merge(run: RecordRun, jobs: Sequence[Job], name: str) -> tuple[GridWindow, NDArray[np.int64]]:
    """Return a raster of all tiles."""
    merge, empty = _MERGES[name]
    loaded = run.arrays(jobs, name, f"{name}_window")
    windows = [GridWindow(*arrays[f"{name}_window"].tolist()) for arrays in loaded]
    if not any(w.width for w in windows):
        raise StageError("no point is neither noise nor withheld", found=run.survey.paths[0])
    whole = enclose(windows)
    out = np.full(whole.shape, empty)
    for window, arrays in zip(windows, loaded, strict=True):
        if window.width:
            place = out[window.slices_in(whole)]
            merge(place, arrays[name], out=place)
    return whole, out


def _density(rasters: Rasters, ordered: float) -> JsonObject:
    """Return figures of density and voids.

    A cell of density counts if it and its eight neighbors have points, as those at the border are
    filled in part. A void is a group of cells without points that others enclose; it is water if
    half of the cells with points around it or more are.
    """
    side_m, cell_m = rasters.rules.density * rasters.unit, rasters.rules.void * rasters.unit
    (_, all_points), (_, last) = rasters.of["all"], rasters.of["last"]
    inner = ndimage.minimum_filter(all_points > 0, 3, mode="constant")
    window, held = rasters.of["void"]
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(held > 0, 2), iterations=2))
    inside = inside[2:-2, 2:-2] | (held > 0)
    label, count = ndimage.label(inside & (held == 0), np.ones((3, 3)))
    area = float(inside.sum() * cell_m**2)
    density: JsonObject = {"cell_m": side_m, "cells": int(inner.sum()), "ordered": ordered}
    for name, points in (("all", all_points), ("last", last)):
        each = points[inner] / side_m**2
        known, judged = len(each) > 0, ordered > 0 and len(each) > 0
        density[name] = {
            "mean": float(points.sum() / area),
            "median": float(np.median(each)) if known else None,
            "share_below": float((each < ordered).mean()) if judged else None,
        }
    # Cells with points beside a void, by its number, and how many of them are water.
    beside = np.where(held > 0, ndimage.maximum_filter(label, 3), 0)
    around, water = (np.bincount(beside[held >= least], minlength=count + 1) for least in (1, 2))
    is_void = 2 * water < np.maximum(around, 1)
    is_void[0] = False
    rasters.voids = is_void[label]
    sizes = np.bincount(label[rasters.voids], minlength=count + 1) * cell_m**2
    middles = ndimage.center_of_mass(label > 0, label, np.flatnonzero(is_void))
    voids: list[JsonObject] = []
    for area_m2, (row, column) in zip(sizes[is_void], middles, strict=True):
        cell = window.left + column, window.bottom + row
        at = [round((number + 0.5) * rasters.rules.void, 2) for number in cell]
        voids.append({"area_m2": float(area_m2), "at": at})
    voids.sort(key=lambda each: (-each["area_m2"], each["at"]))
    total = float(sizes.sum())
    figures = {"cell_m2": cell_m**2, "count": len(voids), "area_m2": total, "share": total / area}
    return {"area_m2": area, "density": density, "voids": {**figures, "largest": voids[:_LISTED]}}


def _strips(
    run: RecordRun, jobs: Sequence[Job], rules: ReportRules, vertical: float
) -> tuple[list[JsonObject], NDArray[np.int64]]:
    """Compare the ground of strips; return pairs, worst first, and cells of density with errors."""

    def compute(tile: Tile, files: dict[Tile, str], target: str) -> Callable[[], Any]:
        window = cells_in_tile(run.survey.grid, tile, rules.strip)
        return partial(compare_strips, [*files.values()], window, rules, target)

    tiles = [job.tile for job in jobs]
    compared = run.compute("strips", jobs, tiles, 2 * rules.strip, compute)
    loaded = run.arrays(compared, "differences", "cells")
    rows = np.concatenate([arrays["differences"] for arrays in loaded])
    pairs: list[JsonObject] = []
    for a, b in np.unique(rows[:, :2], axis=0).tolist():
        value, count = rows[(rows[:, 0] == a) & (rows[:, 1] == b)][:, 2:].T
        order = np.argsort(value, kind="stable")
        middle = np.searchsorted(np.cumsum(count[order]), count.sum() / 2)
        rms = math.sqrt((value.astype(float) ** 2 * count).sum() / count.sum())
        values = {"median_m": float(value[order][middle]), "rms_m": rms}
        in_meters = {name: value * vertical / STEPS for name, value in values.items()}
        pairs.append({"strips": [a, b], "cells": int(count.sum()), **in_meters})
    pairs.sort(key=lambda pair: (-pair["rms_m"], pair["strips"]))
    return pairs, np.concatenate([arrays["cells"] for arrays in loaded])


def _control(
    run: RecordRun,
    jobs: Sequence[Job],
    control: Sequence[Control],
    rules: ReportRules,
    vertical: float,
) -> JsonObject:
    """Compare the terrain, through all ground points, with control points."""
    near_any = [arrays["control"] for arrays in run.arrays(jobs, "control")]
    ground = lowest(np.concatenate(near_any), 1.0)  # one of points at the same place
    reach, everywhere = rules.around_control * STEPS, (math.inf, math.inf, -math.inf, -math.inf)
    rows: list[JsonObject] = []
    outside = []
    for x, y, z, name in control:
        place = np.array([x, y]) * STEPS
        near = ground[np.hypot(*(ground[:, :2] - place).T) <= reach]
        height = heights_at((place[:1], place[1:]), reach, everywhere, partial(_all_of, near))
        if np.isfinite(height[0, 0]):
            difference = (height[0, 0] / STEPS - z) * vertical
            rows.append({"name": name, "x": x, "y": y, "z": z, "difference_m": float(difference)})
        else:
            outside.append(name)
    errors = np.array([row["difference_m"] for row in rows])
    rows.sort(key=lambda row: -abs(row["difference_m"]))
    out: JsonObject = {"points": len(rows), "outside": outside, "worst": rows[:_LISTED]}
    if rows:
        rmse = float(np.sqrt((errors**2).mean()))
        out |= {"mean_m": float(errors.mean()), "rmse_m": rmse, "nssda_95_m": NSSDA * rmse}
    return out


def _all_of(points: NDArray[np.int64], box: Box) -> NDArray[np.int64]:
    """Return points, whatever the box: all that matter are known."""
    return points


def lines(result: JsonObject) -> list[str]:
    """Return what the command prints of a report."""
    density, voids, control = result["density"], result["voids"], result["control"]
    out = [
        f"{result['survey']['points']:,} points, {density['all']['mean']:.1f} a m2",
        f"{voids['count']:,} voids, {voids['area_m2']:,.0f} m2 ({100 * voids['share']:.2f} %)",
    ]
    for pair in result["strips"][:1]:
        text = "strips {} and {}: median {median_m:+.3f} m, RMS {rms_m:.3f} m"
        out.append(text.format(*pair["strips"], **pair))
    if control:
        texts = []
        if control["points"]:
            texts.append("mean {mean_m:+.3f} m, RMSE {rmse_m:.3f} m".format(**control))
        texts += [f"{len(control['outside']):,} outside the terrain"] * bool(control["outside"])
        out.append(f"control points: {', '.join(texts)}")
    return out
