"""What there is: stages, their options, commands, this machine, PDAL's own stages of ours."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial

from ..plugin.command import add_arguments as add_plugin_arguments
from .adder import Adder


def add_commands(add: Adder) -> None:
    """``drivers``, ``options``, ``commands``, ``doctor`` and ``plugin``."""
    takes = add("drivers", _drivers, "List stages: ours, then PDAL's")
    takes("--ours", action="store_true", help="Only ours")
    takes("--showjson", action="store_true", help="As JSON, like pdal --drivers --showjson")

    takes = add("options", _options, "List the options of a stage")
    takes("stage", help="e.g. filters.hag_minima; for PDAL's stages pdal --options is asked")
    takes("--showjson", action="store_true", help="As JSON Schema")

    takes = add("commands", partial(_commands, add.choices), "List commands with their arguments")
    takes(
        "--showjson",
        action="store_true",
        help="With stages, models and classes, as JSON: dialogs are made of it",
    )

    add("doctor", _doctor, "Tell what is there on this machine, and the cure for what is not")
    add("plugin", _plugin, "Build our stages into PDAL itself, so that all that runs PDAL has them")
    add_plugin_arguments(add.choices["plugin"])


def _drivers(options: argparse.Namespace) -> None:
    from ..pipeline import describe

    print(describe.drivers(ours_only=options.ours, as_json=options.showjson), end="")


def _commands(choices: Mapping[str, argparse.ArgumentParser], options: argparse.Namespace) -> None:
    from ..plugin.forms import forms

    if options.showjson:
        print(forms(choices), end="")
        return
    for name, parser in choices.items():
        print(f"{name:12s} {parser.description}")


def _doctor(options: argparse.Namespace) -> int:
    from ..plugin.doctor import examine

    missing = 0
    for finding in examine():
        print(finding, flush=True)
        missing += bool(finding.cure and finding.needed)
    return int(missing > 0)


def _plugin(options: argparse.Namespace) -> int:
    from ..plugin.command import run

    return run(options)


def _options(options: argparse.Namespace) -> None:
    from ..pipeline import describe

    print(describe.stage_options(options.stage, as_json=options.showjson), end="")
