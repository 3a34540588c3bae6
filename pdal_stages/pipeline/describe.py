"""Answers about stages in PDAL's own form: ``--drivers`` and ``--options``, ours and PDAL's."""

from __future__ import annotations

import contextlib
import json
import textwrap

from ..base.errors import DependencyError, PipelineError, suggest
from ..stages import registry
from ..stages.base import Stage
from ..stages.options import Option
from . import pdal as pdal_env


def drivers(*, ours_only: bool = False, as_json: bool = False) -> str:
    """The list of stages, ours first."""
    ours = {name: stage.summary for name, stage in registry.stages().items()}
    if as_json:
        listed = [
            {"name": name, "description": text, "link": "", "extensions": []} for name, text in ours.items()
        ]
        if not ours_only:
            # Where our plugin is built, PDAL names ours too.
            theirs = json.loads(pdal_env.ask_program("--drivers", "--showjson"))
            listed += [entry for entry in theirs if entry["name"] not in ours]
        return json.dumps(listed, indent=2) + "\n"
    width = max(map(len, ours)) + 2
    lines = ["=" * 80, "pdal_stages", "=" * 80]
    lines += [
        textwrap.fill(f"{name:{width}}{text}", 80, subsequent_indent=" " * width, break_long_words=False)
        for name, text in ours.items()
    ]
    return "\n".join([*lines, ""]) + ("" if ours_only else pdal_env.ask_program("--drivers"))


def stage_options(type_name: str, *, as_json: bool = False) -> str:
    """The options of a stage, of ours or of PDAL's."""
    if type_name not in registry.stages():
        answer = ""
        with contextlib.suppress(DependencyError, PipelineError):
            answer = pdal_env.ask_program("--options", type_name, *(["--showjson"] if as_json else []))
        if not answer.strip() or "Unable to create" in answer or "not found" in answer:
            raise PipelineError(
                f"there is no stage '{type_name}', neither of ours nor of PDAL's",
                cure=f"{suggest(type_name, registry.stages())}List them with: pdal-stages drivers",
            )
        return answer
    stage = registry.get(type_name)
    if as_json:
        return json.dumps(stage.schema(), indent=2) + "\n"
    lines = [f"{stage.type} -- {stage.summary}", "-" * 80]
    if stage.source:
        lines += [f"  Source: {stage.source}", ""]
    for option in stage.all_options():
        lines += [_head(option), textwrap.indent(textwrap.fill(_help(stage, option), 74), " " * 6), ""]
    return "\n".join(lines)


def _head(option: Option) -> str:
    if option.required:
        return f"  {option.name}  (required)"
    if (default := option.default) in (None, "", ()):
        return f"  {option.name}"
    shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
    unit = f" {option.unit}" if option.unit else ""
    return f"  {option.name} [{str(shown).lower() if isinstance(shown, bool) else shown}{unit}]"


def _help(stage: type[Stage], option: Option) -> str:
    text = option.help
    if option.name == "where" and stage.where_help:
        text = f"A condition on points (PDAL's own filters do not see the others). {stage.where_help}"
    return text + (f" (one of: {', '.join(map(str, option.choices))})" if option.choices else "")


def nearest_option(type_name: str, option: str) -> str:
    """``Did you mean ...?`` among the options of a stage of PDAL's, and where they are listed."""
    known: list[str] = []
    with contextlib.suppress(DependencyError, PipelineError, ValueError, OSError):
        _, options = json.loads(pdal_env.ask_program("--options", type_name, "--showjson"))
        known += [entry["name"] for entry in options]
    return f"{suggest(option, known)}List its options with: pdal-stages options {type_name}"


def nearest_stage(type_name: str) -> str:
    """``Did you mean ...?`` among PDAL's stages and ours, and where they are listed."""
    known = list(registry.stages())
    with contextlib.suppress(DependencyError, PipelineError, ValueError, OSError):
        known += [entry["name"] for entry in json.loads(pdal_env.ask_program("--drivers", "--showjson"))]
    return f"{suggest(type_name, known)}List the stages there are with: pdal-stages drivers"
