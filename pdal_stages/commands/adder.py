"""What each command is made with: its name, what it does, and the arguments that many have."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

OVERRIDES = (
    "Options of stages are set as in PDAL: --stage.TAG.option=VALUE for stages with a tag, "
    "--filters.name.option=VALUE for all stages of a type."
)
INPUTS = "Files that PDAL reads, folders, patterns, tile indexes, EPT sources"
#: Commands that work long enough for a log and progress.
_LOGGED = ("pipeline", "classify", "objects", "review", "train", "adapt", "accuracy", "demo")


class Adder:
    """Adds commands to a parser; `choices` are those that are there."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
        self.choices: dict[str, argparse.ArgumentParser] = self._commands.choices  # type: ignore[assignment]

    def __call__(
        self, name: str, run: Callable[[argparse.Namespace], Any], help: str, overrides: bool = False
    ) -> Callable:
        """Add a command; returns what adds its arguments."""
        command = self._commands.add_parser(
            name, help=help, description=help + ".", epilog=OVERRIDES if overrides else None
        )
        command.set_defaults(run=run, takes_overrides=overrides, parser=command)
        if name in _LOGGED:
            command.add_argument(
                "--log", metavar="FILE", help="Add all that the run and its workers print to a log file"
            )
            command.add_argument(
                "--progress", action=argparse.BooleanOptionalAction, default=None, help="Show progress"
            )
        return command.add_argument
