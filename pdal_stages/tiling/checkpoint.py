"""Keep the working folder of a run beside its outputs: lock, results, temporary files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import socket
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.checks import strict_json
from ..base.errors import StageError
from ..base.files import make_own_folder, try_lock, whole_files

#: The folder beside the outputs.
FOLDER = ".pdal-stages"


def fingerprint(*parts: Any) -> str:
    """Return a digest of JSON-able values."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]


class Store:
    """The working folder of a run in the folder `outputs`, locked while in use."""

    def __init__(self, outputs: Path) -> None:
        self.folder = outputs / FOLDER
        self.kept = self.folder / "kept"
        #: Of this run only: workers left over from a killed run find theirs gone.
        self.scratch = self.folder / "scratch" / secrets.token_hex(4)

    def __enter__(self) -> Store:
        """Create and lock the folder; StageError where another run works in it."""
        self._new = not self.folder.exists()
        try:
            make_own_folder(self.folder)
            for folder in (self.kept, self.scratch.parent):
                folder.mkdir(exist_ok=True)
            lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
            self._lock = os.fdopen(lock, "r+", encoding="utf-8")
            if not try_lock(self._lock):
                with self._lock:
                    who = self._lock.read().strip()
                raise StageError(
                    "another run is working in this output folder",
                    found=who,
                    cure="Wait for it, or write to another folder",
                )
            self._lock.truncate(0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            self._lock.write(f"process {os.getpid()} on {socket.gethostname()} since {since}\n")
            self._lock.flush()
            shutil.rmtree(self.scratch.parent, ignore_errors=True)
            self.scratch.mkdir(parents=True)
        except OSError as error:
            raise StageError(
                "the output folder cannot be written to",
                found=f"{error.filename or self.folder}: {error.strerror}",
            ) from None
        return self

    def __exit__(self, kind: type | None, *exc: object) -> None:
        """Remove temporary files, and all where a first run failed with no result to go on from."""
        # Another run that locks the deleted file finds no folder.
        failed = self._new and kind is not None and issubclass(kind, StageError)
        useless = failed and not any(self.kept.glob("*.npz"))
        shutil.rmtree(self.folder if useless else self.scratch.parent, ignore_errors=True)
        self._lock.close()  # the file stays, so that nobody locks a deleted one

    def clear(self) -> None:
        """Remove the results of earlier runs."""
        old = self.scratch / "before"
        self.kept.rename(old)  # renamed first, as a leftover worker may still write there
        self.kept.mkdir()
        shutil.rmtree(old, ignore_errors=True)

    def path(self, name: str) -> str:
        """Return the path of a file of arrays."""
        return str(self.kept / f"{name}.npz")

    def finish(self, name: str, mark: str, record: Mapping[str, Any]) -> None:
        """Save the record of a finished job.

        `mark` is the fingerprint of everything that affects it.
        """
        partial = self.kept / f"{name}.partial"
        partial.write_text(json.dumps({**record, "fingerprint": mark}))
        os.replace(partial, self._note(name))

    def forget(self, name: str) -> None:
        """Remove the record of a job that runs again: it must not match a newer file."""
        self._note(name).unlink(missing_ok=True)

    def note(self, name: str) -> dict[str, Any]:
        """Return the record of a finished job with its fingerprint; empty without one."""
        try:
            record = strict_json(self._note(name).read_bytes())
            return record if isinstance(record, dict) else {}
        except (OSError, ValueError, RecursionError):
            return {}

    def finished(self, name: str, mark: str) -> dict[str, Any] | None:
        """Return the record of a job if `mark` matches and the files it wrote are unchanged."""
        record = self.note(name)
        with contextlib.suppress(OSError, ValueError, TypeError):  # whatever is written there
            files = record.get("outputs", [])
            if record.get("fingerprint") == mark and written([path for path, *_ in files]) == files:
                return record
        return None

    def _note(self, name: str) -> Path:
        return self.kept / f"{name}.json"

    def remove(self, ending: str, but: Collection[str] = ()) -> None:
        """Remove the files with an ending, except those named in `but`."""
        for path in self.kept.glob(f"*{ending}"):
            if path.name not in but:
                path.unlink(missing_ok=True)


def written(outputs: Sequence[str | os.PathLike]) -> list[list[Any]]:
    """Return names, sizes and times of files just written, for a record."""
    return [[str(path), s.st_size, s.st_mtime_ns] for path, s in ((p, os.stat(p)) for p in outputs)]


def save_arrays(path: str | Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays into a file, whole or not at all."""
    with whole_files(path, what="result") as (partial,), open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: str | Path, only: Collection[str] | None = None) -> dict[str, NDArray]:
    """Return the arrays of a file by name, or those that are named in `only`.

    A file that cannot be read is removed, so that a later run makes it again.
    """
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            return {name: file[name] for name in file.files if only is None or name in only}
    except MemoryError:
        raise
    except Exception as error:  # zipfile and numpy raise many types
        Path(path).unlink(missing_ok=True)
        raise StageError(
            "a temporary result of the run cannot be read back, and was removed",
            found=f"{path}: {error}",
            cure="Run it again with --resume",
        ) from error
