"""Model files for whoever applies them: a shipped model's name or a path, and all that a file asks for looked at."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache
from pathlib import Path

from ..base.errors import ModelError
from ..classifier import Model
from ..classifier import load_model as read_model
from ..models import find
from . import preparation

_CURE = "Training writes no such file: ask where it comes from"


def load_model(path: str | os.PathLike) -> Model:
    """Read a model file, or a shipped model by its name. Nothing in it is executed or believed unchecked.

    The stages that it wants before it (``info["preparation"]``) are of a short list, with options in bounds; see
    :func:`.preparation.check`.

    Raises
    ------
    ModelError
        The file is missing, damaged, of a newer version, not what it says, or asks for what no model may ask for.
    """
    path = find(os.fspath(path))
    model = read_model(path)
    try:
        model.info["preparation"] = preparation.check(model.info.get("preparation") or [])
    except ModelError as error:
        error.cure = _CURE
        raise error.at(path) from None
    return model


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
