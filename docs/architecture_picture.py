"""Draw the picture of docs/architecture.md: the core as the way of a tile, and the extras as doors.

python docs/architecture_picture.py        # writes docs/pictures/architecture.svg
"""

from __future__ import annotations

from html import escape
from pathlib import Path

TARGET = Path(__file__).resolve().parent / "pictures" / "architecture.svg"

#: (heading, steps) of each column; a step is two lines of text and its room ("PDAL": not ours).
COLUMNS = (
    (
        "Before any point",
        (
            ("Read the pipeline as PDAL does,", "apply options of the command line", "pipeline/"),
            ("Make each of our stages an object:", "checked options, plan, model", "stages/"),
            ("Turn our stages into filters.python:", "plain PDAL JSON", "pipeline/"),
            ("In tiles: cut each tile with its", "surroundings out of the files", "tiling/"),
        ),
    ),
    (
        "In PDAL: whole cloud or tile",
        (
            ("Reader", "", "PDAL"),
            ("Hand the points to the stage,", "in meters, class codes without flags", "pipeline/"),
            ("Heights, ground, noise;", "decks", "terrain/ structures/"),
            ("Features of many neighborhoods,", "block by block", "features/"),
        ),
    ),
    (
        "Classes, and afterwards",
        (
            ("Forest or network, a second pass;", "class, reliability", "classifier/ alsnet/"),
            ("In tiles: put the tiles' results", "into the points of each file", "tiling/"),
            ("Writer; the file gets its name", "when it is complete", "PDAL base/"),
            ("Compare with a reference", "", "accuracy/"),
        ),
    ),
)
#: (room, what it adds, its doors in the core) of each extra.
EXTRAS = (
    ("objects/", "outlines of buildings, trees", "filters.objects, objects"),
    ("review/", "what a person checks, corrects", "review, corrections"),
    ("reports/", "pages, pictures, vector files", "--html"),
    ("surfaces/", "rasters, report of a survey", "surfaces, report"),
    ("synthetic/", "a generated town", "demo"),
    ("qgis/", "the plugin for QGIS", "calls the command"),
)
COLUMN_WIDTH = 316
GAP = 28
BOX_HEIGHT = 64
STEP = 82
TOP = 62
EXTRA_GAP = 14

STYLE = (
    "<style>text{font:14px system-ui,Arial,sans-serif;fill:#181d23}"
    ".head{font-weight:600;font-size:16px}.small{font-size:12.5px}"
    ".room{font:13px ui-monospace,Menlo,Consolas,monospace;fill:#1f6fb2}"
    ".ours{fill:#fff;stroke:#9aa3ad}.pdal{fill:#f3ead9;stroke:#b08954}"
    ".extra{fill:#eef4ee;stroke:#7d9a7d;stroke-dasharray:4 3}"
    ".way{stroke:#58616c;stroke-width:1.6;fill:none;marker-end:url(#tip)}.page{fill:#fafaf8}</style>"
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
    'orient="auto"><path d="M0 0L8 4L0 8Z" fill="#58616c"/></marker></defs>'
)


def picture() -> str:
    """Return the SVG."""
    width = len(COLUMNS) * (COLUMN_WIDTH + GAP) + GAP
    rows = max(len(steps) for _, steps in COLUMNS)
    extras_top = TOP + rows * STEP + 14
    height = extras_top + 120
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        'aria-label="The core as the way of a tile from reader to writer, and the extras">',
        STYLE,
        f'<rect class="page" width="{width}" height="{height}"/>',
    ]
    for number, (heading, steps) in enumerate(COLUMNS):
        left = GAP + number * (COLUMN_WIDTH + GAP)
        parts.append(f'<text class="head" x="{left}" y="36">{number + 1}. {escape(heading)}</text>')
        for row, step in enumerate(steps):
            top = TOP + row * STEP
            parts += draw_step(left, top, *step)
            if row + 1 < len(steps):
                way = f"M{left + COLUMN_WIDTH // 2} {top + BOX_HEIGHT}V{top + STEP - 1}"
                parts.append(f'<path class="way" d="{way}"/>')
            elif number + 1 < len(COLUMNS):
                turn = left + COLUMN_WIDTH + GAP // 2
                way = f"M{left + COLUMN_WIDTH} {top + BOX_HEIGHT // 2}H{turn}"
                way += f"V{TOP + BOX_HEIGHT // 2}H{left + COLUMN_WIDTH + GAP - 1}"
                parts.append(f'<path class="way" d="{way}"/>')
    parts.append(
        f'<text class="head" x="{GAP}" y="{extras_top + 16}">Extras: the core works without them; '
        "each is entered by its doors alone</text>"
    )
    wide = (width - 2 * GAP - (len(EXTRAS) - 1) * EXTRA_GAP) / len(EXTRAS)
    for number, extra in enumerate(EXTRAS):
        parts += draw_extra(GAP + number * (wide + EXTRA_GAP), extras_top + 32, wide, *extra)
    return "\n".join([*parts, "</svg>", ""])


def draw_step(left: int, top: int, first: str, second: str, room: str) -> list[str]:
    """Return the box of a step."""
    kind = "pdal" if room.startswith("PDAL") else "ours"
    first_y, room_y = (20, 55) if second else (28, 49)
    return [
        f'<rect class="{kind}" x="{left}" y="{top}" width="{COLUMN_WIDTH}" height="{BOX_HEIGHT}" '
        'rx="6"/>',
        f'<text x="{left + 14}" y="{top + first_y}">{escape(first)}</text>',
        f'<text x="{left + 14}" y="{top + 37}">{escape(second)}</text>',
        f'<text class="room" x="{left + 14}" y="{top + room_y}">{escape(room)}</text>',
    ]


def draw_extra(left: float, top: int, wide: float, room: str, adds: str, doors: str) -> list[str]:
    """Return the box of an extra."""
    return [
        f'<rect class="extra" x="{left:g}" y="{top}" width="{wide:g}" height="72" rx="6"/>',
        f'<text class="room" x="{left + 10:g}" y="{top + 21}">{escape(room)}</text>',
        f'<text class="small" x="{left + 10:g}" y="{top + 41}">{escape(adds)}</text>',
        f'<text class="small" x="{left + 10:g}" y="{top + 60}">door: {escape(doors)}</text>',
    ]


if __name__ == "__main__":
    TARGET.write_text(picture(), encoding="utf-8")
