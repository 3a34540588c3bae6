"""The command ``pdal-stages``, with flags like PDAL's; a module for each group of commands."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import gc
import importlib
import itertools
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from ..base.errors import StageError, suggest
from ..base.files import Output, check_outputs
from ..base.messages import PlainStream, print_messages
from ..base.run_log import LoggedStream, RunLog
from ..base.version import __version__
from .watcher import watched

#: Modules and their commands. Only the module of the command is imported, or all for ``commands``.
_COMMANDS = {
    "classify": ("classify",),
    "extras": ("objects", "review", "corrections"),
    "models": ("models", "train", "adapt", "accuracy", "model"),
    "pipelines": ("pipeline", "expand", "validate"),
    "installation": ("drivers", "options", "doctor", "plugin", "demo", "warmup"),
}
OVERRIDES = "Stages take options as in PDAL: --stage.TAG.option=V, --filters.name.option=V"
INPUTS = "Files, folders, patterns, tile indexes, EPT sources"
_NO_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")
_WORD = re.compile(r"[\w-]+")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 fine, 1 an error, 2 wrong usage, 130 interrupted)."""
    arguments = _protected(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("PDAL_STAGES_DEBUG", "") not in ("", "0")
    arguments = [word for word in arguments if word != "--debug"]
    ended = watched(arguments) if argv is None else lambda: None
    if argv is None:
        # OpenBLAS's threads spin while waiting and gain almost nothing.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        gc.set_threshold(
            300_000
        )  # imports alone create so many objects that Python collects over and over
        atexit.register(gc.freeze)  # nor is there anything to collect when the process ends
    streams = sys.stdout, sys.stderr
    for (
        stream
    ) in streams:  # characters that the locale lacks are escaped, rather than ending the run
        with contextlib.suppress(AttributeError, ValueError):  # a notebook's stream cannot
            # Line by line, so that messages and results keep their order in a file as well.
            stream.reconfigure(errors="backslashreplace", line_buffering=True)  # type: ignore[union-attr]
    sys.stdout, sys.stderr = map(PlainStream, streams)  # type: ignore[assignment]
    log: RunLog | None = None
    shown = os.environ.get("PDAL_STAGES_PROGRESS")
    code = 1
    try:
        _refuse_little_room()
        options = parsed(arguments, is_program=argv is None)
        if getattr(options, "progress", None) is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = str(int(options.progress))
        if getattr(options, "log", None):
            check_outputs([Output(options.log, "log", "a log")], _named(options))
            log = RunLog(options.log, arguments, sys.stderr)
            sys.stdout, sys.stderr = LoggedStream(sys.stdout, log), LoggedStream(sys.stderr, log)  # type: ignore[assignment]
        code = int(options.run(options) or 0)
        sys.stdout.flush()  # a full disk or a closed pipe shows here, not at exit
    except BrokenPipeError:  # e.g. into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        code = 0
    except KeyboardInterrupt:
        code = 130
        print_messages("interrupted; nothing half-written was left")
    except Exception as error:
        code = 1
        if debug:
            raise
        print_messages(str(error if isinstance(error, StageError) else _unforeseen(error)))
    finally:
        ended()
        if log is not None:
            log.end(code)
        sys.stdout, sys.stderr = streams
        os.environ.pop("PDAL_STAGES_PROGRESS", None)
        if shown is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = shown
    return code


def _named(options: argparse.Namespace) -> list[str]:
    """Return the words of a command that may be files, but for the log."""
    given = [value for name, value in vars(options).items() if name not in ("log", "arguments")]
    words = [value if isinstance(value, list) else [value] for value in given]
    return [word for word in itertools.chain(*words) if isinstance(word, str)]


def _protected(arguments: Sequence[str]) -> list[str]:
    """Return the arguments without ``--``, after which a name with a leading dash becomes ``./-name``."""
    before = list(itertools.takewhile(lambda word: word != "--", arguments))
    after = arguments[len(before) + 1 :]
    return before + [f"./{word}" if word.startswith("-") else word for word in after]


def parsed(arguments: Sequence[str], is_program: bool) -> argparse.Namespace:
    """The command, its arguments, and options of stages among them; exits where usage is wrong."""
    # Imported here, so that a missing package is reported in one sentence.
    from ..pipeline.overrides import parse_overrides

    overrides, rest = parse_overrides(arguments)
    parser = Parser(
        prog="pdal-stages",
        description="Classify airborne laser scans, alone or in PDAL pipelines.",
        epilog="Help on a command: pdal-stages COMMAND --help. With --debug errors show tracebacks.",
    )
    parser.add_argument("--version", action="version", version=f"pdal-stages {__version__}")
    of_command = {name: module for module, names in _COMMANDS.items() for name in names}
    asked = of_command.get(rest[0]) if rest else None
    for module in [asked] if asked else _COMMANDS:
        importlib.import_module(f".{module}", __name__).add_commands(parser)
    if "--help-all" in rest:
        rest = ["--help" if word == "--help-all" else word for word in rest]
        for one in parser.commands.values():
            one.rare = ()
    if not rest or rest[0] not in parser.commands:
        parser.parse_args(rest or ["--help"])  # help, the version or what is wrong, and the end
    command, *rest = rest
    for before, word in itertools.pairwise([command, *rest]):
        if not word or re.fullmatch("--[a-z-]+=", word):  # as a path it would be the current folder
            lacking = f"what follows '{word or before}' is empty: is a shell variable unset?"
            parser.commands[command].error(lacking)
    options, unknown = parser.commands[command].parse_known_intermixed_args(rest)
    if unknown:
        near = suggest(
            unknown[0].partition("=")[0], parser.commands[command]._option_string_actions
        )
        parser.commands[command].error(
            f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip(". ")
        )
    if overrides and not options.takes_overrides:
        raise StageError(f"'{command}' takes no stage options", found=overrides[0].flag)
    options.command = command
    options.overrides, options.arguments, options.is_program = (
        overrides,
        list(arguments),
        is_program,
    )
    return options


def _refuse_little_room() -> None:
    """Refuse a limit on addresses under which libraries crash, or wait forever for threads."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        if 0 <= (limit := resource.getrlimit(resource.RLIMIT_AS)[0]) < 2**30:
            raise StageError(
                "too little memory", found=f"ulimit -v {limit // 1024}", cure="Allow 1 GB"
            )


def _unforeseen(error: Exception) -> StageError:
    """An unforeseen error, as a message of one paragraph."""
    if isinstance(error, MemoryError):
        return StageError("memory ran out", cure="Work in tiles (--tile), or lower 'memory'")
    if isinstance(error, UnicodeEncodeError):
        found, cure = ascii(error.object), "Set PYTHONUTF8=1"
        return StageError("a name cannot be written in this locale", found=found, cure=cure)
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename is not None else ""
        return StageError("the system refused", found=f"{name}{error.strerror or error}")
    if isinstance(error, ImportError):
        said = str(error).strip() or repr(error)
        return StageError(
            "a Python package cannot be imported",
            found=f"{sys.executable}: {said.splitlines()[0]}",
            cure="Install pdal-stages with its packages into one environment, e.g. with conda; packages built for "
            "another NumPy or Python must be installed again",
        )
    return StageError(
        f"internal error: {type(error).__name__}: {error}",
        cure="Run with --debug and report what it prints",
    )


class _OneScreen(argparse.HelpFormatter):
    """Usage shows only required arguments, and ``--[no-]flag`` for both ways of a switch."""

    def _format_usage(self, usage, actions, groups, prefix):
        needed = [one for one in actions if one.required or not one.option_strings]
        return super()._format_usage(usage, needed, [], prefix)

    def _format_action_invocation(self, action):
        if isinstance(action, argparse.BooleanOptionalAction):
            return f"--[no-]{action.option_strings[0][2:]}"
        return super()._format_action_invocation(action)


class Parser(argparse.ArgumentParser):
    """Suggests similar choices, adds commands, and keeps their help to one screen."""

    #: Arguments that only ``--help-all`` shows.
    rare: Sequence[str] = ()

    def _get_formatter(self) -> _OneScreen:
        return _OneScreen(f"{self.prog} [options]", max_help_position=24)

    def format_help(self) -> str:
        """What ``--help`` prints."""
        hidden = {one: one.help for one in self._actions if one.dest in self.rare}
        for one in hidden:
            one.help = argparse.SUPPRESS
        text = super().format_help() + "\n--help-all shows all options.\n" * bool(hidden)
        for one, told in hidden.items():
            one.help = told
        return text

    def error(self, message: str) -> NoReturn:
        if chosen := _NO_CHOICE.search(message):
            message += f". {suggest(chosen[1], _WORD.findall(chosen[2]))}".rstrip(". ")
        super().error(message)

    @property
    def commands(self) -> dict[str, Parser]:
        """The commands by name."""
        if self._subparsers is None:
            self.add_subparsers(prog=self.prog, dest="command", required=True, metavar="COMMAND")
        return self._subparsers._group_actions[0].choices  # type: ignore

    def command(
        self,
        name: str,
        run: Callable[[argparse.Namespace], Any],
        help: str,
        overrides: bool = False,
        logged: bool = False,
        rare: Sequence[str] = (),
    ) -> Callable:
        """Add a command; returns a function that adds its arguments. `logged`: it has a log and progress."""
        assert self.commands is not None
        made = self._subparsers._group_actions[0].add_parser(  # type: ignore
            name, help=help, description=f"{help}.", epilog=OVERRIDES if overrides else None
        )
        made.set_defaults(run=run, takes_overrides=overrides)
        made.rare = [*rare, *(("log", "progress") if logged else ())]
        takes = made.add_argument
        if logged:
            takes("--log", metavar="FILE", help="Append everything that is printed to a log file")
            takes("--progress", action=argparse.BooleanOptionalAction, help="Show progress")
        return takes


#: Choices that take more columns stand in the help text instead of before it.
_CHOICES_WIDTH = 40


def takes_options(takes: Callable, stage: str, *names: str) -> None:
    """Add flags for options of a stage, with their declared help and defaults."""
    from ..stages.registry import stage_type

    kinds = {"integer": int, "number": float}
    for option in stage_type(stage).all_options():
        if option.name in names:
            default, choices = option.shown_default.replace(",", ", "), option.choices or None
            what = (option.help + f" (default: {default})" * bool(default)).replace("%", "%%")
            wide = choices is not None and len(", ".join(choices)) > _CHOICES_WIDTH
            value = None if choices and not wide else option.name.split("_")[-1].upper()
            what += f" (one of: {', '.join(choices)})" if choices and wide else ""
            how = {
                "type": kinds.get(option.kind),
                "choices": choices,
                "help": what,
                "metavar": value,
            }
            takes(f"--{option.name.replace('_', '-')}", **how)
