"""Output files appear whole or not at all: written beside, then renamed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from .errors import StageError


def partial_name(path: str | os.PathLike) -> Path:
    """A hidden name beside `path`, unique to this process, with the same suffix.

    Writers choose their format by the suffix, so it stays.
    """
    path = Path(path)
    return path.with_name(f".{path.stem}.partial-{os.getpid()}{path.suffix}")


def check_writable(path: str | os.PathLike, what: str = "output") -> None:
    """Refuse an output path whose folder is missing or read-only, before any work is done."""
    folder = Path(path).absolute().parent
    if not folder.is_dir():
        raise StageError(
            f"the folder of the {what} file does not exist", found=str(folder), cure="Create it first"
        )
    if Path(path).is_dir():
        raise StageError(f"the {what} file names a folder", found=str(path), cure="Give a file name")
    if not os.access(folder, os.W_OK):
        raise StageError(f"the folder of the {what} file cannot be written to", found=str(folder))


def write_whole(path: str | os.PathLike, content: bytes) -> None:
    """Write a file so that it is either complete or absent.

    Raises
    ------
    StageError
        If it cannot be written; nothing is left under the final name.
    """
    path = Path(path)
    check_writable(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.absolute().parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise StageError(
            "the file could not be written", found=f"{path}: {error.strerror or error}"
        ) from error
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
