"""The command ``pdal-stages``, with flags like PDAL's; a module for each group of commands."""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import gc
import itertools
import os
import sys
from collections.abc import Sequence
from typing import Any

from ..base.errors import StageError
from ..base.messages import PlainStream, print_messages
from .parser import parse

#: Imports alone create so many objects that Python would collect garbage over and over.
_OBJECTS_BETWEEN_COLLECTIONS = 300_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0 fine, 1 an error, 2 wrong usage, 130 interrupted."""
    arguments = _protect_names(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("PDAL_STAGES_DEBUG", "") not in ("", "0")
    arguments = [word for word in arguments if word != "--debug"]
    is_program = argv is None
    if is_program:
        _tune_process()
    streams = sys.stdout, sys.stderr
    for stream in streams:
        with contextlib.suppress(AttributeError, ValueError):  # a notebook's stream cannot
            # Characters that the locale lacks are escaped; messages and results keep their order in
            # a file as well.
            text: Any = stream
            text.reconfigure(errors="backslashreplace", line_buffering=True)
    sys.stdout, sys.stderr = map(PlainStream, streams)  # type: ignore[assignment]
    progress_before = os.environ.get("PDAL_STAGES_PROGRESS")
    try:
        options = parse(arguments, is_program)
        if getattr(options, "progress", None) is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = str(int(options.progress))
        code = int(options.run(options) or 0)
        sys.stdout.flush()  # a full disk or a closed pipe shows here, not at exit
        return code
    except BrokenPipeError:  # e.g. into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        print_messages("interrupted; no partial output was left")
        return 130
    except Exception as error:
        if debug:
            raise
        print_messages(str(error if isinstance(error, StageError) else _explain(error)))
        return 1
    finally:
        sys.stdout, sys.stderr = streams
        os.environ.pop("PDAL_STAGES_PROGRESS", None)
        if progress_before is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = progress_before


def _tune_process() -> None:
    """Set up a process that runs for one command alone."""
    faulthandler.enable()  # a crash inside PDAL, as of damaged COPC points, tells where it was
    # OpenBLAS's threads spin while waiting and gain almost nothing.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    atexit.register(gc.freeze)  # there is nothing to collect when the process ends


def _protect_names(arguments: Sequence[str]) -> list[str]:
    """Return the arguments without ``--``, and names with a dash after it as ``./-name``."""
    before = list(itertools.takewhile(lambda word: word != "--", arguments))
    after = arguments[len(before) + 1 :]
    return before + [f"./{word}" if word.startswith("-") else word for word in after]


def _explain(error: Exception) -> StageError:
    """Return an unforeseen error as a message of one paragraph."""
    if isinstance(error, MemoryError):
        return StageError("memory ran out", cure="Take fewer points, or work in tiles (--tile)")
    if isinstance(error, UnicodeEncodeError):
        name, cure = ascii(error.object), "Set PYTHONUTF8=1"
        return StageError("a name cannot be written in this locale", found=name, cure=cure)
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename is not None else ""
        return StageError("the system refused", found=f"{name}{error.strerror or error}")
    if isinstance(error, ImportError):
        reason = f"{sys.executable}: {(str(error).strip() or repr(error)).splitlines()[0]}"
        cure = (
            "Install pdal-stages with its packages into one environment, e.g. with conda; packages "
            "built for another NumPy or Python must be installed again"
        )
        return StageError("a Python package cannot be imported", found=reason, cure=cure)
    what = f"internal error: {type(error).__name__}: {error}"
    return StageError(what, cure="Run with --debug and report what it prints")
