"""Pages of stages: a text of docs/stage_texts or the docstring of the class, with tables of
declarations.

python docs/stage_pages.py        # writes docs/stages/*.md
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

from pdal_stages.stages.base import Stage
from pdal_stages.stages.registry import stage_types

FOLDER = Path(__file__).resolve().parent / "stages"
#: What is written by hand of each stage: what it does, an example; the dimensions, where that needs
#: files.
TEXTS = FOLDER.with_name("stage_texts")


def page(stage: type[Stage]) -> str:
    """One stage in the shape of PDAL's stage pages."""
    text = text_of(stage)
    lines = [f"# {stage.type}", "", f"{stage.summary}.", ""]
    if stage.source:
        lines += [f"Source: {stage.source} (see [the papers](../papers.md)).", ""]
    lines += [text, ""]
    if "## Dimensions" not in text:
        instance = stage({name: value for name, value in example(stage).items() if name != "type"})
        reads, written = instance.reads(), instance.written_dimensions()
        lines += [
            "## Dimensions",
            "",
            f"- Reads: X, Y, Z{''.join(f', {name}' for name in reads)}",
            "- Writes: "
            + ("; ".join(map(_described, written[:8])) or "none")
            + (f"; and {len(written) - 8} more" if len(written) > 8 else ""),
            f"- Halo: {instance.halo_m():g} m round a tile, with the example's options",
            "",
        ]
    lines += ["## Options", "", "| option | default | meaning |", "|---|---|---|"]
    lines += [_row(option) for option in stage.all_options()]
    lines += ["| `tag`, `inputs` | | As in every PDAL stage |", ""]
    return "\n".join(lines)


def text_of(stage: type[Stage]) -> str:
    """Return what the stage does, and an example."""
    path = TEXTS / f"{stage.type}.md"
    if path.exists():
        return path.read_text(encoding="utf-8").strip()
    shown = json.dumps(["in.laz", {"type": stage.type, **stage.example}, "out.laz"], indent=1)
    return f"{inspect.getdoc(stage) or ''}\n\n## Example\n\n```json\n{shown}\n```"


def example(stage: type[Stage]) -> dict[str, Any]:
    """The stage in the pipeline that its text shows."""
    pipeline = json.loads(text_of(stage).partition("```json\n")[2].partition("\n```")[0])
    return next(
        stage_json
        for stage_json in pipeline
        if isinstance(stage_json, dict) and stage_json.get("type") == stage.type
    )


def _described(dimension) -> str:
    unit = "" if dimension.unit == "1" else f", {dimension.unit}"
    return f"`{dimension.name}` ({dimension.type}{unit}): {dimension.meaning}"


def _row(option) -> str:
    value, _, unit = option.shown_default.partition(" ")
    default = "required" if option.required else f"`{value}` {unit}".strip() if value else ""
    text = f"{option.help}."
    if option.choices:
        text += f" One of {', '.join(f'`{c}`' for c in option.choices)}."
    bounds = []
    if option.minimum is not None:
        bounds.append(
            f"more than {option.minimum:g}" if option.exclusive else f"at least {option.minimum:g}"
        )
    if option.maximum is not None and option.maximum < 2**31 - 1:
        bounds.append(f"at most {option.maximum:g}")
    if bounds:
        text += f" ({' and '.join(bounds)})"
    text = text.replace("<", "&lt;").replace("|", "&#124;")
    return f"| `{option.name}` | {default} | {text} |"


def index() -> str:
    """The list of stages."""
    lines = ["# Stages", "", "| stage | does |", "|---|---|"]
    lines += [f"| [{s.type}]({s.type}.md) | {s.summary} |" for s in stage_types().values()]
    lines += ["", "```{toctree}", ":hidden:", "", *stage_types(), "```", ""]
    return "\n".join(lines)


def write() -> None:
    """Write all pages."""
    FOLDER.mkdir(exist_ok=True)
    for stage in stage_types().values():
        (FOLDER / f"{stage.type}.md").write_text(page(stage), encoding="utf-8")
    (FOLDER / "index.md").write_text(index(), encoding="utf-8")


if __name__ == "__main__":
    write()
