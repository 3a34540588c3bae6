"""Output files: checked against inputs and existing files, then written whole or not at all.

They are written in a hidden folder beside their final place, then renamed. The folder has a random
name, is private to its owner and locked while its writer runs, so what a killed writer left is
recognized and removed by the next one.

* An existing file is replaced; the new one keeps its mode, and its owner where permitted. What
  other programs left beside it (:mod:`.companions`) is removed.
* A link is followed: its target is replaced, the link stays.
* A device, pipe or terminal (``/dev/stdout``) gets the content once it is complete.
* A write-protected file, a file of another kind, a folder, a socket and a block device are refused.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, NoReturn

from .companions import is_open_database, remove_companions
from .errors import StageError, WriteError

LAS = "a LAS or LAZ file"
MODEL = "a model file"
JSON = "a JSON file"
HTML = "an HTML page"
PNG = "a PNG picture"
#: A file with content of no kind above.
_OTHER = "a file of another kind"


def kind_of(path: str | os.PathLike) -> str:
    """Return the kind of a file in words; empty for an empty or a missing file."""
    try:
        with open(path, "rb") as file:
            head = file.read(512)
    except OSError:
        return ""
    if head.startswith((b"LASF", b"\x89PNG")):
        return LAS if head.startswith(b"LASF") else PNG
    if head.startswith(b"PK\x03\x04"):  # its first file's name: length at 26, text from 30
        first = head[30 : 30 + int.from_bytes(head[26:28], "little")]
        return MODEL if first == b"manifest.json" else _OTHER
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return HTML
    if text.startswith((b"{", b"[")):
        return JSON
    return _OTHER if head else ""


#: The longest file name, in bytes, on common file systems.
_LONGEST_NAME = 255
#: The most links that Linux follows one after the other.
_MOST_LINKS = 40


def check_writable(path: str | os.PathLike, what: str = "output", kind: str = "") -> None:
    """Refuse an output that cannot be written, before any work is done.

    Parameters
    ----------
    path : path
    what : str
        What messages call it.
    kind : str
        The kind of file it will be, one of :data:`LAS`, :data:`MODEL`, ... in this module, where
        that is known.

    Raises
    ------
    WriteError
        If its folder is missing or read-only, its name is too long, or what exists there must not
        be replaced: a folder, a write-protected file, a file of another kind, a database that
        another program has open.
    """

    def refuse(problem: str, cure: str | None = None, value: str = str(path)) -> NoReturn:
        raise WriteError(problem.format(what), found=value, cure=cure)

    if not os.fspath(path) or "\0" in os.fspath(path):
        refuse("the {} file has no name", "Is a shell variable unset?", ascii(path))
    _refuse_foreign(path, what)
    if is_stream(path):
        mode = os.stat(path).st_mode
        if not os.access(path, os.W_OK) or stat.S_ISBLK(mode) or stat.S_ISSOCK(mode):
            refuse("the {} file is a device that cannot be written to")
        return
    real = Path(os.path.realpath(path))
    if len(real.name.encode(errors="surrogateescape")) > _LONGEST_NAME:
        refuse(f"the name of the {{}} file is longer than {_LONGEST_NAME} bytes")
    if not real.parent.is_dir():
        refuse("the folder of the {} file does not exist", "Create it first", str(real.parent))
    if real.is_dir():
        refuse("the {} file names a folder", "Give a file name")
    if not os.access(real.parent, os.W_OK):
        refuse(
            "the folder of the {} file cannot be written to",
            "Give another folder, or change its mode",
            str(real.parent),
        )
    if real.exists() and not (os.access(real, os.W_OK) and real.stat().st_mode & 0o222):
        refuse("the {} file is write-protected", "Give another name, or change its mode")
    if is_open_database(real):
        refuse("the {} file is open in another program", "Close it there, or give another name")
    older = kind_of(real) if kind else ""
    if older and older != kind:
        cure = "Give another name, or remove that file first"
        refuse(f"the {{}} file would replace {older}", cure)


def create_folder(path: str | os.PathLike, what: str) -> None:
    """Create a folder of `what` and those above it; StageError where that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(
            f"the folder of {what} cannot be created",
            found=f"{path}: {error.strerror}",
            cure="Give another folder, or change the mode of the one above it",
        ) from None


def _trusted() -> set[int]:
    """Return the users whose files and links are trusted: this one, root, the system's owner."""
    return {0, os.geteuid(), os.stat("/").st_uid}


def _refuse_foreign(path: str | os.PathLike, what: str) -> None:
    """Refuse a link or pipe that another user has put into a folder that is not his."""
    at = os.path.abspath(path)
    for _ in range(_MOST_LINKS if hasattr(os, "geteuid") else 0):
        if not os.path.lexists(at):
            return
        status, folder = os.lstat(at), os.path.dirname(at)
        if not (stat.S_ISLNK(status.st_mode) or stat.S_ISFIFO(status.st_mode)):
            return
        if status.st_uid not in _trusted() | {os.stat(folder).st_uid}:
            problem = f"the {what} file is a link or pipe of another user"
            raise WriteError(problem, found=at, cure="Give another name")
        if stat.S_ISFIFO(status.st_mode):
            return
        at = os.path.join(folder, os.readlink(at))


def exposed_folder(folder: str) -> str:
    """Return the first of a real folder and its parents that other users may change, or "".

    Members of a folder's group are trusted. Of a parent all may write to if it is sticky.
    """
    for at in (folder, *map(str, Path(folder).parents)) if hasattr(os, "geteuid") else ():
        status = os.stat(at)
        sticky = at != folder and status.st_mode & stat.S_ISVTX
        if status.st_uid not in _trusted() or (status.st_mode & stat.S_IWOTH and not sticky):
            return at
    return ""


def make_own_folder(folder: Path) -> None:
    """Make a folder that its owner alone can enter, or check that an existing one is such a folder.

    It must be like one that is made here now: file systems without users give all files one owner
    and mode.

    Raises
    ------
    StageError
        For a link, a file, or a folder that is another user's or that others may write to.
    """
    with contextlib.suppress(FileExistsError):
        folder.mkdir(0o700)
        return
    probe = tempfile.mkdtemp(prefix=PREFIX, dir=folder.parent)
    like, status = os.stat(probe), os.lstat(folder)
    os.rmdir(probe)
    writable = status.st_mode & ~like.st_mode & 0o022
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != like.st_uid or writable:
        raise StageError(
            "the run's own folder beside the outputs is a link, a file, another user's or open to "
            "others",
            found=str(folder),
            cure="Remove it, or write to another folder",
        )
    if status.st_mode != like.st_mode:
        os.chmod(folder, stat.S_IMODE(like.st_mode))


def is_stream(path: str | os.PathLike) -> bool:
    """Return whether a path is written into, not replaced: a device, pipe or open file."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    opened = os.path.abspath(path).startswith(("/dev/std", "/dev/fd/", "/proc/"))
    return not stat.S_ISDIR(mode) and (opened or not stat.S_ISREG(mode))


@dataclass(frozen=True)
class Output:
    """A file to be written."""

    path: str  #: in its name '#' stands for numbers
    what: str = "output"  #: what messages call it: ``output``, ``model``, ``metadata``
    kind: str = ""  #: its kind: :data:`LAS`, :data:`MODEL`, ..., where it is known beforehand


def check_outputs(outputs: Iterable[Output], inputs: Iterable[str | os.PathLike]) -> None:
    """Refuse outputs that cannot be written, are inputs, are one file or replace another kind.

    Symbolic and hard links are recognized.

    Raises
    ------
    StageError
        Naming the output.
    """
    read = {identity: os.fspath(path) for path in inputs if (identity := _identity(path))}
    names = [Path(os.path.realpath(path)) for path in read.values()]
    seen: dict[tuple[int, int] | Path, Output] = {}
    for output in outputs:
        check_writable(output.path, output.what, output.kind)
        if is_stream(output.path):
            continue
        real, identity = Path(os.path.realpath(output.path)), _identity(output.path)
        hit = (identity and read.get(identity)) or _numbered(real, names)
        if hit is not None:
            problem = f"the {output.what} file is one of the inputs"
            raise StageError(problem, found=str(hit), cure="Give it another name")
        key = identity or real
        if key in seen:
            problem = f"the {output.what} file is the {seen[key].what} file too"
            if output.what == seen[key].what:
                problem = f"two {output.what} files are the same file"
            raise StageError(problem, found=output.path, cure="Give each its own name")
        seen[key] = output


def _identity(path: str | os.PathLike) -> tuple[int, int] | None:
    """Return what tells a file from others, whatever links lead to it; None without a file."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _numbered(output: Path, inputs: list[Path]) -> Path | None:
    """Return the input that a numbered output might overwrite."""
    if "#" not in output.name:
        return None
    before, _, after = output.name.partition("#")
    pattern = re.compile(rf"{re.escape(before)}\d+{re.escape(after)}")
    beside = (path for path in inputs if path.parent == output.parent)
    return next((path for path in beside if pattern.fullmatch(path.name)), None)


#: How the hidden folders' names begin.
PREFIX = ".pdal-stages-partial-"
#: The system's errors for a full disk, an exceeded quota or file-size limit.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_swept: set[str] = set()


def write_whole(path: str | os.PathLike, content: bytes, what: str = "output") -> Path:
    """Write a file so that it is either complete or absent; return its path.

    Raises
    ------
    StageError
        If it cannot be written; what was there before stays.
    """
    with whole_files(path, what=what) as (partial,), open(partial, "xb") as file:
        file.write(content)
    return Path(path)


def write_json(
    path: str | os.PathLike, value: object, what: str = "output", indent: int = 1
) -> Path:
    """Write a JSON file whole or not at all; values that JSON does not have become text."""
    return write_whole(path, (json.dumps(value, indent=indent, default=str) + "\n").encode(), what)


@contextlib.contextmanager
def whole_files(
    *paths: str | os.PathLike,
    what: str = "output",
    check: Callable[[Path, Path, int], None] | None = None,
) -> Iterator[list[Path]]:
    """Give files to write to; on leaving, all of them get their names, or after an exception none.

    Parameters
    ----------
    *paths : path
        The final paths. A name with '#' may become any number of files, as PDAL's writers number
        them; files that a writer creates beside its own are moved with it.
    what : str
        What messages call them.
    check : callable, optional
        Called with each file that was written, the name it is to get and the number of the path it
        belongs to, before any of them gets its name.

    Yields
    ------
    list of Path
        Paths with the same names in hidden folders. Nothing exists there yet.

    Raises
    ------
    StageError
        If a file cannot be written, or was not. Errors raised inside name the final path, not the
        hidden one.
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
        moves = [(*move, number) for number, place in enumerate(places) for move in place.written()]
        for partial, target, number in moves:
            check_writable(target, what, kind_of(partial) or _OTHER)
            if check is not None:
                check(partial, target, number)
        _give_names([(partial, target) for partial, target, _ in moves])
    except StageError as error:
        _name_final_paths(error, places)
        raise
    except OSError as error:
        named = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
        at = next((p.path for p in places if named.startswith(str(p.folder))), None)
        if inside and named and at is None:  # of something that was read
            raise
        raise WriteError(
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
        real = Path(os.path.realpath(path))
        parent = Path(tempfile.gettempdir()) if is_stream(path) else real.parent
        if str(parent) not in _swept:
            _swept.add(str(parent))
            sweep(parent)
        self.folder, self._lock = _locked_folder(parent)
        self.partial = self.folder / path.name

    def written(self) -> list[tuple[Path, Path]]:
        """Return the files that were written, and the names they are to get."""
        files = sorted(self.folder.iterdir())
        if self.partial not in files and "#" not in self.path.name:
            cure = "Name a file whose suffix says what it is, such as .laz"
            raise StageError("the writer wrote no file", found=str(self.path), cure=cure)
        return [(f, self.path if f == self.partial else self.path.with_name(f.name)) for f in files]

    def close(self) -> None:
        """Remove the folder and whatever it holds."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)


def _name_final_paths(error: StageError, places: list[_Place]) -> None:
    """Name final paths in an error in place of hidden ones; a full disk explains it."""
    for place in places:
        if isinstance(error.found, str):
            error.found = error.found.replace(str(place.partial), str(place.path))
        if error.cure is None and disk_is_full(place.folder):
            error.cure = f"The disk of {place.path} is full: make room"


def _give_names(moves: list[tuple[Path, Path]]) -> None:
    """Move files to their final paths; what other programs left beside older ones goes."""
    remove_companions(target for _, target in moves if not is_stream(target))
    for partial, target in moves:
        _give_name(partial, target)


def _give_name(partial: Path, target: Path) -> None:
    """Move a file to its final path, or write it into a device or pipe."""
    if is_stream(target):
        with open(partial, "rb") as file:
            _pour(file, target)
        return
    real = Path(os.path.realpath(target))
    with contextlib.suppress(FileNotFoundError):
        older = real.stat()
        if hasattr(os, "chown") and (older.st_uid, older.st_gid) != (os.geteuid(), os.getegid()):
            with contextlib.suppress(OSError):
                os.chown(partial, older.st_uid, older.st_gid)
        os.chmod(partial, stat.S_IMODE(older.st_mode))
    os.replace(partial, real)


def _pour(file: BinaryIO, target: Path) -> None:
    """Copy a file into a device, a pipe, or an open file of this process at its position."""
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
    """Return a new private folder and the descriptor that locks it, None without locks."""
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
    """Remove hidden folders of writers that were killed, but not those of running ones."""
    with contextlib.suppress(OSError):
        for left in Path(folder).glob(f"{PREFIX}*"):
            with contextlib.suppress(OSError):
                _remove_dead(left)


def _remove_dead(folder: Path) -> None:
    """Remove a hidden folder unless its writer still runs or it is another user's."""
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_DIRECTORY", 0)
    lock = os.open(folder, os.O_RDONLY | flags)
    try:
        if os.fstat(lock).st_uid == os.geteuid() and try_lock(lock):
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def try_lock(file: IO | int) -> bool:
    """Lock an open file or descriptor until it is closed; return False if another has the lock.

    Raises
    ------
    OSError
        If the file system has no locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows: nothing is locked
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def disk_is_full(path: str | os.PathLike) -> bool:
    """Return whether no room is left where a file is; False where the system does not report it."""
    try:
        return hasattr(os, "statvfs") and os.statvfs(path).f_bavail == 0
    except OSError:
        return False
