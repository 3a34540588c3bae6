"""What a run keeps beside its outputs: a lock, the tiles that are done, scratch space."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import socket
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..base.errors import StageError
from ..base.files import try_lock, write_whole
from .cloudindex import CloudIndex

#: The folder beside the outputs.
FOLDER = ".pdal-stages"


def fingerprint(*parts: Any) -> str:
    """A digest of JSON-able things."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]


class Store:
    """The folder of one run, locked while it is used.

    Parameters
    ----------
    outputs : Path
        The folder of the outputs, where it is made.

    Raises
    ------
    StageError
        If another run works there.
    """

    def __init__(self, outputs: Path) -> None:
        self.folder = outputs / FOLDER
        self.tiles = self.folder / "tiles"
        self.scratch = self.folder / "scratch"
        self.files = self.folder / "files.jsonl"
        self.indexes = self.folder / "index"
        self._lock: Any = None
        self._written: dict[str, Any] = {}

    def __enter__(self) -> Store:
        try:
            for folder in (self.folder, self.tiles, self.indexes):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StageError(
                "the output folder cannot be written to", found=f"{self.folder}: {error.strerror}"
            ) from None
        self._take()
        shutil.rmtree(self.scratch, ignore_errors=True)
        self.scratch.mkdir()
        self._written = self._load()
        return self

    def __exit__(self, *exc: object) -> None:
        shutil.rmtree(self.scratch, ignore_errors=True)
        self._release()

    # ---- the lock ------------------------------------------------------------------------------------

    def _take(self) -> None:
        path = self.folder / "lock"
        file = open(path, "a+", encoding="utf-8")  # noqa: SIM115  open as long as the lock is held
        if not try_lock(file):
            file.seek(0)
            who = file.read().strip() or str(self.folder)
            file.close()
            raise StageError(
                "another run is working in this output folder",
                found=who,
                cure="Wait for it, or write to another folder",
            )
        file.seek(0)
        file.truncate()
        file.write(
            f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
        )
        file.flush()
        self._lock = file

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()  # which releases it; the file stays, so that nobody locks a removed one
            self._lock = None

    # ---- tiles ---------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget all that earlier runs finished."""
        for folder in (self.tiles, self.indexes):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        self.files.unlink(missing_ok=True)
        self._written = {}

    def result(self, name: str) -> Path:
        """The file of a tile's results."""
        return self.tiles / f"{name}.npz"

    def done(self, name: str) -> Path:
        """The file that says a tile is done."""
        return self.tiles / f"{name}.json"

    def finished(self, name: str, mark: str) -> dict[str, Any] | None:
        """The report of a tile that is done and was the same then; otherwise None."""
        try:
            report = json.loads(self.done(name).read_text())
        except (OSError, ValueError):
            return None
        return report if report.get("fingerprint") == mark else None

    # ---- outputs -------------------------------------------------------------------------------------

    def _load(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        with contextlib.suppress(OSError):
            for line in self.files.read_text().splitlines():
                with contextlib.suppress(ValueError):  # the last line of a run that was killed
                    found.update(json.loads(line))
        return found

    def written(self, name: str, mark: str) -> dict[str, Any] | None:
        """The report of outputs that exist unchanged and were made of the same things; otherwise None."""
        report = self._written.get(name)
        if not report or report.get("fingerprint") != mark:
            return None
        for path, size, changed in report.get("outputs", []):
            try:
                stat = os.stat(path)
            except OSError:
                return None
            if [stat.st_size, stat.st_mtime_ns] != [size, changed]:
                return None
        return report

    def wrote(self, name: str, mark: str, report: dict[str, Any]) -> None:
        """Remember outputs."""
        self._written[name] = {**report, "fingerprint": mark}
        with open(self.files, "a", encoding="utf-8") as file:
            file.write("\n" + json.dumps({name: self._written[name]}))

    # ---- indexes -------------------------------------------------------------------------------------

    def index(self, mark: str) -> CloudIndex | None:
        """The index of an input that is still the same."""
        with contextlib.suppress(OSError, ValueError, TypeError):
            return CloudIndex(**json.loads((self.indexes / f"{mark}.json").read_text()))
        return None

    def keep_index(self, mark: str, index: CloudIndex) -> None:
        """Keep the index of an input."""
        write_whole(self.indexes / f"{mark}.json", json.dumps(asdict(index)).encode())
