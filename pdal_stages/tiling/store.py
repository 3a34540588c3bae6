"""What a run keeps beside its outputs: a lock, the tiles that are done, scratch space."""

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
from collections.abc import Collection
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from ..base import strictjson
from ..base.errors import StageError
from ..base.files import try_lock
from .index import CloudIndex

#: The folder beside the outputs.
FOLDER = ".pdal-stages"
_SCRATCH = "scratch"


def fingerprint(*parts: Any) -> str:
    """A digest of JSON-able things."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]


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


def left_file(tile: str) -> str:
    """The name of the file of what the first round left of a tile."""
    return f"{tile}.first.npz"


def block_file(block: tuple[int, int]) -> str:
    """The name of the file of a block that is made of what is left."""
    return f"{block[0]}_{block[1]}.cells.npz"


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
        #: Of this very run, and gone when it has ended: see :func:`check_run`.
        self.scratch = self.folder / _SCRATCH / secrets.token_hex(4)
        self.files = self.folder / "files.jsonl"
        self.indexes = self.folder / "index"
        self._lock: Any = None
        self._written: dict[str, Any] = {}

    def __enter__(self) -> Store:
        try:
            for folder in (self.folder, self.tiles, self.indexes):
                make_own(folder)
            self._take()
            _remove(self.scratch.parent)
            self.scratch.mkdir(parents=True)
        except BaseException as error:
            self._release()
            if not isinstance(error, OSError):
                raise
            raise StageError(
                "the output folder cannot be written to",
                found=f"{error.filename or self.folder}: {error.strerror}",
            ) from None
        self._written = self._load()
        return self

    def __exit__(self, *exc: object) -> None:
        shutil.rmtree(self.scratch.parent, ignore_errors=True)
        self._release()

    # ---- the lock ------------------------------------------------------------------------------------

    def _take(self) -> None:
        self._lock = take_lock(
            self.folder,
            "another run is working in this output folder",
            "Wait for it, or write to another folder",
        )

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()  # which releases it; the file stays, so that nobody locks a removed one
            self._lock = None

    # ---- tiles ---------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget all that earlier runs finished."""
        for folder in (self.tiles, self.indexes):
            _remove(folder)
            folder.mkdir()
        self.files.unlink(missing_ok=True)
        self._written = {}

    def keep_sides(self, tile: float, block: float | None) -> None:
        """Remember the sides of tiles, and of what is made before them, for :meth:`side`."""
        path = self.folder / "run.json"
        if path.is_dir():
            _remove(path)
        _keep(path, {"tile": tile, "block": block}, "result")

    def side(self, what: str = "tile") -> float | None:
        """The side of the last run's tiles, or its ``block``, where it is known."""
        return (_read(self.folder / "run.json") or {}).get(what)

    def result(self, name: str) -> Path:
        """The file of a tile's results."""
        return self.tiles / f"{name}.npz"

    def left(self, name: str) -> Path:
        """The file of what the first round left of a tile."""
        return self.tiles / left_file(name)

    def block(self, block: tuple[int, int]) -> Path:
        """The file of a block that is made of what is left."""
        return self.tiles / block_file(block)

    def forget_left(self, but: Collection[str] = (), but_blocks: Collection[tuple[int, int]] = ()) -> None:
        """Remove what the first rounds left, of all tiles and blocks but these."""
        kept = {left_file(name) for name in but} | {block_file(block) for block in but_blocks}
        for path in [*self.tiles.glob("*.first.npz"), *self.tiles.glob("*.cells.npz")]:
            if path.name not in kept:
                path.unlink(missing_ok=True)

    def has_result(self, name: str, record: dict[str, Any]) -> bool:
        """Whether the file of a tile's results is there, as long as the tile's record says."""
        try:
            return self.result(name).stat().st_size == record.get("result_bytes")
        except OSError:
            return False

    def finish(self, name: str, mark: str, record: dict[str, Any]) -> None:
        """Remember that a tile is done."""
        _keep(self._done(name), {**record, "fingerprint": mark}, "result")

    def forget(self, name: str) -> None:
        """A tile is to be done anew: what an earlier run noted of it must not be believed of a file made since."""
        _forget(self._done(name))

    def finished(self, name: str) -> dict[str, Any] | None:
        """The record of a tile that is done, with its fingerprint; otherwise None."""
        return _read(self._done(name))

    def _done(self, name: str) -> Path:
        return self.tiles / f"{name}.json"

    # ---- outputs -------------------------------------------------------------------------------------

    def _load(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        with contextlib.suppress(OSError):
            for line in self.files.read_bytes().splitlines():
                found |= _opened(self.files, line) or {}
        return found

    def written(self, name: str) -> dict[str, Any] | None:
        """The record of outputs that exist unchanged, with its fingerprint; otherwise None."""
        record = self._written.get(name)
        for path, size, changed in record["outputs"] if record else ():
            try:
                status = os.stat(path)
            except OSError:
                return None
            if [status.st_size, status.st_mtime_ns] != [size, changed]:
                return None
        return record

    def wrote(self, name: str, mark: str, record: dict[str, Any]) -> None:
        """Remember outputs."""
        self._written[name] = {**record, "fingerprint": mark}
        with _open_own(self.files) as file:
            file.write("\n" + _sealed(self.files, {name: self._written[name]}))

    # ---- indexes -------------------------------------------------------------------------------------

    def index(self, mark: str) -> CloudIndex | None:
        """The index of an input that is still the same."""
        known = _read(self.indexes / f"{mark}.json")
        if known is None or "cells" not in known:  # of an earlier version
            return None
        cells = np.array(known["cells"], np.int64).reshape(-1, 4)
        tiles = [(i, j, n) for i, j, n in known["tiles"]]
        return CloudIndex(int(known["count"]), tuple(known["box"]), tiles, cells, str(self.copy(mark)))

    def copy(self, mark: str) -> Path:
        """The file of an input's points, sorted by place."""
        return self.indexes / f"{mark}.points"

    def forget_copies(self, but: Collection[str] = ()) -> None:
        """Remove the copies of inputs, but those of these marks."""
        kept = {self.copy(mark).name for mark in but}
        for path in self.indexes.glob("*.points*"):
            if path.name not in kept:
                path.unlink(missing_ok=True)

    def keep_index(self, mark: str, index: CloudIndex) -> None:
        """Keep the index of an input, where there is room."""
        with contextlib.suppress(StageError, OSError):
            known = {"count": index.count, "box": index.box, "tiles": index.tiles}
            known |= {"cells": index.cells.tolist()}
            _keep(self.indexes / f"{mark}.json", known, "index")


# ---- files that nobody else put there ----------------------------------------------------------------------


def take_lock(folder: Path, taken: str, cure: str) -> Any:
    """Lock a run's own folder; the open file, which releases it when closed.

    Raises
    ------
    StageError
        With the text `taken`, where another run has it.
    """
    while True:
        make_own(folder)
        try:
            file = _open_own(folder / "lock")
        except FileNotFoundError:  # the run that had it has just removed its folder
            continue
        if not try_lock(file):
            file.seek(0)
            who = file.read().strip() or str(folder)
            file.close()
            raise StageError(taken, found=who, cure=cure)
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.stat(folder / "lock")):
                break
        file.close()
    file.seek(0)
    file.truncate()
    file.write(
        f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
    )
    file.flush()
    return file


def make_own(folder: Path) -> None:
    """Make a folder, or take one that is there: no link, and not another user's in a folder that all may write to."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir()
    status, parent = os.lstat(folder), os.stat(folder.parent)
    if not stat.S_ISDIR(status.st_mode):
        wrong = "is a link or a file"
    elif hasattr(os, "geteuid") and status.st_uid not in (os.geteuid(), parent.st_uid):
        wrong = "belongs to another user"
    else:
        return
    raise StageError(
        f"the run's own folder beside the outputs {wrong}",
        found=str(folder),
        cure="Remove it, or write to another folder",
    )


def _remove(folder: Path) -> None:
    """Remove a folder, but nothing that a link leads to."""
    if folder.is_symlink():
        folder.unlink()
    shutil.rmtree(folder, ignore_errors=True)


def _forget(path: Path) -> None:
    """Remove a note, whatever lies in its place."""
    if path.is_dir():
        _remove(path)
    path.unlink(missing_ok=True)


def _open_own(path: Path) -> TextIO:
    """Open a file to append to, unless it is a link; who may not write to it may not read it either.

    A lock can be held by whoever can open the file, so readers could keep every run out.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
    file = os.fdopen(os.open(path, flags, 0o622), "a+", encoding="utf-8")
    if hasattr(os, "fchmod"):
        there = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        with contextlib.suppress(OSError):  # of another user, whose folder this is
            os.fchmod(file.fileno(), 0o600 | (there & 0o022) | (there & 0o022) << 1)
    return file


def _sealed(path: Path, value: dict[str, Any]) -> str:
    """An object as a line of JSON, with a digest that tells later whether it is still what was written there."""
    return json.dumps({"digest": fingerprint(path.parts[-2:], value), "content": value})


def _opened(path: Path, text: bytes) -> dict[str, Any] | None:
    """The object in a line of JSON; None where it is cut or changed."""
    try:
        found = strictjson.loads(text)
        content = found["content"]
        same = isinstance(content, dict) and found["digest"] == fingerprint(path.parts[-2:], content)
        return content if same else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _keep(path: Path, value: dict[str, Any], what: str) -> None:
    """Write an object into a file, whole: of the run's own folder, in which nobody else writes."""
    partial = path.with_name(f"{path.name}.partial")
    try:
        _forget(partial)
        with open(partial, "xb") as file:
            file.write(_sealed(path, value).encode())
        os.replace(partial, path)
    except OSError as error:
        raise StageError(
            f"the {what} file could not be written", found=f"{path}: {error.strerror or error}"
        ) from error


def _read(path: Path) -> dict[str, Any] | None:
    """The object in a file; None where it cannot be read."""
    try:
        return _opened(path, path.read_bytes())
    except OSError:
        return None
