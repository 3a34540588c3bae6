"""Answers about stages in PDAL's own form: ``--drivers`` and ``--options``, ours and PDAL's."""

from __future__ import annotations

import contextlib
import json
import textwrap

from ..base.errors import DependencyError, PipelineError, suggest
from ..stages import registry
from . import pdal as pdal_env

_RULE = "-" * 80


def drivers(*, ours_only: bool = False, as_json: bool = False) -> str:
    """The list of stages, ours first."""
    ours = [(s.type, s.summary) for s in registry.stages().values()]
    if as_json:
        listed = [{"name": name, "description": text, "link": "", "extensions": []} for name, text in ours]
        if not ours_only:
            # Where our plugin is built, PDAL names ours too.
            theirs = json.loads(pdal_env.ask_program("--drivers", "--showjson"))
            listed += [entry for entry in theirs if entry["name"] not in registry.stages()]
        return json.dumps(listed, indent=2) + "\n"
    width = max(len(name) for name, _ in ours) + 2
    lines = ["=" * 80, "pdal_stages", "=" * 80]
    lines += [
        textwrap.fill(f"{name:{width}}{text}", 80, subsequent_indent=" " * width, break_long_words=False)
        for name, text in ours
    ]
    text = "\n".join(lines) + "\n"
    return text if ours_only else text + pdal_env.ask_program("--drivers")


def stage_options(type_name: str, *, as_json: bool = False) -> str:
    """The options of a stage, of ours or of PDAL's."""
    if type_name not in registry.stages():
        try:
            arguments = ["--options", type_name] + (["--showjson"] if as_json else [])
            answer = pdal_env.ask_program(*arguments)
        except (DependencyError, PipelineError):
            answer = ""
        if not answer.strip() or "Unable to create" in answer or "not found" in answer:
            raise PipelineError(
                f"there is no stage '{type_name}', neither of ours nor of PDAL's",
                cure=f"{suggest(type_name, registry.stages())}List them with: pdal-stages drivers",
            )
        return answer
    stage = registry.get(type_name)
    if as_json:
        return json.dumps(stage.schema(), indent=2) + "\n"
    lines = [f"{stage.type} -- {stage.summary}", _RULE]
    if stage.source:
        lines += [f"  Source: {stage.source}", ""]
    for option in stage.all_options():
        help_text = option.help
        if option.name == "where" and stage.where_help:
            help_text = (
                f"A condition on points (PDAL's own filters do not see the others). {stage.where_help}"
            )
        if option.choices:
            help_text += f" (one of: {', '.join(map(str, option.choices))})"
        head = f"  {option.name}"
        if option.required:
            head += "  (required)"
        elif option.default not in (None, "", ()):
            shown = (
                ",".join(map(str, option.default)) if isinstance(option.default, tuple) else option.default
            )
            unit = f" {option.unit}" if option.unit else ""
            head += f" [{str(shown).lower() if isinstance(shown, bool) else shown}{unit}]"
        lines += [head, textwrap.fill(help_text, 80, initial_indent=" " * 6, subsequent_indent=" " * 6), ""]
    return "\n".join(lines)


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
