"""Programs that tests start and wait for."""

from __future__ import annotations

import os
import subprocess
import sys


def ended(*words, env=None, **how) -> subprocess.CompletedProcess[str]:
    """A program that has ended, with what it said; `env` is added to this process's environment."""
    how = {"capture_output": True, "text": True, "timeout": 500, **how}
    return subprocess.run([*map(str, words)], env={**os.environ, **(env or {})}, **how)


def printed(*words, **how) -> str:
    """Run a program that must succeed; return what it printed."""
    done = ended(*words, **how)
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr)
    return done.stdout


def python(code: str, **how) -> str:
    """Run Python code in a new process; return what it printed, which must have succeeded."""
    return printed(sys.executable, "-X", "faulthandler", "-c", code, **how)
