"""Commands about pipelines: run, check, or expand one for PDAL."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.errors import StageError
from ..base.files import JSON, Output, check_outputs, write_json, write_whole
from ..base.messages import Message, print_messages
from .parser import Parser
from .tiled_runs import (
    add_tile_options,
    end_at_ctrl_c,
    end_run,
    print_plan,
    print_run,
    requests_tiles,
    run_files,
    run_until_interrupted,
    tiling_options,
)

if TYPE_CHECKING:
    from ..pipeline.run import Pipeline

#: Lines of PDAL's log that are shown without -v.
_LOG_LINES = 10
_LEVELS = {0: logging.ERROR, 1: logging.WARNING, 2: logging.INFO}


def add_commands(parser: Parser) -> None:
    """Add ``pipeline``, ``expand`` and ``validate``."""
    help = "Run a PDAL pipeline, with our stages or without"
    rare = ("file_option", "nostream", "verbose", "scheduler", "per", "buffer")
    add = parser.command("pipeline", _pipeline, help, overrides=True, progress=True, rare=rare)
    _input(add)
    add("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add("--validate", action="store_true", help="Check without reading points, then stop")
    add("--nostream", action="store_true", help="Accepted as in PDAL; our stages never stream")
    levels = "PDAL's log: 1 warnings (default), 2 what it does, 3 everything"
    add("-v", "--verbose", type=int, default=1, metavar="LEVEL", help=levels)
    add_tile_options(parser.commands["pipeline"])

    help = "Print a pipeline as plain PDAL JSON, for stock 'pdal pipeline'"
    add = parser.command("expand", _expand, help, overrides=True)
    _input(add)
    add("-o", "--output", metavar="FILE", help="Write to a file, not to standard output")

    help = "Check a pipeline without reading points"
    _input(parser.command("validate", _validate, help, overrides=True))


def _input(add: Callable) -> None:
    """Add the arguments that name a pipeline."""
    add("file", nargs="?", help="Pipeline JSON file")
    add("-i", "--input", dest="file_option", metavar="FILE", help="The same file, as in PDAL")
    add("-s", "--stdin", action="store_true", help="Read the pipeline from standard input")


def _build(options: argparse.Namespace) -> Pipeline:
    """Return the pipeline of a file or of standard input, with its overrides."""
    from ..pipeline.json_source import decode, parse_pipeline
    from ..pipeline.run import Pipeline

    source: Any = Path(options.file or options.file_option or "")
    if options.stdin:
        raw = getattr(sys.stdin, "buffer", None)
        text = decode(raw.read(), "standard input") if raw is not None else sys.stdin.read()
        source = parse_pipeline(text, "standard input")
    elif not source.name:
        usage = f"Usage: pdal-stages {options.command} job.json"
        raise StageError("no pipeline file was given", cure=usage)
    return Pipeline(source, options.overrides)


def _pipeline(options: argparse.Namespace) -> int:
    """Run a pipeline in one piece or in tiles; return the exit code."""
    if requests_tiles(options):
        return _run_tiles(options)
    if options.validate:
        return _validate(options)
    pipeline = _build(options)
    pipeline.check_outputs(*run_files(options))
    before = list(pipeline.expanded.warnings)
    print_messages(*before)
    end_at_ctrl_c(options.is_program)
    pipeline.execute(arrays=False, loglevel=_LEVELS.get(options.verbose, logging.DEBUG))
    # Warnings, and what PDAL calls an error although it goes on: a reader that sets what it cannot
    # read to 0, say.
    lines = pipeline.log_messages
    if options.verbose < 2 and len(lines) > _LOG_LINES:
        more = Message(f"PDAL says {len(lines) - _LOG_LINES:,} more lines; -v 2 shows them")
        lines = [*lines[:_LOG_LINES], more]
    print_messages(*lines)
    if options.metadata:
        write_json(options.metadata, pipeline.metadata, indent=2)
    print_messages(*(line for line in pipeline.messages if line not in before))
    return 0


def _run_tiles(options: argparse.Namespace) -> int:
    """Run a pipeline in tiles; return the exit code."""
    from ..pipeline.inputs_outputs import writers_outputs
    from ..tiling.plan import make_plan
    from ..tiling.tiled_run import run_tiled

    tiling, files = tiling_options(options), run_files(options)
    pipeline = _build(options)
    if options.validate:
        make_plan(pipeline, tiling.buffer)
        print(pipeline.validate())
        return 0
    # In names of tiled runs '#' stands for names, not for numbers; folders may not be there yet.
    outputs = [
        output
        for output in writers_outputs(pipeline.expanded.stages)
        if "#" not in output.path and Path(output.path).parent.is_dir()
    ]
    check_outputs([*outputs, *files], pipeline.inputs())
    run, interrupted = run_until_interrupted(
        lambda: run_tiled(pipeline, tiling, dry_run=options.dry_run)
    )
    print_plan(run) if options.dry_run else print_run(run)
    return end_run(files, run, "run it again with --resume" if interrupted else "")


def _expand(options: argparse.Namespace) -> None:
    """Print or write the expanded pipeline."""
    pipeline = _build(options)
    text = pipeline.json + "\n"
    if options.output:
        check_outputs([Output(options.output, "output", JSON)], pipeline.inputs())
        write_whole(options.output, text.encode())
    else:
        sys.stdout.write(text)


def _validate(options: argparse.Namespace) -> int:
    """Print PDAL's verdict or ours as JSON; an error goes to standard error, too."""
    try:
        pipeline = _build(options)
        print(pipeline.validate())
        print_messages(*pipeline.expanded.warnings)
        return 0
    except StageError as error:
        verdict = {"valid": False, "error_detail": str(error), "streamable": False}
        print(json.dumps(verdict, indent=2))
        print_messages(str(error))
        return 1
