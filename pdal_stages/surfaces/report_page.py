"""The page of the report of a survey, with its pictures."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base.json_types import JsonObject
from ..base.messages import count_of
from ..reports import pictures
from ..reports.accuracy_page import render_page
from .cells import EMPTY, STEPS
from .survey_cells import ReportRules

#: Colors of density and of differences, from low to high.
_DENSITY = ((247, 244, 236), (186, 216, 200), (84, 160, 176), (28, 78, 128), (20, 24, 70))
_DIFFERENCES = ((44, 123, 182), (171, 217, 233), (255, 255, 191), (253, 174, 97), (215, 25, 28))
#: Meters: differences of strips from which the last color is shown.
_LARGE = 0.1
_VOID = np.array([204, 24, 32])
#: Least width of a picture in pixels.
_LEAST = 400
#: Pixels: farther ones take nothing from the nearest that has a point.
_GAP = 2.0
#: Widest scale bar as a part of a picture's width: one in this number.
_SCALE_PART = 6
#: Seconds from the beginning of GPS time to that of adjusted standard time, less 10**9.
_GPS_EPOCH = datetime.datetime(1980, 1, 6, tzinfo=datetime.timezone.utc)


def render_report(result: JsonObject, rules: ReportRules, cells: Mapping[str, NDArray]) -> str:
    """Return the page.

    `cells` are the rasters of :data:`.survey_cells.RASTERS`, (rows, columns) from the south, and
    ``voids``: which cells of ``void`` are voids.
    """
    unit, top = rules.unit, cells["picture"]
    top = np.pad(top, 1, constant_values=EMPTY)  # a single row has no slope to be shaded
    away, at = ndimage.distance_transform_edt(top == EMPTY, return_indices=True)
    known, top = away < _GAP, top[tuple(at)]
    z = np.where(known, (top >> 8) / STEPS, np.nan) * rules.vertical
    which = np.where(known, 0, -1)[::-1]
    relief = pictures.Surface(0.0, 0.0, rules.picture * unit, which, z[::-1], 1.0)
    light, codes = pictures.shading(relief), np.where(known, top & 255, 0)[::-1]
    meters = rules.density * unit
    per_m2 = cells["all"] / meters**2
    most = result["density"]["ordered"] or float(np.percentile(per_m2[per_m2 > 0], 90))
    density = pictures.ramp(np.where(per_m2 > 0, per_m2, np.nan), _DENSITY, (0.0, 2 * most))
    held = np.where(cells["void"] > 0, 235, 255)[..., None].repeat(3, axis=2)
    held[cells["voids"] > 0] = _VOID
    each = f"Points a m2, cells of {meters:g} m: white 0, dark {2 * most:.3g}"
    heights, colors = pictures.ramp(relief.z, pictures.HEIGHT_COLORS), pictures.CLASS_COLORS[codes]
    views = [
        _view("Classes", pictures.paint(relief, colors, light), relief.pixel),
        _view("Heights", pictures.paint(relief, heights, light), relief.pixel),
        _view(each, density[::-1], meters),
        _view("Voids: red", held[::-1].astype(np.uint8), rules.void * unit),
    ]
    if result["strips"]:
        heading = f"Strips: RMS difference, blue 0, red {_LARGE:g} m"
        with np.errstate(invalid="ignore"):
            rms = np.sqrt(cells["squares"] / cells["differing"]) * unit
        colors = pictures.ramp(rms * (rules.vertical / STEPS), _DIFFERENCES, (0.0, _LARGE))
        views.append(_view(heading, colors[::-1], meters))
    every = [(Path(path).name, described) for path, described in result["files"].items()]
    return render_page(
        "survey.html",
        title="Survey report",
        subtitle=f"{count_of(len(every), 'file')}, {result['reference'] or 'no reference system'}",
        r=result,
        files=every,
        views=views,
        codes=[int(code) for code in result["survey"]["classes"]],
        time_span=_time_span(result["survey"]["times"]),
    )


def _view(heading: str, colors: NDArray[np.uint8], pixel_m: float) -> JsonObject:
    """Return a picture for the template, enlarged where it is small."""
    times = max(1, _LEAST // colors.shape[1])
    colors = colors.repeat(times, axis=0).repeat(times, axis=1)
    wide = colors.shape[1] * pixel_m / times
    length = pictures.nice_step(wide / _SCALE_PART)
    scale = 100 * length / wide, f"{length:g} m"
    return {"heading": heading, "alt": heading, "scale": scale, **pictures.embed(colors)}


def _time_span(times: tuple[float, float] | None) -> str:
    """Return the first and the last time; GPS times beyond a week are dates."""
    if times is None:
        return ""
    if max(times) <= 7 * 86400:
        return f"{times[0]:,.0f} to {times[1]:,.0f} s of the GPS week"
    dates = (_GPS_EPOCH + datetime.timedelta(seconds=value + 1e9) for value in times)
    return " to ".join(date.strftime("%Y-%m-%d %H:%M") for date in dates)
