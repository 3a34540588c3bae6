"""Output files appear whole or not at all: written in a hidden folder beside their place, then renamed.

The hidden folder has a random name, only its owner may enter it, and it is locked while its writer lives. What a killed
writer left is therefore known to be dead, and goes when the next file is written to the same place.

* An existing file is replaced; the new one takes over its mode, and its owner where that may be given.
* A link is followed: the file it leads to is replaced, the link stays.
* A device, pipe or terminal (``/dev/stdout``) is written into, once all is there.
* A write-protected file, a file of another kind, a folder, a socket and a block device are refused.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .errors import StageError
from .outputs import check_writable, is_stream, kind_of, real_path

#: How the hidden folders' names begin.
PREFIX = ".pdal-stages-partial-"
#: What the system says where a file has no room, or none is left to this user.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_swept: set[str] = set()


def write_whole(path: str | os.PathLike, content: bytes, what: str = "output") -> Path:
    """Write a file so that it is either complete or absent; its path.

    Raises
    ------
    StageError
        If it cannot be written; what was there before stays.
    """
    with whole_files(path, what=what) as (partial,), open(partial, "xb") as file:
        file.write(content)
    return Path(path)


@contextlib.contextmanager
def whole_files(
    *paths: str | os.PathLike, what: str = "output", check: Callable[[Path, Path, int], None] | None = None
) -> Iterator[list[Path]]:
    """Give files to write to; on leaving, all of them get their names, or after an exception none.

    Parameters
    ----------
    *paths : path
        Where the files shall be. A name that holds '#' may become any number of files, as PDAL's writers
        number them; files that a writer makes beside its own go with it.
    what : str
        What messages call them.
    check : callable, optional
        Called with each file that was written, the name it is to get and the number of the path it belongs to,
        before any of them gets its name.

    Yields
    ------
    list of Path
        The same names in other folders. Nothing exists there yet.

    Raises
    ------
    StageError
        If a file cannot be written, or was not. Errors that come from inside name the true file, not the hidden one.
    """
    places: list[_Place] = []
    inside = False
    try:
        for path in paths:
            check_writable(path, what)
            places.append(_Place(Path(path)))
        inside = True
        yield [place.partial for place in places]
        inside = False
        moves = [(*move, number) for number, place in enumerate(places) for move in place.made()]
        for made, target, number in moves:
            check_writable(target, what, kind_of(made) or "a file of another kind")
            if check is not None:
                check(made, target, number)
        for made, target, _ in moves:
            _give_name(made, target)
    except StageError as error:
        for place in places:
            if isinstance(error.found, str):
                error.found = error.found.replace(str(place.partial), str(place.path))
            if error.cure is None and disk_is_full(place.folder):
                error.cure = f"The disk of {place.path} is full: make room"
        raise
    except OSError as error:
        named = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
        at = next((p.path for p in places if named.startswith(str(p.folder))), None)
        if inside and named and at is None:  # of something that was read
            raise
        raise StageError(
            f"the {what} file could not be written",
            found=f"{at or paths[-1]}: {error.strerror or error}",
            cure="Make room on the disk" if error.errno in NO_ROOM else None,
        ) from error
    finally:
        for place in places:
            place.close()


class _Place:
    """A hidden folder in which one output is written: `partial`, until it gets its name, `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        parent = Path(tempfile.gettempdir()) if is_stream(path) else real_path(path).parent
        if str(parent) not in _swept:
            _swept.add(str(parent))
            sweep(parent)
        self.folder, self._lock = _locked_folder(parent)
        self.partial = self.folder / path.name

    def made(self) -> list[tuple[Path, Path]]:
        """Files that were written, and the names they are to get."""
        found = sorted(self.folder.iterdir())
        if self.partial not in found and "#" not in self.path.name:
            raise StageError("the writer wrote no file", found=str(self.path))
        return [(f, self.path if f == self.partial else self.path.with_name(f.name)) for f in found]

    def close(self) -> None:
        """Remove the folder and whatever it holds."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)


def _give_name(made: Path, target: Path) -> None:
    """Move a file to its place, or write it into what is there."""
    if is_stream(target):
        with open(made, "rb") as file:
            _pour(file, target)
        return
    real = real_path(target)
    with contextlib.suppress(FileNotFoundError):
        older = real.stat()
        if hasattr(os, "chown") and (older.st_uid, older.st_gid) != (os.geteuid(), os.getegid()):
            with contextlib.suppress(OSError):
                os.chown(made, older.st_uid, older.st_gid)
        os.chmod(made, stat.S_IMODE(older.st_mode))
    os.replace(made, real)


def _pour(file: Any, target: Path) -> None:
    """Write a file into a device, a pipe, or what this process has open, at the place where that stands."""
    there = os.stat(target)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):
            if os.path.samestat(os.fstat(stream.fileno()), there):
                stream.flush()
                with open(stream.fileno(), "wb", closefd=False) as out:
                    shutil.copyfileobj(file, out)
                return
    with open(os.open(target, os.O_WRONLY | os.O_APPEND), "wb") as out:
        shutil.copyfileobj(file, out)


def _locked_folder(parent: Path) -> tuple[Path, int | None]:
    """A new folder that only we may enter, and what holds it locked; None where folders have no locks."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
        try:
            lock = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:  # swept before it was locked
            continue
        except OSError:  # Windows: nothing is swept there
            return folder, None
        with contextlib.suppress(OSError):  # a file system without locks: the same
            if not try_lock(lock) or not folder.exists():
                os.close(lock)
                continue
        return folder, lock


def sweep(folder: str | os.PathLike) -> None:
    """Remove what writers that live no more left in a folder; other users' and live writers' files stay."""
    with contextlib.suppress(OSError):
        for left in Path(folder).glob(f"{PREFIX}*"):
            with contextlib.suppress(OSError):
                _remove_dead(left)


def _remove_dead(folder: Path) -> None:
    lock = os.open(folder, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_DIRECTORY", 0))
    try:
        if os.fstat(lock).st_uid == os.geteuid() and try_lock(lock):
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def try_lock(file: Any) -> bool:
    """Lock an open file or its descriptor until it is closed or this process ends; False where another has it locked.

    Raises
    ------
    OSError
        If the file system has no locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def disk_is_full(path: str | os.PathLike) -> bool:
    """Whether no room is left where a file is; False where the system does not say."""
    try:
        return hasattr(os, "statvfs") and os.statvfs(path).f_bavail == 0
    except OSError:
        return False
