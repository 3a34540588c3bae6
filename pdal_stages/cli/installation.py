"""Commands about the installation: stages, options, the plugin for PDAL, compiled kernels."""

from __future__ import annotations

import argparse
import contextlib
import json
import textwrap
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from ..base.errors import DependencyError, PipelineError, suggest
from ..base.json_types import JsonObject
from .parser import Parser

#: Version of the JSON of ``commands``: readers, such as the plugin for QGIS, refuse others, so it
#: rises when a field gets another name or meaning.
_FORMAT = 1
_TYPES = {int: "integer", float: "number"}


def add_commands(parser: Parser) -> None:
    """Add ``drivers``, ``options``, ``commands``, ``doctor``, ``plugin`` and ``warmup``."""
    add = parser.command("drivers", _drivers, "List all stages: ours, then PDAL's")
    add("--ours", action="store_true", help="Only our stages")
    add("--showjson", action="store_true", help="As JSON, like pdal --drivers --showjson")

    add = parser.command("options", _options, "List the options of a stage")
    add("stage", help="One of ours or PDAL's, e.g. filters.hag_minima")
    add("--showjson", action="store_true", help="As JSON Schema")

    what = "List commands, stages, models and classes as JSON, for programs that build dialogs"
    add = parser.command("commands", partial(_commands, parser), what)
    add("--showjson", action="store_true", help="Accepted as that of drivers and options")

    parser.command("doctor", _doctor, "Check what is installed, and say how to get what is missing")

    what = "Build our stages into PDAL itself, for all programs that use it"
    parser.command("plugin", _plugin, what)
    command = parser.commands["plugin"]
    add = command.adder_to(command.add_mutually_exclusive_group(required=True))
    add("--install", action="store_true", help="Compile them, beside filters.python")
    add("--check", action="store_true", help="Say what is there and what is missing")
    add("--uninstall", action="store_true", help="Remove them")
    folder = "Another folder; PDAL_DRIVER_PATH must name it and the folder of filters.python"
    command.add_argument("--folder", type=Path, metavar="DIR", help=folder)

    what = "Compile the kernels now, so that later runs do not wait"
    add = parser.command("warmup", _warmup, what)
    every = "Also the kernels of kopt, ropt, rdim, copt and shape distributions"
    add("--all", action="store_true", help=every)


def _drivers(options: argparse.Namespace) -> None:
    from ..pipeline.pdal import ask_program, drivers
    from ..stages.registry import stage_types

    ours = {name: stage.summary for name, stage in stage_types().items()}
    if options.showjson:
        more = {"link": "", "extensions": []}
        listed = [{"name": name, "description": text, **more} for name, text in ours.items()]
        if not options.ours:  # with our plugin, PDAL lists ours as well
            listed += [driver for driver in drivers() if driver["name"] not in ours]
        print(json.dumps(listed, indent=2))
        return
    width = max(map(len, ours)) + 2
    wrap = textwrap.TextWrapper(80, subsequent_indent=" " * width, break_long_words=False)
    print("=" * 80, "pdal_stages", "=" * 80, sep="\n")
    for name, text in ours.items():
        print(wrap.fill(f"{name:{width}}{text}"))
    print("" if options.ours else f"\n{ask_program('--drivers')}", end="")


def _options(options: argparse.Namespace) -> None:
    """Print the options of one of our stages or of PDAL's, in PDAL's form."""
    from ..pipeline.pdal import ask_program, drivers
    from ..stages.registry import stage_type, stage_types

    name = options.stage
    if name not in stage_types():
        answer = ""
        with contextlib.suppress(DependencyError, PipelineError):
            answer = ask_program("--options", name, *(["--showjson"] if options.showjson else []))
        if not answer.strip() or "Unable to create" in answer or "not found" in answer:
            near = suggest(name, [*stage_types(), *(driver["name"] for driver in drivers())])
            what = f"there is no stage '{name}', neither of ours nor of PDAL's"
            raise PipelineError(what, cure=f"{near}List them with: pdal-stages drivers")
        print(answer, end="")
        return
    stage = stage_type(name)
    if options.showjson:
        print(json.dumps(stage.schema(), indent=2))
        return
    print(f"{stage.type} -- {stage.summary}", "-" * 80, sep="\n")
    if stage.source:
        print(f"  Source: {stage.source}\n")
    for option in stage.all_options():
        text, default = option.help, option.shown_default
        if option.choices:
            text += f" (one of: {', '.join(map(str, option.choices))})"
        mark = "  (required)" if option.required else f" [{default}]" * bool(default)
        print(f"  {option.name}{mark}")
        print(textwrap.indent(textwrap.fill(text, 74), " " * 6) + "\n")
    if text := stage.describe_choices():
        print(text)


def _commands(main_parser: Parser, options: argparse.Namespace) -> None:
    """Print commands, stages, models and classes as JSON, from which QGIS builds dialogs.

    An argument has ``name``, ``flag`` (empty for one without), ``kind`` (``number``, ``integer``,
    ``boolean``, ``string``), ``help``, ``default``, ``choices``, ``required``, ``many`` (add
    several, or may be repeated) and ``value`` (what usage calls its value).
    """
    from ..base.asprs import NAMES, class_color
    from ..base.version import __version__
    from ..classifier.model_file import shipped
    from ..stages.registry import stage_types

    def describe_command(parser: Parser) -> JsonObject:
        shown = (a for a in parser.arguments if a.help != argparse.SUPPRESS and a.dest != "help")
        arguments = [_argument(action, action in parser.repeatable) for action in shown]
        return {"help": parser.description, "arguments": arguments}

    def describe_option(option: Any) -> JsonObject:
        shown = option.typed_default if isinstance(option.default, tuple) else option.default
        return asdict(option) | {"default": shown}

    content = {
        "format": _FORMAT,
        "version": __version__,
        "models": list(shipped()),
        "classes": {str(c): {"name": name, "color": class_color(c)} for c, name in NAMES.items()},
        "commands": {n: describe_command(parser) for n, parser in main_parser.commands.items()},
        "stages": {
            name: {"help": stage.summary, "options": [*map(describe_option, stage.all_options())]}
            for name, stage in stage_types().items()
        },
    }
    print(json.dumps(content, indent=1))


def _argument(action: argparse.Action, many: bool) -> JsonObject:
    switch = action.nargs == 0
    of_choices = type(next(iter(action.choices))) if action.choices else None
    value_type: Any = action.type or of_choices
    kind = "boolean" if switch else _TYPES.get(value_type, "string")
    default = bool(action.default) if switch else action.default
    flags = action.option_strings
    return {
        "name": action.dest,
        "flag": flags[0] if switch else max(flags, key=len, default=""),
        "off": next((flag for flag in flags if flag.startswith("--no-")), ""),
        "kind": kind,
        "help": (action.help or "").replace("%%", "%"),
        "default": default if isinstance(default, bool | int | float | str) else None,
        "choices": list(action.choices or ()),
        "required": bool(action.required),
        "many": many,
        "value": action.metavar if isinstance(action.metavar, str) else "",
    }


def _doctor(options: argparse.Namespace) -> int:
    from ..plugin.doctor import examine

    missing = 0
    for finding in examine():
        print(finding, flush=True)
        missing += bool(finding.cure and finding.needed)
    return int(missing > 0)


def _plugin(options: argparse.Namespace) -> int:
    from ..plugin import install

    if options.check:
        good, bad = install.check(options.folder)
        print("\n".join([*good, *(f"missing: {line}" for line in bad)]))
        return int(bool(bad))
    if options.uninstall:
        gone = install.uninstall(options.folder)
        print("\n".join(f"removed {path}" for path in gone) or "there is no plugin of ours")
        return 0
    files = install.install(options.folder)
    print(f"{len(files)} stages in {files[0].parent}; see them with: pdal --drivers")
    return 0


def _warmup(options: argparse.Namespace) -> None:
    """Run the kernels of heights, training, classification and objects once."""
    import numpy as np

    from ..classifier.line_evidence import find_lines
    from ..classifier.training import train
    from ..classifier.training_clouds import TrainingCloud
    from ..classifier.training_options import TrainingOptions
    from ..objects.crowns import crown_cells
    from ..objects.roofs import planes
    from ..structures.decks import find_decks
    from ..terrain import detached_noise, filtered_ground, hag_minima

    # A deck over a valley, with land at both ends, so that the kernels for decks run as well.
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-120.0, 120.0), np.arange(-80.0, 80.0)))
    z = np.where(abs(y) <= 4.0, 6.0, np.clip((abs(x) - 15.0) / 7.5, 0.0, 6.0))
    on_ground = filtered_ground(x, y, z, openings=(5,), threads=1)["Ground"] > 0
    find_decks(x, y, z, np.ones(len(x), bool), on_ground)
    xyz = np.random.default_rng(0).uniform(0.0, 12.0, (400, 3))
    xyz[1] = xyz[0]  # one stands for both
    axes = np.ascontiguousarray(xyz.T)
    detached_noise(*axes)
    dimensions = filtered_ground(*axes, openings=(5,), threads=1)
    dimensions["HeightAboveGround"] = hag_minima(*axes)
    dimensions |= dict.fromkeys(("ReturnNumber", "NumberOfReturns"), np.ones(len(xyz), np.uint8))
    how = TrainingOptions(
        neighborhoods="s5,k10",
        feature_set="covariance,geometric,surfaces",
        dimensions=("HeightAboveGround", "Ground", "HeightAboveOpening_5", "returns", "GapBelow"),
        context=("own", "segments6", *TrainingOptions().context),  # as shipped models read
        trees=1,
        count=50,
        threads=1,
    )
    classes = np.where(xyz[:, 2] > 6.0, 6, 2)
    model = train(TrainingCloud(xyz, classes, dimensions), how, progress=False)
    model.predict(xyz, dimensions, threads=1)
    find_lines(xyz, np.ones(len(xyz), np.float32))
    crown_cells(np.ones((9, 9)), 0.5, 0.5, 2.0)
    planes(np.ones((9, 9)), np.ones((9, 9)), 0.5, 1.0)
    if options.all:
        from ..features import warmup as every_neighborhood

        every_neighborhood()
