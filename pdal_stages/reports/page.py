"""Pages from templates: single self-contained HTML files, escaped throughout, without scripts."""

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
    """A page from a template of ``templates/``, whose every value is escaped: a `title`, maybe a `subtitle`, and its own.

    The date is today's by default, or ``SOURCE_DATE_EPOCH`` where the environment sets it.
    """
    context = {"subtitle": "", "version": __version__, "date": _today(), **context}
    page = _templates().get_template(template).render(context)
    # Names that are not UTF-8, or command a terminal
    return plain(page.encode(errors="backslashreplace").decode())


@lru_cache(maxsize=1)
def _templates() -> Environment:
    made = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(percent=percent, count=lambda n: f"{n:,}", flat=flat, duration=duration)
    made.globals.update(class_color=class_color)
    return made


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Names and values as text: nested mappings get dotted names, numbers six digits."""
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
