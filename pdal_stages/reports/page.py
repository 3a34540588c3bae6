"""Render web pages from templates: self-contained HTML, escaped throughout, without scripts."""

from __future__ import annotations

import datetime
import os
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from ..accuracy.text import percent
from ..base.asprs import class_color
from ..base.messages import duration, plain
from ..base.version import __version__


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
