"""Temporary folders of a tile's work."""

from __future__ import annotations

import contextlib
import shutil
import tempfile


@contextlib.contextmanager
def scratch(folder: str):
    """A temporary folder that is gone afterwards."""
    made = tempfile.mkdtemp(prefix="tile-", dir=folder)
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)
