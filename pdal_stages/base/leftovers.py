"""Unfinished files are removed even when the process is killed.

A signal that ends the process (SIGTERM, a crash, lack of memory) gives it no time to clean up, and while
PDAL works no Python code runs at all. So a small process waits on a pipe: when the pipe breaks before it was
told that all is well, it removes what was left.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator

#: Runs without site-packages, in about 20 ms. An answer on its input means that nothing is left to do.
_GUARD = """
import glob, json, os, sys
patterns = json.loads(sys.argv[1])
if not sys.stdin.buffer.read():
    for pattern in patterns:
        for name in glob.glob(pattern):
            try:
                os.unlink(name)
            except OSError:
                pass
    try:
        sys.stderr.write("pdal-stages: ended before it was done; nothing half-written was left\\n")
    except OSError:
        pass
"""


@contextlib.contextmanager
def removed_if_killed(patterns: Iterable[str]) -> Iterator[None]:
    """While inside, files that match `patterns` are removed should this process be killed.

    Parameters
    ----------
    patterns : iterable of str
        As for :func:`glob.glob`; escape names with :func:`glob.escape`. A hidden name must be matched with its dot.
    """
    patterns = list(patterns)
    guard = _start(patterns) if patterns else None
    try:
        yield
    finally:
        if guard is not None:
            with contextlib.suppress(OSError, subprocess.SubprocessError):
                guard.communicate(b"done", timeout=10)


def _start(patterns: list[str]) -> subprocess.Popen | None:
    """The waiting process, in a session of its own so that Ctrl-C does not reach it; None where none can start."""
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _GUARD, json.dumps(patterns)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
    except (OSError, ValueError):
        return None
