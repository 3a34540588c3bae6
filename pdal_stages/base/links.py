"""Links in the way to an output: followed, unless somebody else put them where others may write."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from .errors import StageError

#: Most links on the way to a file, as in Linux.
_MOST = 40


def followed(path: str | os.PathLike, what: str = "output") -> Path:
    """The file that a name leads to, its links followed.

    In a folder that others may write to, anybody can put a link where an output is expected, and so choose which file
    of the caller's is replaced. There a link is followed only if it is the caller's own or the folder's owner's, as
    Linux does where ``fs.protected_symlinks`` is set; a pipe there as well.

    Parameters
    ----------
    path : path
    what : str
        What messages call it.

    Raises
    ------
    StageError
        If a link or pipe on the way is somebody else's.
    """
    name = os.fspath(path)
    waiting = (name if os.path.isabs(name) else os.path.join(os.getcwd(), name)).split(os.sep)[::-1]
    here, links = os.sep, 0
    while waiting:
        part = waiting.pop()
        if part in ("", "."):
            continue
        if part == "..":
            here = os.path.dirname(here)
            continue
        name = os.path.join(here, part)
        try:
            found = os.lstat(name)
        except (OSError, ValueError):
            here = name
            continue
        if stat.S_ISLNK(found.st_mode) or stat.S_ISFIFO(found.st_mode):
            _refuse_foreign(here, name, found, what)
        if stat.S_ISLNK(found.st_mode) and links < _MOST:
            links += 1
            target = os.readlink(name)
            if os.path.isabs(target):
                here = os.sep
            waiting += target.split(os.sep)[::-1]
        else:
            here = name
    return Path(here)


def _refuse_foreign(folder: str, name: str, found: os.stat_result, what: str) -> None:
    around = os.lstat(folder)
    if not around.st_mode & 0o022 or found.st_uid in (os.geteuid(), around.st_uid):
        return
    kind = "a link" if stat.S_ISLNK(found.st_mode) else "a pipe"
    raise StageError(
        f"the {what} file is {kind} that another user put into a folder that others may write to",
        found=name,
        cure="Write to a folder of your own, or remove it if you know whose it is",
    )
