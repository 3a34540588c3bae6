"""The picture of docs/architecture.md: the way of a tile from reader to writer, and the room in which each step is done.

python docs/architecture_picture.py        # writes docs/pictures/architecture.svg
"""

from __future__ import annotations

from html import escape
from pathlib import Path

TARGET = Path(__file__).resolve().parent / "pictures" / "architecture.svg"

#: (heading, steps) of each column; a step is two lines of words and the room that does it ("PDAL": not ours).
COLUMNS = (
    (
        "Before any point",
        (
            ("Read the pipeline as PDAL does,", "with line numbers for messages", "pipeline/"),
            ("Apply what the command line", "overrides", "pipeline/"),
            ("Make each of our stages an object:", "checked options, plan, model", "stages/"),
            ("Turn our stages into filters.python:", "plain PDAL JSON", "pipeline/"),
            ("With --tile: find the inputs, lay", "the grid, hand out the tiles", "tiling/"),
            ("With --tile: cut the tile and its", "surroundings out of the files", "tiling/"),
        ),
    ),
    (
        "In PDAL: whole cloud or tile",
        (
            ("Reader", "", "PDAL"),
            ("Hand the points to the stage,", "in meters, class codes without flags", "pipeline/"),
            ("Heights above a terrain", "", "terrain/"),
            ("Features of many neighborhoods,", "block by block", "features/"),
            (
                "Forest or network; a second pass",
                "reads what the first said all around",
                "classifier/",
            ),
            ("Classes, reliability, margin", "", "classifier/"),
        ),
    ),
    (
        "Afterwards",
        (
            ("With --tile: put the tiles' results", "into the points of each file", "tiling/"),
            ("Writer, under a hidden name", "", "PDAL"),
            ("Check that the file is complete,", "then give it its name", "base/"),
            ("Compare with a reference", "", "accuracy/"),
            ("Pages and pictures", "", "reports/"),
        ),
    ),
)
WIDE, GAP, BOX, STEP, TOP = 316, 28, 64, 82, 62


def picture() -> str:
    """The SVG."""
    width = len(COLUMNS) * (WIDE + GAP) + GAP
    height = TOP + max(len(steps) for _, steps in COLUMNS) * STEP + 8
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        'aria-label="The way of a tile from reader to writer">',
        "<style>text{font:14px system-ui,Arial,sans-serif;fill:#181d23}.head{font-weight:600;font-size:16px}"
        ".room{font:13px ui-monospace,Menlo,Consolas,monospace;fill:#1f6fb2}.ours{fill:#fff;stroke:#9aa3ad}"
        ".pdal{fill:#f3ead9;stroke:#b08954}.way{stroke:#58616c;stroke-width:1.6;fill:none;marker-end:url(#tip)}"
        ".page{fill:#fafaf8}</style>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L8 4L0 8Z" fill="#58616c"/></marker></defs>',
        f'<rect class="page" width="{width}" height="{height}"/>',
    ]
    for number, (heading, steps) in enumerate(COLUMNS):
        left = GAP + number * (WIDE + GAP)
        parts.append(f'<text class="head" x="{left}" y="36">{number + 1}. {escape(heading)}</text>')
        for row, (first, second, room) in enumerate(steps):
            top = TOP + row * STEP
            kind = "pdal" if room == "PDAL" else "ours"
            parts.append(
                f'<rect class="{kind}" x="{left}" y="{top}" width="{WIDE}" height="{BOX}" rx="6"/>'
                f'<text x="{left + 14}" y="{top + (20 if second else 28)}">{escape(first)}</text>'
                f'<text x="{left + 14}" y="{top + 37}">{escape(second)}</text>'
                f'<text class="room" x="{left + 14}" y="{top + (55 if second else 49)}">{escape(room)}</text>'
            )
            if row + 1 < len(steps):
                parts.append(
                    f'<path class="way" d="M{left + WIDE // 2} {top + BOX}V{top + STEP - 1}"/>'
                )
            elif number + 1 < len(COLUMNS):
                turn = left + WIDE + GAP // 2
                way = f"M{left + WIDE} {top + BOX // 2}H{turn}V{TOP + BOX // 2}H{left + WIDE + GAP - 1}"
                parts.append(f'<path class="way" d="{way}"/>')
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    TARGET.write_text(picture(), encoding="utf-8")
