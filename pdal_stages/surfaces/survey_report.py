"""The report by which a survey is accepted: density, voids, strips, control points, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base import checks
from ..base.errors import StageError
from ..base.files import HTML, JSON, Output, check_outputs, write_json, write_whole
from ..base.grid import GridWindow
from ..base.json_types import JsonObject
from ..base.messages import count_of
from ..base.point_rows import read_point_rows
from ..base.version import __version__
from ..pipeline.inputs_outputs import input_files
from ..tiling.jobs import Job
from ..tiling.options import TilingOptions
from ..tiling.tile_records import (
    RecordJob,
    RecordRun,
    RecordSurvey,
    Tile,
    cells_in_tile,
    record_run,
)
from .cells import STEPS, CellDensity, SurfaceOptions, lowest
from .report_page import render_report
from .survey_cells import (
    RASTERS,
    Differences,
    ReportFigures,
    ReportRules,
    combine,
    compare_strips,
    figures_of,
    reduce_tile,
)
from .triangulation import Box, heights_at

#: Width of pictures in pixels.
_WIDTH = 820
#: Voids and control points that are listed, as many as fit a page.
_LISTED = 10
#: NSSDA: 95 % of normally distributed errors are smaller than this times their RMSE.
NSSDA = 1.96
#: x, y, z and name of a control point.
Control = tuple[float, float, float, str]
#: Cells, and their values (rows, columns) from the south.
WindowCells = tuple[GridWindow, NDArray[np.int64]]


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
    measure = partial(CellDensity.with_cells, SurfaceOptions())
    survey = RecordSurvey("report", files, Path(page).absolute().parent, tiling, measure)
    with record_run(survey, progress) as run:
        result, text = _measure(run, density, void, points)
    write_whole(page, text.encode(errors="backslashreplace"), "report")
    if json_file:
        write_json(json_file, result, "json")
    return result


def read_control(path: str) -> list[Control]:
    """Return the control points of a CSV file: x, y, z and a name, with or without a heading."""
    rows = read_point_rows(path, "control point", needs_z=True)
    return [(r.x, r.y, float(r.z or 0.0), r.name or str(n)) for n, r in enumerate(rows, 1)]


def _measure(
    run: RecordRun, ordered: float, void: float, control: Sequence[Control]
) -> tuple[JsonObject, str]:
    """Reduce all tiles; return the figures and the page."""
    survey, units = run.survey, run.survey.reference.units
    run.read_inputs()
    x0, y0, x1, y1 = survey.find_lone_points().others
    rules = ReportRules(
        density=10.0 / units.horizontal,
        void=math.sqrt(void) / units.horizontal,
        strip=1.0 / units.horizontal,
        picture=max(max(x1 - x0, y1 - y0) / _WIDTH, 2.0 / math.sqrt(survey.density.each)),
        around_control=10.0 / units.horizontal,
        vertical=units.vertical / units.horizontal,
        unit=units.horizontal,
    )
    places = np.array([point[:2] for point in control]).reshape(-1, 2)
    settings = {**asdict(rules), "places": places.tolist()}
    reduce = partial(reduce_tile, rules=rules, control=places)
    jobs = run.reduce("report", settings, reduce, ReportFigures)
    files: dict[str, list[JsonObject]] = {}
    for path, described in (item for job in jobs for item in job.figures.files.items()):
        files.setdefault(path, []).append(described)
    by_file = {path: combine(files[path]) for path in survey.paths if path in files}
    whole = {name: _merge(run, jobs, name) for name in ("all", "last", "void", "picture")}
    compared = _compare_strips(run, jobs, rules)
    for name in ("differing", "squares"):
        whole[name] = _merge(run, compared, name, whole["all"][0])
    if not whole["all"][1].any():
        raise StageError("no point is neither noise nor withheld", found=survey.paths[0])
    figures, is_void = _density(whole, rules, ordered)
    cells = {name: values for name, (_, values) in whole.items()} | {"voids": is_void}
    result = {
        "version": __version__,
        "reference": survey.reference.name,
        "meters_per_unit": {"horizontal": units.horizontal, "vertical": units.vertical},
        "survey": figures_of(combine([*by_file.values()])),
        "files": {path: figures_of(described) for path, described in by_file.items()},
        "repeated": sum(job.figures.repeated for job in jobs),
        **figures,
        "strips": _strips(run, compared, units.vertical),
        "control": _control(run, jobs, control, rules, units.vertical) if control else None,
    }
    return result, render_report(result, rules, cells)


def _merge(
    run: RecordRun, jobs: Sequence[Job], name: str, window: GridWindow | None = None
) -> WindowCells:
    """Return a raster of all tiles, and its window, if none is given that of their cells."""
    if window is None:
        each = run.arrays(jobs, f"{name}_window")
        window = GridWindow.union(GridWindow(*arrays[f"{name}_window"].tolist()) for arrays in each)
    parts = run.arrays(jobs, name, f"{name}_window")
    return window, RASTERS[name].join(name, parts, window)


def _density(
    rasters: Mapping[str, WindowCells], rules: ReportRules, ordered: float
) -> tuple[JsonObject, NDArray[np.bool_]]:
    """Return figures of density and voids, and which cells are voids.

    A cell of density counts if it and its eight neighbors have points, as those at the border are
    filled in part. A void is a group of cells without points that others enclose; it is water if
    half of the cells with points around it or more are.
    """
    side_m, cell_m = rules.density * rules.unit, rules.void * rules.unit
    inner = ndimage.minimum_filter(rasters["all"][1] > 0, 3, mode="constant")
    window, held = rasters["void"]
    closed = ndimage.binary_closing(np.pad(held > 0, 2), iterations=2)
    inside = ndimage.binary_fill_holes(closed)[2:-2, 2:-2] | (held > 0)
    label, count = ndimage.label(inside & (held == 0), np.ones((3, 3)))
    area = float(inside.sum() * cell_m**2)
    density: JsonObject = {"cell_m": side_m, "cells": int(inner.sum()), "ordered": ordered}
    for name in ("all", "last"):
        points = rasters[name][1]
        each = points[inner] / side_m**2
        density[name] = {
            "mean": float(points.sum() / area),
            "median": float(np.median(each)) if len(each) else None,
            "share_below": float((each < ordered).mean()) if ordered and len(each) else None,
        }
    # Cells with points beside a void, by its number, and how many of them are water.
    beside = np.where(held > 0, ndimage.maximum_filter(label, 3), 0)
    rim, water = (np.bincount(beside[held >= least], minlength=count + 1) for least in (1, 2))
    is_void = 2 * water < np.maximum(rim, 1)
    is_void[0] = False
    sizes = np.bincount(label.ravel(), minlength=count + 1)[is_void] * cell_m**2
    middles = ndimage.center_of_mass(label > 0, label, np.flatnonzero(is_void))
    corner = window.bottom + 0.5, window.left + 0.5
    places = (np.reshape(middles, (-1, 2)) + corner) * rules.void
    voids: list[JsonObject] = [
        {"area_m2": size, "at": [round(x, 2), round(y, 2)]}
        for size, (y, x) in zip(sizes.tolist(), places.tolist(), strict=True)
    ]
    voids.sort(key=lambda each: (-each["area_m2"], each["at"]))
    total = float(sizes.sum())
    figures = {"cell_m2": cell_m**2, "count": len(voids), "area_m2": total, "share": total / area}
    listed = {**figures, "largest": voids[:_LISTED]}
    return {"area_m2": area, "density": density, "voids": listed}, is_void[label]


def _compare_strips(
    run: RecordRun, jobs: Sequence[RecordJob[ReportFigures]], rules: ReportRules
) -> Sequence[Job]:
    """Compare the ground of strips in all tiles; return the jobs."""

    def compute(tile: Tile, files: dict[Tile, str], target: str) -> Callable[[], Differences]:
        window = cells_in_tile(run.survey.grid, tile, rules.strip)
        return partial(compare_strips, [*files.values()], window, rules, target)

    tiles = [job.tile for job in jobs]
    return run.compute("strips", jobs, tiles, 2 * rules.strip, compute, Differences)


def _strips(run: RecordRun, compared: Sequence[Job], vertical: float) -> list[JsonObject]:
    """Return how pairs of strips differ, worst first."""
    rows = np.concatenate([each["differences"] for each in run.arrays(compared, "differences")])
    pairs: list[JsonObject] = []
    for a, b in np.unique(rows[:, :2], axis=0).tolist():
        value, count = rows[(rows[:, 0] == a) & (rows[:, 1] == b)][:, 2:].T
        order = np.argsort(value, kind="stable")
        middle = np.searchsorted(np.cumsum(count[order]), count.sum() / 2)
        rms = math.sqrt((value.astype(float) ** 2 * count).sum() / count.sum())
        values = {"median_m": float(value[order][middle]), "rms_m": rms}
        in_meters = {name: value * vertical / STEPS for name, value in values.items()}
        pairs.append({"strips": [a, b], "cells": int(count.sum()), **in_meters})
    return sorted(pairs, key=lambda pair: (-pair["rms_m"], pair["strips"]))


def _control(
    run: RecordRun,
    jobs: Sequence[Job],
    control: Sequence[Control],
    rules: ReportRules,
    vertical: float,
) -> JsonObject:
    """Compare the terrain, through all ground points, with control points."""
    near_any = np.concatenate([each["control"] for each in run.arrays(jobs, "control")])
    ground = lowest(near_any, 1.0)  # one of points at the same place
    reach, everywhere = rules.around_control * STEPS, (math.inf, math.inf, -math.inf, -math.inf)
    rows: list[JsonObject] = []
    outside = []
    for x, y, z, name in control:
        place = np.array([x, y]) * STEPS
        near = ground[np.hypot(*(ground[:, :2] - place).T) <= reach]
        height = heights_at((place[:1], place[1:]), reach, everywhere, partial(_all_of, near))
        difference = float((height[0, 0] / STEPS - z) * vertical)
        if math.isnan(difference):
            outside.append(name)
        else:
            rows.append({"name": name, "x": x, "y": y, "z": z, "difference_m": difference})
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
        f"{count_of(result['survey']['points'], 'point')}, {density['all']['mean']:.1f} a m2",
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
