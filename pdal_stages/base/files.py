"""Output files appear whole or not at all: written beside, then renamed."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from .errors import StageError
from .las import is_short


def partial_name(path: str | os.PathLike) -> Path:
    """A hidden name beside `path`, unique to this process, with the same suffix.

    Writers choose their format by the suffix, so it stays.
    """
    path = Path(path)
    tail = f".partial-{os.getpid()}{path.suffix}"
    stem = path.stem
    while len(f".{stem}{tail}".encode(errors="surrogateescape")) > _LONGEST_NAME and "#" not in stem[-1:]:
        stem = stem[:-1]
    return path.with_name(f".{stem}{tail}")


#: Bytes a file's name may have, on every usual file system.
_LONGEST_NAME = 255


def check_complete(path: str | os.PathLike, name: str | os.PathLike) -> None:
    """Refuse a file that a writer could not finish: PDAL's do not notice that a disk is full.

    Parameters
    ----------
    path : path
        The file as it was written.
    name : path
        The name it is to get, for the message.

    Raises
    ------
    StageError
        If a LAS or LAZ file is shorter than its header says, or no space is left beside the file.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        short = is_short(path, size) if path.suffix.lower() in (".las", ".laz") else None
        full = short is None and disk_is_full(path)
    except OSError as error:
        raise StageError("the output file cannot be read back", found=f"{name}: {error}") from error
    if short or full:
        raise StageError(
            "the output file could not be written completely",
            found=f"{name}: {size:,} bytes were written",
            cure="Make room on the disk (or raise the limit on file sizes)",
        )


def disk_is_full(path: str | os.PathLike) -> bool:
    """Whether no room is left where a file is; False where the system does not say."""
    try:
        return hasattr(os, "statvfs") and os.statvfs(path).f_bavail == 0
    except OSError:
        return False


def check_writable(path: str | os.PathLike, what: str = "output") -> None:
    """Refuse an output path whose folder is missing or read-only, before any work is done."""
    folder = Path(path).absolute().parent
    if len(Path(path).name.encode(errors="surrogateescape")) > _LONGEST_NAME:
        raise StageError(f"the name of the {what} file is longer than {_LONGEST_NAME} bytes", found=str(path))
    if not folder.is_dir():
        cure = "Create it first"
        if not str(folder).isascii() and sys.getfilesystemencoding() != "utf-8":
            cure = f"Set PYTHONUTF8=1: this locale's file names are {sys.getfilesystemencoding()}"
        raise StageError(f"the folder of the {what} file does not exist", found=str(folder), cure=cure)
    if Path(path).is_dir():
        raise StageError(f"the {what} file names a folder", found=str(path), cure="Give a file name")
    if not os.access(folder, os.W_OK):
        raise StageError(f"the folder of the {what} file cannot be written to", found=str(folder))


def write_whole(path: str | os.PathLike, content: bytes) -> Path:
    """Write a file so that it is either complete or absent; its path.

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
    return path


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
