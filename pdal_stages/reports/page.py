"""Render web pages from templates: self-contained HTML, escaped throughout, without scripts.

One of them is the page about a run, in tiles or in one piece, made from its JSON report.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from ..accuracy.text import percent
from ..base.asprs import class_color, class_name
from ..base.messages import count_of, duration, plain
from ..base.version import __version__

#: Rows of a table on a page: large enough for a person to read, small enough for a browser.
TABLE_ROWS = 200
#: Titles of the settings on the page, by their names in the JSON report.
_TITLES = {
    "pipeline": "pipeline",
    "models": "models",
    "started": "started",
    "inputs": "input files",
    "bounds": "extent of the inputs",
    "tile": "side of the tiles",
    "halo_m": "surroundings, m",
    "per": "one output for each",
    "workers": "workers",
    "points_read": "points read with surroundings",
    "cpu_seconds": "processor time",
}


def render(template: str, **context: Any) -> str:
    """Return a page from a template of ``templates/``; all values are escaped.

    Every template needs a `title`; `subtitle` is empty and `date` today by default, or the day
    that the environment sets with ``SOURCE_DATE_EPOCH``.
    """
    context = {"subtitle": "", "version": __version__, "date": _today(), **context}
    page = _templates().get_template(template).render(context)
    # Names of files may hold bytes that are not UTF-8, or control characters.
    return plain(page.encode(errors="backslashreplace").decode())


@lru_cache(maxsize=1)
def _templates() -> Environment:
    environment = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        percent=percent, count=lambda n: f"{n:,}", flat=flat, duration=duration
    )
    environment.globals.update(class_color=class_color)
    return environment


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return names and values as text: nested mappings get dotted names, numbers six digits."""
    out: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out += flat(value, f"{prefix}{key}.")
        else:
            out.append((f"{prefix}{key}", _text(value)))
    return out


def _text(value: Any) -> str:
    if isinstance(value, Mapping | list | tuple | set | frozenset):
        return ", ".join(map(_text, value)) or "none"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:.6g}"
    return "none" if value is None else str(value)


def _today() -> str:
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    if epoch.isdigit():
        return datetime.datetime.fromtimestamp(int(epoch), datetime.timezone.utc).date().isoformat()
    return datetime.date.today().isoformat()


def run_page(run: Mapping[str, Any]) -> str:
    """Return the page about a run, in tiles or in one piece: ``TiledRun.to_dict``."""
    classes = run.get("classes") or {}
    tiles = "in one piece"
    if "tile" in run:
        tiles = f"{count_of(len(run['tiles']), 'tile')} of {run['tile']:g}"
    pipeline = f"{Path(run['pipeline']).name}, " if run.get("pipeline") else ""
    return render(
        "run.html",
        title="Run in tiles" if "tile" in run else "Run",
        subtitle=pipeline + tiles,
        run=run,
        figures=_figures(run),
        what=_settings(run),
        classes=[(int(code), class_name(int(code)), count) for code, count in classes.items()],
        most=TABLE_ROWS,
    )


def _figures(run: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the headline figures: what this run did, and what it kept of an earlier one."""
    states = run["states"]
    named = {"kept": "kept from an earlier run", "failed": "failed", "waiting": "to do"}
    rest = ", ".join(f"{states[k]:,} {text}" for k, text in named.items() if states.get(k))
    tiles = f"{states['done']:,}" if "done" in states else f"{len(run['tiles']):,}"
    kept = sum(t["points"] for t in run["tiles"] if t["state"] == "kept")
    details = [f"{kept:,} more kept from an earlier run"] if kept else []
    if run.get("dropped"):
        details.append(f"{run['dropped']:,} dropped by filters")
    points = run.get("points", 0)
    size, unit = (f"{points:,}", "") if points < 10_000_000 else (f"{points / 1e6:,.1f}", "million")
    out = [("Tiles", tiles, "", rest)] if "tile" in run else []
    out.append(("Points", size, unit, "; ".join(details)))
    if "seconds" in run:
        workers = count_of(run["workers"], "worker") if "workers" in run else ""
        out.append(("Time", duration(run["seconds"]), "", workers))
        out.append(("Speed", f"{run['points_per_second']:,.0f}", "points/s", ""))
    if "peak_mb_of_a_worker" in run:
        out.append(("Most memory of a worker", f"{run['peak_mb_of_a_worker']:,.0f}", "MB", ""))
    return out


def _settings(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the run by title."""
    shown = {name: run[key] for key, name in _TITLES.items() if run.get(key) not in (None, "", [])}
    if run.get("bounds"):
        x0, y0, x1, y1 = run["bounds"]
        shown[_TITLES["bounds"]] = f"x {x0:.2f} to {x1:.2f}, y {y0:.2f} to {y1:.2f}"
    if "cpu_seconds" in run:
        shown[_TITLES["cpu_seconds"]] = duration(run["cpu_seconds"])
    return {key: f"{value:,}" if isinstance(value, int) else value for key, value in shown.items()}
