"""Run a pipeline, check it, or print it as PDAL runs it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..base import kinds
from ..base.errors import StageError
from ..base.outputs import Output, check_outputs
from ..base.plain import print_messages
from ..tiling.command import add_arguments
from .adder import Adder
from .running import run

if TYPE_CHECKING:
    from ..pipeline.read import PipelineSource


def add_commands(add: Adder) -> None:
    """``pipeline``, ``expand`` and ``validate``."""
    takes = add("pipeline", _pipeline, "Run a pipeline that may contain our stages", overrides=True)
    _input(takes)
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    takes("--validate", action="store_true", help="Check the pipeline without reading points, then stop")
    takes(
        "--nostream",
        action="store_true",
        help="Accepted for compatibility with PDAL; our stages never stream",
    )
    takes(
        "-v",
        "--verbose",
        type=int,
        default=1,
        metavar="LEVEL",
        help="Print more of PDAL's log: 1 warnings (default), 2 what it does (-v alone), 3 and more everything",
    )
    add_arguments(add.choices["pipeline"])

    takes = add(
        "expand", _expand, "Print the plain PDAL JSON, which stock 'pdal pipeline' runs", overrides=True
    )
    _input(takes)
    takes("-o", "--output", metavar="FILE", help="Write it to a file instead")

    takes = add("validate", _validate, "Check a pipeline without reading points", overrides=True)
    _input(takes)


def _input(takes: Callable) -> None:
    takes("file", nargs="?", help="Pipeline JSON file")
    takes("-i", "--input", dest="file_option", metavar="FILE", help="The same, as PDAL's --input")
    takes("-s", "--stdin", action="store_true", help="Read the pipeline from standard input")


def _source(options: argparse.Namespace) -> Path | PipelineSource:
    """A file's path, or what was read from standard input."""
    if options.stdin:
        from ..pipeline.read import decode, parse_pipeline

        raw = getattr(sys.stdin, "buffer", None)
        text = decode(raw.read(), "standard input") if raw is not None else sys.stdin.read()
        return parse_pipeline(text or " ", "standard input")
    name = options.file or options.file_option
    if not name:
        raise StageError("no pipeline file was given", cure=f"Usage: pdal-stages {options.command} job.json")
    return Path(name)


def _build(options: argparse.Namespace):
    from ..pipeline.run import Pipeline

    return Pipeline(_source(options), options.overrides)


def _pipeline(options: argparse.Namespace) -> int | None:
    from ..tiling.command import run_command, wants_tiles

    if wants_tiles(options):
        return run_command(options, _source(options))
    if options.validate:
        return _validate(options)
    run(options, _build(options))
    return None


def _expand(options: argparse.Namespace) -> None:
    from ..base.files import write_whole

    pipeline = _build(options)
    text = pipeline.json + "\n"
    if options.output:
        check_outputs([Output(options.output, "output", kinds.JSON)], pipeline.inputs())
        write_whole(options.output, text.encode())
    else:
        sys.stdout.write(text)


def _validate(options: argparse.Namespace) -> int:
    """Print PDAL's verdict or ours as JSON, on standard output; an error goes to standard error too."""
    try:
        pipeline = _build(options)
        print(pipeline.validate())
        print_messages(*pipeline.lowered.warnings)
    except StageError as error:
        verdict = {"valid": False, "error_detail": str(error), "streamable": False}
        print(json.dumps(verdict, indent=2))
        print_messages(str(error))
        return 1
    return 0
