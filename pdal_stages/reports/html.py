"""Pieces of a self-contained HTML page: skeleton, tables, charts, images; no scripts, nothing fetched.

All reports of the package are made of these, so that they look alike, follow the reader's light or
dark setting, print well and can be read by a screen reader. Every function returns markup as text and
escapes what it is given, unless it says that it takes markup.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .style import style_sheet


def escape(text: object) -> str:
    """Text made safe for markup and attribute values."""
    return html.escape(str(text), quote=True)


def page(title: str, *sections: str, subtitle: str = "", footer: str = "", language: str = "en") -> str:
    """The whole page around its sections (markup)."""
    below = f'<p class="sub">{escape(subtitle)}</p>' if subtitle else ""
    foot = f"<footer>{escape(footer)}</footer>" if footer else ""
    return (
        f'<!DOCTYPE html>\n<html lang="{escape(language)}"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style_sheet()}</style></head>\n<body><main>"
        f"<header><h1>{escape(title)}</h1>{below}</header>\n"
        + "\n".join(s for s in sections if s)
        + f"\n{foot}"
        "</main></body></html>\n"
    )


def section(heading: str, *parts: str, note: str = "") -> str:
    """A headed section around markup."""
    below = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(heading)}</h2>{below}{''.join(parts)}</section>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph; `kind` is "", "lead" or "note"."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def grid(*parts: str, least: int = 300, kind: str = "") -> str:
    """Markup side by side, in columns of at least `least` pixels; `kind` "row" stays a row in print."""
    return f'<div class="{f"grid {kind}".strip()}" style="--least:{int(least)}px">{"".join(parts)}</div>'


def strip(*parts: str, label: str) -> str:
    """Wide markup, below each other, that scrolls sideways together where the window is narrow."""
    return (
        f'<div class="scroll strip" tabindex="0" role="region" aria-label="{escape(label)}">'
        f"<div>{''.join(parts)}</div></div>"
    )


def tiles(figures: Iterable[tuple[str, str, str, str]]) -> str:
    """Headline figures: (label, value, unit, remark)."""
    out = []
    for label, value, unit, remark in figures:
        small = f" <small>{escape(unit)}</small>" if unit else ""
        more = f'<dd class="more">{escape(remark)}</dd>' if remark else ""
        out.append(f"<div><dt>{escape(label)}</dt><dd>{escape(value)}{small}</dd>{more}</div>")
    return f'<dl class="tiles">{"".join(out)}</dl>'


def swatch(color: Sequence[int]) -> str:
    """A small square of a colour (0-255)."""
    return f'<span class="swatch" style="background:rgb({",".join(str(int(c)) for c in color[:3])})"></span>'


def legend(entries: Iterable[tuple[Sequence[int], str]]) -> str:
    """Colours and what they mean."""
    return f'<ul class="legend">{"".join(f"<li>{swatch(c)}{escape(t)}</li>" for c, t in entries)}</ul>'


# ---- tables ----------------------------------------------------------------------------------------------


def cell(text: object, kind: str = "") -> str:
    """A table cell; `kind` is a class of the style sheet ("text", "break")."""
    return f'<td class="{kind}">{escape(text)}</td>' if kind else f"<td>{escape(text)}</td>"


def head(text: object, scope: str = "col", kind: str = "", before: str = "", span: int = 1) -> str:
    """A table header cell, for a column or a row; `before` is markup."""
    extra = (f' class="{kind}"' if kind else "") + (f' colspan="{span}"' if span > 1 else "")
    return f'<th scope="{scope}"{extra}>{before}{escape(text)}</th>'


def bar_cell(share: float | None, text: str) -> str:
    """A table cell with a share as a bar below its text."""
    if share is None:
        return cell(text)
    width = 100 * min(max(share, 0.0), 1.0)
    return f'<td class="bar">{escape(text)}<i aria-hidden="true"><b style="width:{width:.1f}%"></b></i></td>'


def heat_cell(value: float, right: bool, text: str, below: str = "") -> str:
    """A table cell shaded by a value from 0 to 1, in the colour of right or of wrong."""
    small = f"<small>{escape(below)}</small>" if below else ""
    kind = "right" if right else "wrong"
    return f'<td class="heat {kind}" style="--v:{min(max(value, 0.0), 1.0):.3f}">{escape(text)}{small}</td>'


def table(
    header: Sequence[str] | str,
    rows: Iterable[str],
    caption: str = "",
    remark: str = "",
    wide: bool = False,
    foot: str = "",
) -> str:
    """A table of markup rows (cells joined); `header` is column titles, or header rows as markup.

    The first title is set to the left; `foot` is a last row that sums up. The table scrolls sideways
    where the window is narrow.
    """
    if not isinstance(header, str):
        header = "<tr>" + "".join(head(t, kind="" if i else "text") for i, t in enumerate(header)) + "</tr>"
    titled = f"<b>{escape(caption)}</b>" + (f"<br>{escape(remark)}" if remark else "")
    top = f"<caption>{titled}</caption>" if caption else ""
    last = f"<tfoot><tr>{foot}</tr></tfoot>" if foot else ""
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    kind = ' class="wide"' if wide else ""
    label = f' role="region" aria-label="{escape(caption)}"' if caption else ""
    return (
        f'<div class="scroll" tabindex="0"{label}><table{kind}>{top}<thead>{header}</thead>'
        f"<tbody>{body}</tbody>{last}</table></div>"
    )


def settings(values: Mapping[str, Any], caption: str = "Settings") -> str:
    """Names and values as a table; nested mappings become dotted names."""
    rows = [head(k, "row", "text") + cell(v, "text break") for k, v in _flat(values)]
    return table(
        '<tr><th scope="col" class="text">Name</th><th scope="col" class="text">Value</th></tr>',
        rows,
        caption,
    )


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    out: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out += _flat(value, f"{prefix}{key}.")
        elif isinstance(value, (list, tuple, set, frozenset)):
            out.append((f"{prefix}{key}", ", ".join(map(str, value)) or "none"))
        else:
            out.append((f"{prefix}{key}", "none" if value is None else str(value)))
    return out


# ---- figures ---------------------------------------------------------------------------------------------


def figure(content: str, caption: str, heading: str = "") -> str:
    """Markup with a caption below and, optionally, a heading above."""
    top = f"<h3>{escape(heading)}</h3>" if heading else ""
    return f"<figure>{top}{content}<figcaption>{escape(caption)}</figcaption></figure>"


def image(png: bytes, alt: str, width: int = 0, height: int = 0, overlay: str = "") -> str:
    """A PNG held in the page; `overlay` is SVG drawn over it in coordinates from 0 to 100."""
    size = f' width="{int(width)}" height="{int(height)}"' if width and height else ""
    over = (
        f'<svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">{overlay}</svg>'
        if overlay
        else ""
    )
    data = base64.b64encode(png).decode("ascii")
    return f'<div class="map"><img src="data:image/png;base64,{data}" alt="{escape(alt)}"{size}>{over}</div>'


def bars(values: Mapping[str, float], unit: str = "%") -> str:
    """Shares as horizontal bars, longest first; the largest fills the width."""
    most = max(values.values(), default=0.0) or 1.0
    out = []
    for name, share in sorted(values.items(), key=lambda kv: (-kv[1], kv[0])):
        width = 100 * max(share, 0.0) / most
        out.append(
            f'<dt>{escape(name)}</dt><dd aria-hidden="true"><i style="width:{width:.1f}%"></i></dd>'
            f"<dd>{100 * share:.1f} {escape(unit)}</dd>"
        )
    return f'<dl class="bars">{"".join(out)}</dl>'


def chart(
    *,
    alt: str,
    x_label: str,
    y_label: str,
    x: tuple[float, float] = (0.0, 1.0),
    y: tuple[float, float] = (0.0, 1.0),
    x_ticks: Sequence[tuple[float, str]] = (),
    y_ticks: Sequence[tuple[float, str]] = (),
    bars: Sequence[tuple[float, float, float, str, str]] = (),
    lines: Sequence[tuple[Sequence[tuple[float, float]], str]] = (),
    dots: Sequence[tuple[float, float, str]] = (),
    values: Sequence[tuple[float, float, str]] = (),
) -> str:
    """An SVG chart with axes.

    Parameters
    ----------
    alt : str
        What the chart shows, in words.
    x_label, y_label : str
        The axes' titles.
    x, y : (low, high)
        The axes' ranges.
    x_ticks, y_ticks : sequence of (position, text)
    bars : sequence of (left, right, top, kind, title)
        `kind` is "faint", "solid" or "bad"; the title shows on hovering.
    lines : sequence of (points, kind)
        `kind` is "line" or "ideal" (dashed).
    dots : sequence of (x, y, title)
    values : sequence of (x, y, text)
        Text centred above a place.
    """
    wide, high, left, right, top, bottom = 520, 320, 62, 12, 16, 52

    def px(v: float) -> float:
        return left + (v - x[0]) / (x[1] - x[0]) * (wide - left - right)

    def py(v: float) -> float:
        return high - bottom - (v - y[0]) / (y[1] - y[0]) * (high - top - bottom)

    out = [f'<svg class="chart" viewBox="0 0 {wide} {high}" role="img" aria-label="{escape(alt)}">']
    for v, text in y_ticks:
        out.append(f'<path class="gridline" d="M{left} {py(v):.1f}H{wide - right}"/>')
        out.append(f'<text x="{left - 8}" y="{py(v) + 4.5:.1f}" text-anchor="end">{escape(text)}</text>')
    for a, b, t, kind, title in bars:
        edge = min(py(t), py(y[0]))
        size = f'width="{max(px(b) - px(a) - 2, 0.5):.1f}" height="{max(py(y[0]) - edge, 0):.1f}"'
        place = f'x="{px(a) + 1:.1f}" y="{edge:.1f}"'
        out.append(f'<rect class="{kind}" {place} {size}><title>{escape(title)}</title></rect>')
    for v, text in x_ticks:
        out.append(
            f'<text x="{px(v):.1f}" y="{high - bottom + 18}" text-anchor="middle">{escape(text)}</text>'
        )
    out.append(f'<path class="axis" d="M{left} {high - bottom}H{wide - right}"/>')
    for points, kind in lines:
        way = "L".join(f"{px(a):.1f} {py(b):.1f}" for a, b in points)
        out.append(f'<path class="{kind}" d="M{way}"/>' if points else "")
    for a, b, title in dots:
        place = f'cx="{px(a):.1f}" cy="{py(b):.1f}"'
        out.append(f'<circle class="dot" {place} r="5"><title>{escape(title)}</title></circle>')
    centred = 'text-anchor="middle"'
    for a, b, text in values:
        out.append(f'<text class="value" x="{px(a):.1f}" y="{py(b) - 5:.1f}" {centred}>{escape(text)}</text>')
    across, down = (left + wide - right) / 2, (top + high - bottom) / 2
    out.append(f'<text x="{across:.0f}" y="{high - 8}" {centred}>{escape(x_label)}</text>')
    turned = f'transform="rotate(-90 14 {down:.0f})"'
    out.append(f'<text x="14" y="{down:.0f}" {centred} {turned}>{escape(y_label)}</text></svg>')
    return "".join(out)


def details(summary: str, content: str) -> str:
    """Markup that is folded away under a summary."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"
