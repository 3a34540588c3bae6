"""Words of the command line to what they mean."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from ..base.errors import suggest

OVERRIDES = (
    "Options of stages are set as in PDAL: --stage.TAG.option=VALUE for stages with a tag, "
    "--filters.name.option=VALUE for all stages of a type."
)
INPUTS = "Files that PDAL reads, folders, patterns, tile indexes, EPT sources"
_NO_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")


class Parser(argparse.ArgumentParser):
    """Says which of the choices may have been meant, and adds commands."""

    def error(self, message: str) -> NoReturn:
        if chosen := _NO_CHOICE.search(message):
            message += f". {suggest(chosen[1], re.findall(r'[a-z_-]+', chosen[2]))}".rstrip(". ")
        super().error(message)

    @property
    def commands(self) -> dict[str, argparse.ArgumentParser]:
        """The commands that are there."""
        if self._subparsers is None:
            self.add_subparsers(dest="command", required=True, metavar="COMMAND")
        return self._subparsers._group_actions[0].choices  # type: ignore

    def command(
        self,
        name: str,
        run: Callable[[argparse.Namespace], Any],
        help: str,
        overrides: bool = False,
        logged: bool = False,
        **more: Any,
    ) -> Callable:
        """Add a command; returns what adds its arguments. `logged`: it works long enough for a log and progress."""
        assert self.commands is not None
        more.setdefault("epilog", OVERRIDES if overrides else None)
        made = self._subparsers._group_actions[0].add_parser(  # type: ignore
            name, help=help, description=f"{help}.", **more
        )
        made.set_defaults(run=run, takes_overrides=overrides)
        takes = made.add_argument
        if logged:
            takes("--log", metavar="FILE", help="Add all that the run and its workers print to a log file")
            takes("--progress", action=argparse.BooleanOptionalAction, help="Show progress")
        return takes

    def refuse(self, command: str, unknown: Sequence[str]) -> NoReturn:
        """Leave the program: a command's words are unknown."""
        flags = re.findall(r"(?<!\S)--[\w-]+(?![\w.-])", self.commands[command].format_help())
        near = suggest(unknown[0].partition("=")[0], flags)
        self.commands[command].error(f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip(". "))


def switch(takes: Callable, flag: str, default: bool, help: str) -> None:
    """Add ``--flag`` and ``--no-flag``."""
    takes(flag, action=argparse.BooleanOptionalAction, default=default, help=help)
