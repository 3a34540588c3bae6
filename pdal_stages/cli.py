"""The command ``pdal-stages``: thin, with PDAL's own flag habits."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from .base.errors import StageError, suggest
from .base.lean import be_lean
from .base.outputs import Output, check_outputs
from .base.plain import PlainStream, print_messages
from .base.runlog import LoggedStream, RunLog
from .base.version import __version__
from .commands.adder import OVERRIDES, Adder
from .pipeline.overrides import parse_overrides

_VERBOSE = ("-v", "--verbose")
#: Commands that run no code but ours: no stage of a user's, no notebook.
_OWN_CODE = ("classify", "objects")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 fine, 1 an error, 2 wrong usage, 130 interrupted)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("PDAL_STAGES_DEBUG", "") not in ("", "0")
    arguments = _levels([a for a in arguments if a != "--debug"])
    _print_anything()
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(PlainStream, streams)  # type: ignore[assignment]
    log: RunLog | None = None
    shown = os.environ.get("PDAL_STAGES_PROGRESS")
    code = 1
    try:
        overrides, rest = parse_overrides(arguments)
        if argv is None and rest and rest[0] in _OWN_CODE:
            be_lean()
        options, unknown = _parser().parse_known_args(rest)
        command = vars(options).pop("parser")  # it cannot travel to workers
        if unknown and not _taken(options, unknown):
            _refuse_words(command, unknown)
        if overrides and not getattr(options, "takes_overrides", False):
            raise StageError(f"'{options.command}' takes no stage options", found=overrides[0].flag)
        options.overrides, options.arguments = overrides, arguments
        options.is_program = argv is None
        if getattr(options, "progress", None) is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = "1" if options.progress else "0"
        if getattr(options, "log", None):
            check_outputs([Output(options.log, "log", "")], [])
            log = RunLog(options.log, arguments, sys.stderr)
            sys.stdout, sys.stderr = LoggedStream(sys.stdout, log), LoggedStream(sys.stderr, log)  # type: ignore[assignment]
        code = int(options.run(options) or 0)
        sys.stdout.flush()  # a full disk or a closed pipe shows here, not at exit
        return code
    except BrokenPipeError:  # e.g. into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        code = 130
        print_messages("interrupted; nothing half-written was left")
        return code
    except Exception as error:
        code = 1
        if debug:
            raise
        print_messages(str(error if isinstance(error, StageError) else _unforeseen(error)))
        return code
    finally:
        if log is not None:
            log.end(code)
        sys.stdout, sys.stderr = streams
        if shown is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = shown
        else:
            os.environ.pop("PDAL_STAGES_PROGRESS", None)


def _levels(arguments: list[str]) -> list[str]:
    """PDAL's ``-v 4``, and ``-v`` alone, in one form."""
    out: list[str] = []
    for number, word in enumerate(arguments):
        if word in _VERBOSE:
            level = arguments[number + 1] if arguments[number + 1 : number + 2] else ""
            out.append(f"--verbose={level if level.isdigit() else 2}")
        elif not (word.isdigit() and number and arguments[number - 1] in _VERBOSE):
            out.append(word)
    return out


def _print_anything() -> None:
    """A locale that lacks a character shows its code, rather than ending the run."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):  # a notebook's stream cannot
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _unforeseen(error: Exception) -> StageError:
    """An unforeseen error, as a message of one paragraph."""
    if isinstance(error, MemoryError):
        return StageError("memory ran out", cure="Work in tiles (--tile), or lower 'memory'")
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename is not None else ""
        return StageError("the system refused", found=f"{name}{error.strerror or error}")
    if isinstance(error, ImportError):
        return StageError(
            "a Python package cannot be imported",
            found=f"{sys.executable}: {str(error).strip().splitlines()[0] if str(error).strip() else error!r}",
            cure="Install pdal-stages with its packages into one environment, e.g. with conda; packages built for "
            "another NumPy or Python must be installed again",
        )
    return StageError(
        f"internal error: {type(error).__name__}: {error}", cure="Run with --debug and report what it prints"
    )


def _taken(options: argparse.Namespace, words: list[str]) -> bool:
    """Whether words left over are names of inputs, and of the output, behind a flag, where argparse does not look."""
    inputs = getattr(options, "inputs", None)
    if not isinstance(inputs, list) or any(word.startswith("-") for word in words):
        return False
    if hasattr(options, "output"):
        *inputs[len(inputs) :], options.output = [options.output, *words]
    else:
        inputs += words
    return True


def _refuse_words(command: argparse.ArgumentParser, unknown: list[str]) -> None:
    """Leave with the command's usage and the flag that may have been meant."""
    flags = re.findall(r"(?<!\S)--[\w-]+(?![\w.-])", command.format_help())
    near = suggest(unknown[0].partition("=")[0], flags)
    command.error(f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip(". "))


class _Parser(argparse.ArgumentParser):
    """Says which of the choices may have been meant."""

    def error(self, message: str) -> NoReturn:
        if chosen := _NO_CHOICE.search(message):
            message += f". {suggest(chosen[1], re.findall(r'[a-z_-]+', chosen[2]))}".rstrip(". ")
        super().error(message)


_NO_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")


def _parser() -> argparse.ArgumentParser:
    # Here, where an environment that lacks something is told in a sentence.
    from .commands import about, beginning, classifying, models, pipelines, reviewing

    parser = _Parser(
        prog="pdal-stages",
        description="PDAL pipelines with stages that classify airborne laser scans.",
        epilog=OVERRIDES + " --debug shows tracebacks.",
    )
    parser.add_argument("--version", action="version", version=f"pdal-stages {__version__}")
    add = Adder(parser)
    for group in (pipelines, about, classifying, reviewing, models, beginning):
        group.add_commands(add)
    return parser


if __name__ == "__main__":
    from pdal_stages import cli  # workers know its functions by this name

    sys.exit(cli.main())
