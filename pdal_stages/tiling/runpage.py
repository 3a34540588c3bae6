"""The report of a tiled run as a page: figures, a map of the tiles, classes, failures, times."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..base.asprs import class_color, class_name
from ..base.files import write_whole
from ..base.version import __version__
from ..reports import html
from .tiledrun import Job, TiledRun

#: Most tiles drawn, and most rows of a table.
_DRAWN, _ROWS = 20_000, 200


def write_report(path: str | os.PathLike[str], run: TiledRun, title: str = "Run in tiles") -> Path:
    """Write the page, whole or not at all.

    Raises
    ------
    StageError
        Where it cannot be written.
    """
    return write_whole(path, page(run, title).encode())


def page(run: TiledRun, title: str = "Run in tiles") -> str:
    """The page as text."""
    s = run.summary
    return html.page(
        title,
        _headline(run),
        _failures(run),
        _map(run),
        _classes(s),
        _outputs(run),
        _times(run),
        html.section("Settings", html.settings({k: s[k] for k in _SETTINGS if k in s})),
        subtitle=f"{s.get('points', 0):,} points, tiles of {s['tile']:g}",
        footer=f"pdal_stages {__version__}",
    )


_SETTINGS = (
    *("tile", "buffer_metres", "metres_per_unit", "per", "inputs", "workers", "threads_per_worker", "bounds"),
    *("points_read", "points_read_by_a_tile", "cpu_seconds"),
)


def _headline(run: TiledRun) -> str:
    s = run.summary
    states = s["states"]
    remark = ", ".join(f"{states[k]} {text}" for k, text in _STATES.items() if states.get(k) and k != "done")
    figures = [("Tiles", f"{len(run.tiles):,}", "", remark)]
    points = s.get("points", 0)
    size, unit = (f"{points:,}", "") if points < 10_000_000 else (f"{points / 1e6:,.1f}", "million")
    figures.append(("Points", size, unit, f"{s['dropped']:,} dropped" if s.get("dropped") else ""))
    if "seconds" in s:
        figures.append(("Time", _duration(s["seconds"]), "", f"{s['workers']} workers"))
        figures.append(("Speed", f"{s['points_per_second']:,.0f}", "points/s", ""))
        figures.append(("Most memory of a worker", f"{s['peak_mb_of_a_worker']:,.0f}", "MB", ""))
    return html.tiles(figures) + "".join(html.paragraph(note, "note") for note in run.notes)


_STATES = {"done": "done", "kept": "kept from an earlier run", "failed": "failed", "waiting": "to do"}


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return (
        f"{hours} h {minutes:02d}"
        if hours
        else f"{minutes}:{rest:02d} min"
        if minutes
        else f"{seconds:.1f} s"
    )


def _failures(run: TiledRun) -> str:
    found = run.failures
    if not found:
        return ""
    rows = [
        html.head(what, "row", "text break") + html.cell(why, "text break") for what, why in found[:_ROWS]
    ]
    more = f"{len(found) - _ROWS} more are in the JSON report. " if len(found) > _ROWS else ""
    head = '<tr><th scope="col" class="text">What</th><th scope="col" class="text">Why</th></tr>'
    return html.section(
        f"Failures ({len(found):,})",
        html.table(head, rows),
        note=f"{more}Run the command again with --resume to do only what failed.",
    )


def _map(run: TiledRun) -> str:
    """Every tile as a square: darker took longer, failed ones are crossed out."""
    jobs = run.tiles[:_DRAWN]
    if not jobs:
        return ""
    left, low = (min(j.tile[k] for j in jobs) for k in (0, 1))
    wide, high = (max(j.tile[k] for j in jobs) + 1 - o for k, o in ((0, left), (1, low)))
    slowest = max((j.report.get("seconds", 0.0) for j in jobs if j.state == "done"), default=0.0)
    squares = "".join(
        _square(job, job.tile[0] - left, high - 1 - (job.tile[1] - low), slowest) for job in jobs
    )
    width = min(820, max(240, wide * 60))
    alt = f"Map of {len(jobs)} tiles, {sum(j.state == 'failed' for j in jobs)} of them failed; north is up"
    svg = (
        f'<svg class="chart" viewBox="-0.05 -0.05 {wide + 0.1} {high + 0.1}" role="img" aria-label="{html.escape(alt)}" '
        f'style="width:100%;max-width:{width}px;height:auto">{squares}</svg>'
    )
    words = [
        f"North is up. The darker a tile, the longer it took (up to {_duration(slowest)})."
        if slowest
        else "North is up.",
        "Hollow: kept from an earlier run, or still to do.",
        "Crossed: failed.",
    ]
    left_out = f" Only the first {_DRAWN:,} tiles are drawn." if len(run.tiles) > _DRAWN else ""
    return html.section("Map of the tiles", html.figure(svg, " ".join(words) + left_out))


def _square(job: Job, x: int, y: int, slowest: float) -> str:
    report = job.report
    title = f"{job.name}: {_STATES[job.state]}, {report.get('points', job.points):,} points"
    if "seconds" in report:
        title += f", {report['seconds']:.1f} s"
    if job.reason:
        title += f". {job.reason}"
    colour, fill, cross = "--right", 0.0, ""
    if job.state == "done":
        fill = 0.25 + 0.75 * (report.get("seconds", 0.0) / slowest if slowest else 0.0)
    elif job.state == "failed":
        colour, fill = "--wrong", 0.35
        cross = (
            f'<path d="M{x + 0.2} {y + 0.2}l.6 .6M{x + 0.8} {y + 0.2}l-.6 .6" '
            'style="stroke:rgb(var(--wrong));stroke-width:.08;fill:none"/>'
        )
    return (
        f'<g><rect x="{x + 0.03}" y="{y + 0.03}" width=".94" height=".94" '
        f'style="fill:rgb(var({colour})/{fill:.2f});stroke:rgb(var({colour}));stroke-width:.03"/>{cross}'
        f"<title>{html.escape(title)}</title></g>"
    )


def _classes(s: dict[str, Any]) -> str:
    classes = s.get("classes") or {}
    total = sum(classes.values())
    if not total:
        return ""
    rows = [
        html.head(f"{code} {class_name(int(code))}", "row", "text", html.swatch(class_color(int(code))))
        + html.cell(f"{count:,}")
        + html.bar_cell(count / total, f"{100 * count / total:.1f} %")
        for code, count in classes.items()
    ]
    return html.section("Classes", html.table(("Class", "Points", "Share"), rows))


def _outputs(run: TiledRun) -> str:
    if not run.outputs:
        return ""
    rows = [
        html.head(", ".join(p.name for p in out.paths), "row", "text break")
        + html.cell(_STATES.get(out.state, out.state), "text")
        + html.cell(f"{out.report['written']:,}" if "written" in out.report else "")
        + html.cell(len(out.jobs))
        for out in run.outputs[:_ROWS]
    ]
    note = f"The first {_ROWS} of {len(run.outputs):,}." if len(run.outputs) > _ROWS else ""
    return html.section("Outputs", html.table(("File", "State", "Points", "Tiles"), rows), note=note)


def _times(run: TiledRun) -> str:
    done = sorted((j for j in run.tiles if j.state == "done"), key=lambda j: -j.report.get("seconds", 0.0))
    if not done:
        return ""
    rows = [
        html.head(j.name, "row", "text")
        + html.cell(f"{j.report['points']:,}")
        + html.cell(f"{j.report['read']:,}")
        + html.cell(f"{j.report['buffer']:.0f}" + (" (wider)" if j.report.get("widened") else ""))
        + html.cell(f"{j.report['seconds']:.1f}")
        + html.cell(f"{j.report['points'] / max(j.report['seconds'], 1e-9):,.0f}")
        + html.cell(j.tries)
        for j in done[:_ROWS]
    ]
    titles = ("Tile", "Points", "Read with surroundings", "Surroundings, m", "Seconds", "Points/s", "Tries")
    note = (
        f"The slowest {_ROWS} of {len(done):,}; all of them are in the JSON report."
        if len(done) > _ROWS
        else ""
    )
    return html.section("Times", html.table(titles, rows), note=note)
