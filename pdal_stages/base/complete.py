"""Whether a file just written holds all its points: PDAL's writers do not notice that a disk is full."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import StageError
from .files import disk_is_full
from .las import read_header
from .lascheck import check_readable

_LAS = ("writers.las", "writers.copc")


def check_complete(
    path: str | os.PathLike, name: str | os.PathLike, writer: Mapping[str, Any], count: int | None = None
) -> bool:
    """Refuse a file that a writer could not finish.

    LAS and LAZ files are held against their own headers and the points there were; of other formats it is only known
    that they are not empty, and that disk and limits left room.

    Parameters
    ----------
    path : path
        The file as it was written.
    name : path
        The name it is to get, for the message.
    writer : mapping
        The stage that wrote it.
    count : int, optional
        The points it must hold, where that is known.

    Returns
    -------
    bool
        Whether it could be judged by its content.

    Raises
    ------
    StageError
        If it is not whole.
    """
    path = Path(path)
    las = writer.get("type") in _LAS or path.suffix.lower() in (".las", ".laz")
    try:
        size = path.stat().st_size
        with open(path, "rb+") as file:
            os.fsync(file.fileno())  # some file systems report a full disk only here
        whole = _las_is_whole(path, size, count) if las else not disk_is_full(path) and size < _largest()
    except OSError as error:
        raise StageError("the output file cannot be read back", found=f"{name}: {error}") from error
    if not whole:
        raise StageError(
            "the output file could not be written completely",
            found=f"{name}: {size:,} bytes were written",
            cure="Make room on the disk (or raise the limit on file sizes)",
        )
    return las


def _largest() -> float:
    """Bytes that a file of this process may have."""
    try:
        import resource
    except ImportError:  # Windows
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def _las_is_whole(path: Path, size: int, count: int | None) -> bool:
    header = read_header(path)
    if header is None:
        return False
    try:
        check_readable(path)
    except StageError:
        return False
    # The count is written last: none of it, but points and no records after them, means the header was never updated.
    if not header.count and not header.records_after and size >= header.offset + header.point_bytes:
        return header.compressed
    return count is None or header.count == count
