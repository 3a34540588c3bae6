"""Model files for whoever applies them: a shipped model's name or a path."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache
from pathlib import Path

from ..base.errors import ModelError, suggest
from ..classifier import Model
from ..classifier import load_model as read_model
from ..classifier.modelfile import find, shipped


def load_model(path: str | os.PathLike) -> Model:
    """Read a model file, or a shipped model by its name. Nothing in it is executed or believed unchecked.

    Raises
    ------
    ModelError
        The file is missing, damaged, of a newer version, not what it says, or asks for what no model may ask for.
    """
    name = os.fspath(path)
    try:
        return read_model(find(name))
    except ModelError as error:
        if not os.path.lexists(name):
            error.cure = f"{suggest(name, shipped())}{error.cure}"
        raise


def digest_of(path: str) -> str:
    """SHA-256 of a model file, or of a shipped model by its name."""
    return hashlib.sha256(Path(find(path)).read_bytes()).hexdigest()


def loaded_model(path: str) -> Model:
    """The same, read once per process as long as the file stays the same."""
    path = find(path)
    try:
        stat = Path(path).stat()
        stamp = (stat.st_mtime_ns, stat.st_size)
    except (OSError, ValueError):  # the latter for a name that holds a null
        return load_model(path)  # says what is wrong
    return _load(path, stamp)


@lru_cache(maxsize=4)
def _load(path: str, stamp: tuple[int, int]) -> Model:
    return load_model(path)
