"""The parser of the command line, and flags from options that stages declare."""

from __future__ import annotations

import argparse
import importlib
import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NoReturn

from ..base.errors import StageError, suggest
from ..base.json_types import JsonObject
from ..base.version import __version__

#: Modules and their commands. Only the module of the requested command is imported. ``commands`` is
#: left out on purpose: like a word that is not a command, it imports all, as it describes all.
COMMANDS = {
    "classify": ("classify",),
    "models": ("models", "train", "accuracy", "model"),
    "pipelines": ("pipeline", "expand", "validate"),
    "installation": ("drivers", "options", "doctor", "plugin", "warmup"),
    "deliverables": ("surfaces", "report"),
    "extras": ("objects", "review", "explain", "corrections", "demo"),
}
OVERRIDES = "Stages take options as in PDAL: --stage.TAG.option=V, --filters.name.option=V"
INPUTS = "Files, folders, patterns, tile indexes"
#: What argparse prints where a value is not among the choices.
_INVALID_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")
_WORD = re.compile(r"[\w-]+")
#: Choices that take more columns stand in the help text instead of before it.
_CHOICES_WIDTH = 40


def parse(arguments: Sequence[str], is_program: bool) -> argparse.Namespace:
    """Return the command, its arguments, and options of stages among them (`overrides`).

    `is_program` says whether this process runs for the command alone; it is handed on.

    Raises
    ------
    SystemExit
        Where usage is wrong, or only help was requested.
    """
    # Imported here, so that a missing package is reported in one sentence.
    from ..pipeline.json_source import parse_overrides

    overrides, words = parse_overrides(arguments)
    parser = Parser(
        prog="pdal-stages",
        description="Classify airborne laser scans, alone or in PDAL pipelines.",
        epilog="Help on a command: pdal-stages COMMAND --help. "
        "With --debug errors show tracebacks.",
    )
    parser.add_argument("--version", action="version", version=f"pdal-stages {__version__}")
    module_of = {command: module for module, names in COMMANDS.items() for command in names}
    modules = [module_of[words[0]]] if words and words[0] in module_of else COMMANDS
    parser.add_commands(modules, shows_all="--help-all" in words or words[:1] == ["commands"])
    words = ["--help" if word == "--help-all" else word for word in words]
    if not words or words[0] not in parser.commands:
        parser.parse_args(words or ["--help"])  # prints help, the version or what is wrong; exits
    command = parser.commands[words[0]]
    for before, word in itertools.pairwise(words):
        if not word or re.fullmatch("--[a-z-]+=", word):  # as a path it would be the current folder
            command.error(f"what follows '{word or before}' is empty: is a shell variable unset?")
    options, unknown = command.parse_known_intermixed_args(words[1:])
    if unknown:
        near = suggest(unknown[0].partition("=")[0], command.flags)
        command.error(f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip(". "))
    if overrides and not options.takes_overrides:
        raise StageError(f"'{words[0]}' takes no stage options", found=overrides[0].flag)
    options.command, options.arguments = words[0], list(arguments)
    options.overrides, options.is_program = overrides, is_program
    return options


class Parser(argparse.ArgumentParser):
    """Suggest similar choices, list commands and arguments, and keep help to one screen."""

    def __init__(self, **settings: Any) -> None:
        #: The arguments, in the order of their declaration, and which may be repeated.
        self.arguments: list[argparse.Action] = []
        self.repeatable: list[argparse.Action] = []
        #: Arguments that help shows only where all are to be shown.
        self.rare: Sequence[str] = ()
        self.shows_all = False
        self.commands: dict[str, Parser] = {}
        one_screen = partial(argparse.HelpFormatter, max_help_position=24)
        super().__init__(formatter_class=one_screen, **settings)

    def add_argument(self, *flags: Any, **declared: Any) -> Any:
        """Add an argument, and list it."""
        return self._list(super().add_argument(*flags, **declared), declared)

    def adder_to(self, group: Any) -> Callable:
        """Return the function that adds arguments to a group of this parser, and lists them."""
        return lambda *flags, **declared: self._list(
            group.add_argument(*flags, **declared), declared
        )

    def _list(self, action: argparse.Action, declared: JsonObject) -> argparse.Action:
        self.arguments.append(action)
        if declared.get("action") == "append" or action.nargs in ("+", "*"):
            self.repeatable.append(action)
        if action.dest in self.rare and not self.shows_all:
            action.help = argparse.SUPPRESS
        needed = [a for a in self.arguments if a.required or not a.option_strings]
        shown = map(_usage_of, sorted(needed, key=lambda a: not a.option_strings))
        self.usage = " ".join(["%(prog)s [options]", *shown])
        return action

    @property
    def flags(self) -> list[str]:
        """All flags, as they are written."""
        return [flag for action in self.arguments for flag in action.option_strings]

    def format_help(self) -> str:
        """Return what ``--help`` prints."""
        hides = self.rare and not self.shows_all
        return super().format_help() + "\n--help-all shows all options.\n" * bool(hides)

    def error(self, message: str) -> NoReturn:
        """Print usage and a message with the nearest choice, and exit."""
        if choice := _INVALID_CHOICE.search(message):
            message += f". {suggest(choice[1], _WORD.findall(choice[2]))}".rstrip(". ")
        super().error(message)

    def add_commands(self, modules: Iterable[str], shows_all: bool) -> None:
        """Add the commands of modules of this room; where all is shown, with rare arguments."""
        self.shows_all = shows_all
        self._adding = self.add_subparsers(
            prog=self.prog, dest="command", required=True, metavar="COMMAND"
        )
        self.usage = "%(prog)s [options] COMMAND ..."
        for module in modules:
            importlib.import_module(f".{module}", __package__).add_commands(self)

    def command(
        self,
        name: str,
        run: Callable[[argparse.Namespace], int | None],
        help: str,
        *,
        overrides: bool = False,
        progress: bool = False,
        rare: Sequence[str] = (),
    ) -> Callable:
        """Add a command; return the function that adds its arguments.

        Parameters
        ----------
        name, run, help : str, callable, str
            `run` is called with the parsed arguments and returns the exit code, or None for 0.
        overrides : bool
            Whether it takes options of stages, ``--filters.name.option=value``.
        progress : bool
            Whether it has the flag ``--progress``.
        rare : sequence of str
            Arguments that only ``--help-all`` shows.
        """
        parser = self.commands[name] = self._adding.add_parser(
            name, help=help, description=f"{help}.", epilog=OVERRIDES if overrides else None
        )
        parser.set_defaults(run=run, takes_overrides=overrides)
        parser.rare = [*rare, *(("progress",) if progress else ())]
        parser.shows_all = self.shows_all
        if progress:
            both_ways = argparse.BooleanOptionalAction
            parser.add_argument("--progress", action=both_ways, help="Show progress")
        return parser.add_argument


def _usage_of(action: argparse.Action) -> str:
    """Return a required argument as usage shows it."""
    value = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    shown = " ".join([*action.option_strings[:1], str(value)])
    many = {"+": f"{shown} [{value} ...]", "*": f"[{shown} ...]", "?": f"[{shown}]"}
    return many.get(str(action.nargs), shown)


def add_stage_options(add: Callable, stage: str, *names: str) -> None:
    """Add flags for options of a stage, with their declared help and defaults."""
    from ..stages.registry import stage_type

    types = {"integer": int, "number": float}
    for option in stage_type(stage).all_options():
        if option.name not in names:
            continue
        default, choices = option.shown_default.replace(",", ", "), option.choices or None
        help = (option.help + f" (default: {default})" * bool(default)).replace("%", "%%")
        wide = choices is not None and len(", ".join(choices)) > _CHOICES_WIDTH
        help += f" (one of: {', '.join(choices)})" if choices and wide else ""
        add(
            f"--{option.name.replace('_', '-')}",
            type=types.get(option.kind),
            choices=choices,
            help=help,
            metavar=None if choices and not wide else option.name.split("_")[-1].upper(),
        )


def stage_options(options: argparse.Namespace, *names: str) -> JsonObject:
    """Return the options of a stage that were set by flags of :func:`add_stage_options`."""
    return {name: value for name in names if (value := getattr(options, name)) is not None}
