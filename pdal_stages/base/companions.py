"""Files beside an output that other programs take for a part of it.

A journal is written back into the database that it lies beside, an index or a statistic is believed
for any file of its name: what belonged to a replaced file must not remain beside the new one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

_RASTER = (".ovr", ".aux.xml", ".msk", ".msk.ovr")
#: By the ending of a file's name: what is appended to the whole name of a companion.
_APPENDED: dict[str, tuple[str, ...]] = {
    ".gpkg": ("-wal", "-shm", "-journal", ".aux.xml"),
    ".shp": (".aux.xml",),
    **dict.fromkeys((".tif", ".tiff", ".img", ".asc", ".vrt", ".png", ".jpg"), _RASTER),
}
#: By the ending of a file's name: what takes the place of that ending.
_INSTEAD: dict[str, tuple[str, ...]] = {
    ".shp": (
        *(".shx", ".dbf", ".prj", ".cpg", ".qpj", ".qix", ".sbn", ".sbx", ".fbn", ".fbx"),
        *(".ain", ".aih", ".ixs", ".mxs", ".idm", ".ind"),
    ),
    ".tif": (".tfw", ".aux", ".rrd"),
    ".tiff": (".tfw", ".aux", ".rrd"),
    ".las": (".lax",),  # LAStools' spatial index
    ".laz": (".lax",),
}
#: How a database of SQLite begins, such as a GeoPackage.
_SQLITE = b"SQLite format 3\0"
#: First byte and number of the bytes that SQLite locks.
_LOCKED_BYTES = 0x40000000, 512


def companions_of(path: str | os.PathLike) -> Iterator[Path]:
    """Yield the companions that exist beside a file, whether it exists or not.

    Those of the file that a link leads to are companions, too.
    """
    seen: set[Path] = set()
    for file in (Path(os.path.abspath(path)), Path(os.path.realpath(path))):
        suffix = file.suffix.lower()
        names = [file.name + more for more in _APPENDED.get(suffix, ())]
        for ending in _INSTEAD.get(suffix, ()):
            names += [file.stem + ending, file.stem + ending.upper()]
        for beside in map(file.with_name, names):
            if beside not in seen and os.path.lexists(beside) and not beside.is_dir():
                seen.add(beside)
                yield beside


def remove_companions(paths: Iterable[str | os.PathLike]) -> None:
    """Remove companions of files that are about to be replaced, but those that are among them."""
    targets = [*paths]
    kept = {os.path.realpath(path) for path in targets}
    for path in targets:
        for beside in companions_of(path):
            if os.path.realpath(beside) not in kept:
                beside.unlink()


def is_open_database(path: str | os.PathLike) -> bool:
    """Return whether another process has a database of SQLite open.

    One that only read it, without a write-ahead log, holds no lock while it is idle, and is not
    recognized.
    """
    try:
        import fcntl

        with open(path, "r+b") as file:
            if file.read(len(_SQLITE)) != _SQLITE:
                return False
            first, count = _LOCKED_BYTES
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, count, first)
    except BlockingIOError:
        return True
    except (ImportError, OSError):  # Windows replaces no open file; file systems without locks
        return False
    return False
