"""Arrays that a run keeps in files: written whole, by the run that goes on alone, and not believed where cut or changed."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from .store import check_run

#: The member of a file that lists the others.
_NAMES = "names"


def save_arrays(path: str | Path, arrays: Mapping[str, NDArray], scratch: str) -> None:
    """Write arrays into a file; `scratch`: see :func:`.store.check_run`."""
    made = whole_files(path, what="result", check=lambda *_: check_run(scratch))
    with made as (partial,), open(partial, "wb") as file:
        np.savez(file, **arrays, **{_NAMES: np.array(sorted(arrays))})  # type: ignore[arg-type]


def members(file: np.lib.npyio.NpzFile) -> list[str]:
    """The names of a file's arrays; ValueError where they are not those that were written."""
    found = [name for name in file.files if name != _NAMES]
    if sorted(found) != file[_NAMES].tolist():
        raise ValueError("its members have other names")
    return found


def load_arrays(path: str | Path, only: Collection[str] | None = None) -> dict[str, NDArray]:
    """The arrays of a file, or `only` some as far as they are there.

    A file that cannot be read is removed, so that a later run makes it anew.
    """
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            return {name: file[name] for name in members(file) if only is None or name in only}
    except FileNotFoundError:
        raise StageError(
            "what the first round left of a tile is not there any more",
            found=str(path),
            cure="Run it again with --resume",
        ) from None
    except Exception as error:  # zipfile and numpy raise many types
        if isinstance(error, MemoryError):
            raise
        if os.path.exists(path):
            os.unlink(path)
        raise StageError(
            "what the first round left of a tile cannot be read back, and was removed",
            found=f"{path}: {error}",
            cure="Run it again with --resume",
        ) from error
