"""What a run keeps beside its outputs: a lock, arrays and notes of what is done, scratch space."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import strictjson
from ..base.errors import StageError
from ..base.files import try_lock, whole_files

#: The folder beside the outputs.
FOLDER = ".pdal-stages"


def fingerprint(*parts: Any) -> str:
    """A digest of JSON-able things."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]


class Store:
    """The folder of one run, locked while it is used; `outputs` is the folder beside whose files it is made.

    Raises
    ------
    StageError
        If another run works there, or it cannot be written to.
    """

    def __init__(self, outputs: Path) -> None:
        self.folder = outputs / FOLDER
        self.kept = self.folder / "kept"
        #: Of this very run, and gone when it has ended: see :func:`check_run`.
        self.scratch = self.folder / "scratch" / secrets.token_hex(4)

    def __enter__(self) -> Store:
        with contextlib.ExitStack() as stack:
            try:
                lock = take_lock(
                    self.folder,
                    "another run is working in this output folder",
                    "Wait for it, or write to another folder",
                )
                stack.callback(lock.close)  # the file stays, so that nobody locks a removed one
                make_own(self.kept)
                _remove(self.scratch.parent)
                self.scratch.mkdir(parents=True)
            except OSError as error:
                raise StageError(
                    "the output folder cannot be written to",
                    found=f"{error.filename or self.folder}: {error.strerror}",
                ) from None
            stack.callback(shutil.rmtree, self.scratch.parent, ignore_errors=True)
            self._leave = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._leave.close()

    def clear(self) -> None:
        """Forget all that earlier runs finished."""
        _remove(self.kept)
        self.kept.mkdir()

    def path(self, name: str) -> Path:
        """A file of arrays or points, by its name."""
        return self.kept / name

    def finish(self, name: str, mark: str, record: Mapping[str, Any]) -> None:
        """Note that something is done; `mark` is the fingerprint of all that decides it."""
        path = self._note(name)
        partial = path.with_name(f"{path.name}.partial")
        content = {**record, "fingerprint": mark}
        text = json.dumps({"digest": fingerprint(path.name, content), "content": content})
        try:
            _remove(partial)
            with open(partial, "xb") as file:
                file.write(text.encode())
            os.replace(partial, path)
        except OSError as error:
            raise StageError(
                "the result file could not be written", found=f"{path}: {error.strerror or error}"
            ) from error

    def forget(self, name: str) -> None:
        """Something is to be done anew: what was noted of it must not be believed of a file made since."""
        _remove(self._note(name))

    def note(self, name: str) -> dict[str, Any] | None:
        """What was noted of something that is done, with its fingerprint; None where that is cut or changed."""
        path = self._note(name)
        try:
            found = strictjson.loads(path.read_bytes())
            content = found["content"]
            same = isinstance(content, dict) and found["digest"] == fingerprint(path.name, content)
            return content if same else None
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return None

    def finished(self, name: str, mark: str) -> dict[str, Any] | None:
        """What was noted, where `mark` is still the same and the files that were written are there unchanged."""
        found = self.note(name)
        return found if found is not None and found["fingerprint"] == mark and unchanged(found) else None

    def _note(self, name: str) -> Path:
        return self.kept / f"{name}.json"

    def remove(self, ending: str, but: Collection[str] = ()) -> None:
        """Remove the files whose names end so, but some."""
        for path in self.kept.glob(f"*{ending}"):
            if path.name not in but:
                path.unlink(missing_ok=True)


def written(outputs: Sequence[str | os.PathLike]) -> list[list[Any]]:
    """What a record says of files just written: their names, sizes and times of change."""
    return [[str(path), s.st_size, s.st_mtime_ns] for path, s in ((p, os.stat(p)) for p in outputs)]


def unchanged(record: Mapping[str, Any]) -> bool:
    """Whether the files of a record are there as they were written."""
    with contextlib.suppress(OSError):
        files = record.get("outputs", [])
        return written([path for path, *_ in files]) == files
    return False


def check_run(scratch: str) -> None:
    """Refuse to go on where the run whose scratch folder this is has ended.

    A cluster's worker may still be at a task of a run that was killed when the next run has noted its own result. It asks
    before a file gets its name, by making another, as a network's file system may remember folders that are gone.
    """
    try:
        with tempfile.TemporaryFile(dir=scratch):
            pass
    except OSError as error:
        raise StageError(
            "the run that wanted this has ended, or has no room left for scratch",
            found=f"{scratch}: {error.strerror}",
        ) from None


# ---- arrays ------------------------------------------------------------------------------------------------


def save_arrays(path: str | Path, arrays: Mapping[str, NDArray], scratch: str) -> None:
    """Write arrays into a file, whole or not at all; `scratch`: see :func:`check_run`."""
    made = whole_files(path, what="result", check=lambda *_: check_run(scratch))
    with made as (partial,), open(partial, "wb") as file:
        np.savez(file, **arrays, names=np.array(sorted(arrays)))  # type: ignore[arg-type]


def load_arrays(path: str | Path, only: Collection[str] | None = None, under: str = "") -> dict[str, NDArray]:
    """The arrays of a file, or `only` some as far as they are there; those whose names begin with `under`, without that.

    A file that cannot be read is removed, so that a later run makes it anew.
    """
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            names = [name for name in file.files if name != "names"]
            if sorted(names) != file["names"].tolist():  # checksums do not cover them
                raise ValueError("its arrays have other names")
            names = [name for name in names if name.startswith(under)]
            return {n.removeprefix(under): file[n] for n in names if only is None or n in only}
    except MemoryError:
        raise
    except Exception as error:  # zipfile and numpy raise many types
        Path(path).unlink(missing_ok=True)
        raise StageError(
            "what the run kept cannot be read back, and was removed",
            found=f"{path}: {error}",
            cure="Run it again with --resume",
        ) from error


# ---- folders that nobody else put there ----------------------------------------------------------------------


def take_lock(folder: Path, taken: str, cure: str) -> Any:
    """Lock a run's own folder; the open file, which releases it when closed.

    Raises
    ------
    StageError
        With the text `taken`, where another run has it.
    """
    while True:
        make_own(folder)
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
        try:
            file = os.fdopen(os.open(folder / "lock", flags, 0o622), "a+", encoding="utf-8")
        except FileNotFoundError:  # the run that had it has just removed its folder
            continue
        if hasattr(
            os, "fchmod"
        ):  # who can read a lock can hold it, so those may who can write, and nobody else
            writers = os.fstat(file.fileno()).st_mode & 0o022
            with contextlib.suppress(OSError):  # of another user, whose folder this is
                os.fchmod(file.fileno(), 0o600 | writers | writers << 1)
        if not try_lock(file):
            file.seek(0)
            who = file.read().strip() or str(folder)
            file.close()
            raise StageError(taken, found=who, cure=cure)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.stat(folder / "lock")):
                break
        file.close()
    file.truncate(0)
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    file.write(f"process {os.getpid()} on {socket.gethostname()} since {since}\n")
    file.flush()
    return file


def make_own(folder: Path) -> None:
    """Make a folder, or take one that is there: no link, and not another user's in a folder that all may write to."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir()
    status, parent = os.lstat(folder), os.stat(folder.parent)
    own = not hasattr(os, "geteuid") or status.st_uid in (os.geteuid(), parent.st_uid)
    if not stat.S_ISDIR(status.st_mode) or not own:
        raise StageError(
            "the run's own folder beside the outputs is a link, a file or another user's",
            found=str(folder),
            cure="Remove it, or write to another folder",
        )


def _remove(path: Path) -> None:
    """Remove whatever lies there, but nothing that a link leads to."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
