"""Run a pipeline for a command, and say what PDAL and stages say."""

from __future__ import annotations

import argparse
import json
import logging

from ..base import kinds
from ..base.outputs import Output
from ..base.plain import print_messages

#: Lines of PDAL's log that are shown without -v.
_LOG_LINES = 10
_LEVELS = {0: logging.ERROR, 1: logging.WARNING, 2: logging.INFO}


def run(options: argparse.Namespace, pipeline) -> int:
    """Run a pipeline and print its messages; the number of points."""
    count, messages = ran(options, pipeline)
    print_messages(*messages)
    return count


def ran(options: argparse.Namespace, pipeline) -> tuple[int, list[str]]:
    """Run a pipeline: the number of points, and messages."""
    from ..base.files import write_whole
    from ..tiling.command import end_at_once

    metadata, verbose = getattr(options, "metadata", None), getattr(options, "verbose", 1)
    more = [Output(options.log, "log")] if getattr(options, "log", None) else []
    pipeline.check_outputs(*more, *([Output(metadata, "metadata", kinds.JSON)] if metadata else []))
    before = list(pipeline.lowered.warnings)
    print_messages(*before)
    end_at_once(options)
    count = pipeline.execute(arrays=False, loglevel=_LEVELS.get(verbose, logging.DEBUG))
    # Warnings, and what PDAL calls an error although it goes on: a reader that sets what it cannot read to 0, say.
    lines = pipeline.log_lines
    messages = [f"PDAL says: {line}" for line in (lines if verbose > 1 else lines[:_LOG_LINES])]
    if len(lines) > _LOG_LINES and verbose <= 1:
        messages.append(f"PDAL says {len(lines) - _LOG_LINES:,} more lines; -v shows them")
    if metadata:
        write_whole(metadata, (json.dumps(pipeline.metadata, indent=2, default=str) + "\n").encode())
    return count, messages + [line for line in pipeline.messages if line not in before]
