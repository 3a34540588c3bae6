"""Tiles and outputs of a run, their results, and the working folder that holds these."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import socket
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.checks import strict_json
from ..base.columns import LazyColumns
from ..base.errors import StageError
from ..base.files import make_own_folder, try_lock, whole_files
from ..base.hashing import digest_of_file
from ..base.json_types import JsonObject
from ..base.messages import count_of
from ..base.version import __version__
from ..stages.points import NO_POINT_MATCHES, NO_POLYGON_NEAR
from .inputs import InputSource

#: Most distinct warnings of tiles that a run repeats (not tuned).
_MOST_MESSAGES = 20
_BLOCKS = (
    " (tiles and outputs that need it are not made; where its header cannot be read, tiles beside "
    "it may lack neighbors)"
)
_CHANGED = (
    "it changed during the run, so outputs may hold results from before and after. Once it no "
    "longer changes, run it again with --resume"
)


@dataclass
class Job:
    """A task of a run and its state: a tile, square, block or output, or an input to be read."""

    name: str  #: its key in the work folder
    points: int = 0  #: its own; 0 where unknown before it is read
    tile: tuple[int, int] = (0, 0)  #: of a tile or block: column and row
    source: InputSource | None = None  #: the input that an output is of
    #: files of the writers; None for a tile whose points go into outputs of input files
    outputs: list[str] | None = None
    jobs: list[Job] = field(default_factory=list)  #: those that it needs: an output its tiles
    digest: str = ""  #: fingerprint of everything that affects its result
    target: str = ""  #: of an input to be read: the path of its sorted copy
    #: ``waiting``, ``ready`` (an output whose tiles are done), ``done``, ``kept`` (from an earlier
    #: run) or ``failed``.
    state: str = "waiting"
    #: The result of its task, as saved in the work folder: counts, messages, outputs, cost,
    #: fingerprint.
    record: JsonObject = field(default_factory=dict)
    reason: str = ""  #: why it failed
    blocked: bool = False  #: an unreadable input is the reason

    @property
    def is_output(self) -> bool:
        """Return whether it is an output that is assembled from tiles."""
        return self.source is not None and self.outputs is not None

    def fail(self, reason: str, blocked: bool = False) -> None:
        """Mark it as failed."""
        self.state, self.reason, self.blocked = "failed", reason, blocked

    def fail_with(self, needed: Iterable[Job]) -> None:
        """Mark it as failed where any job that it needs has failed."""
        if reason := next((job.reason for job in needed if job.reason), ""):
            self.fail(reason)

    def to_dict(self) -> JsonObject:
        """Return what a report tells of it, as of all jobs."""
        reason = {"reason": self.reason} if self.reason else {}
        known = {k: v for k, v in self.record.items() if k not in ("fingerprint", "outputs")}
        return {"state": self.state, **known, **reason}


class InterruptedRun(KeyboardInterrupt):
    """Ctrl-C in a tiled run; `run` is what was done until then."""

    def __init__(self, run: TiledRun) -> None:
        super().__init__()
        self.run = run


@dataclass
class TiledRun:
    """The result of a run."""

    tiles: list[Job]
    outputs: list[Job]  #: empty where each tile is an output
    unreadable: dict[str, str]  #: unreadable inputs, and why
    changed: list[str]  #: files that changed during the run
    messages: list[str]  #: what the user should know
    summary: JsonObject  #: figures for people; see :meth:`to_dict`
    #: PDAL's, of a run in one piece, which has no tiles
    metadata: JsonObject | None = None

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Return what failed, and why: inputs, then tiles and outputs with other reasons."""
        jobs = [(f"tile {job.name}", job) for job in self.tiles]
        jobs += [(job.outputs[0], job) for job in self.outputs if job.outputs]
        return [
            *((p, why.removeprefix(f"{p}: ") + _BLOCKS) for p, why in self.unreadable.items()),
            *((path, _CHANGED) for path in self.changed),
            *((what, job.reason) for what, job in jobs if job.reason and not job.blocked),
        ]

    def to_dict(self) -> JsonObject:
        """Return a JSON-able report."""
        return {
            "pdal_stages": __version__,
            **self.summary,
            "messages": self.messages,
            "failures": [{"what": what, "reason": reason} for what, reason in self.failures],
            "tiles": [
                {"name": job.name, "tile": list(job.tile), "points": job.points}
                | job.to_dict()
                | ({"outputs": job.outputs} if job.outputs else {})
                for job in self.tiles
            ],
            "outputs": [
                {"input": job.source and job.source.path, "output": job.outputs} | job.to_dict()
                for job in self.outputs
            ],
        }


def summarize(
    tiles: list[Job], squares: list[Job], cpu_seconds: float, seconds: float
) -> JsonObject:
    """Return the figures of all tiles and squares of rounds, for :attr:`TiledRun.summary`."""
    worked = [job.record for job in tiles if job.state == "done"]
    classes: Counter[str] = Counter()
    point_counts: Counter[str] = Counter()
    for job in tiles:
        classes.update(job.record.get("classes") or {})
    for job in [*tiles, *squares]:
        point_counts.update(job.record.get("point_counts") or {})
    points, read, dropped = (
        sum(record.get(key, 0) for record in worked) for key in ("points", "read", "dropped")
    )
    return {
        "points": points,
        "points_read": read,
        "dropped": dropped,
        "seconds": seconds,
        "points_per_second": points / seconds if seconds else 0.0,
        "cpu_seconds": cpu_seconds,
        "states": {s: sum(job.state == s for job in tiles) for s in ("done", "kept", "failed")},
        "classes": dict(sorted(classes.items(), key=lambda item: int(item[0]))),
        "point_counts": dict(point_counts),
    }


def messages_of(
    tiles: list[Job], squares: list[Job], before: list[list[str]], most_points: int
) -> list[str]:
    """Return warnings and notes of tiles and earlier rounds, once each, frequent ones first."""
    done = [job for job in tiles if job.state == "done"]
    counts: Counter[str] = Counter()
    for lines in ([j.record.get("messages", []) for j in done if j.record.get("points")], before):
        for text, n in Counter(text for each in lines for text in set(each)).items():
            if not text.startswith((NO_POINT_MATCHES, NO_POLYGON_NEAR)):
                counts[text] += n
            elif n == len(lines):  # that there is nothing to do in some tiles is normal
                counts[text] = max(counts[text], n)
    # Messages of one stage that several stages report, too.
    for text in [text for text in counts if text.partition(": ")[2] in counts]:
        del counts[text]
    messages = [f"{text} ({count_of(n, 'tile')})" for text, n in counts.most_common(_MOST_MESSAGES)]
    if len(counts) > _MOST_MESSAGES:
        messages.append(f"and {len(counts) - _MOST_MESSAGES} more; see --report")
    if short := [job.name for job in [*done, *squares] if job.record.get("short")]:
        messages.append(
            f"{len(short)} tile{'s have' if len(short) > 1 else ' has'} points whose neighborhoods "
            "or terrain reach farther "
            f"than could be read within {most_points:,} points; they may differ from an untiled "
            "run: " + ", ".join(short[:5])
        )
    return messages + _shared_points(done)


def _shared_points(tiles: Sequence[Job]) -> list[str]:
    """Return a message about the pair of inputs that share most points, if any do."""
    pairs: Counter[tuple[str, str]] = Counter()
    for job in tiles:
        for path, other, count in job.record.get("shared", []):
            pairs[path, other] += count
    more = f" (so do {len(pairs) - 1:,} more pairs of files)" if len(pairs) > 1 else ""
    return [
        f"{first} and {other} both hold {count_of(count, 'point')} at the same place and time"
        f"{more}: all are written, but points look twice as dense there; leave one of the two out"
        for (first, other), count in pairs.most_common(1)
    ]


# ---- the working folder -------------------------------------------------------------------------

#: The folder beside the outputs.
FOLDER = ".pdal-stages"


#: How the files of arrays end, which tiles leave for outputs.
_ARRAYS = ".npz"


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
        return str(self.kept / f"{name}{_ARRAYS}")

    def finish(self, name: str, digest: str, record: JsonObject) -> None:
        """Save the record of a finished job.

        `digest` is the fingerprint of everything that affects it.
        """
        partial = self.kept / f"{name}.partial"
        partial.write_text(json.dumps({**record, "fingerprint": digest}))
        os.replace(partial, self._note(name))

    def forget(self, name: str) -> None:
        """Remove the record of a job that runs again: it must not match a newer file."""
        self._note(name).unlink(missing_ok=True)

    def note(self, name: str) -> JsonObject:
        """Return the record of a finished job with its fingerprint; empty without one."""
        try:
            record = strict_json(self._note(name).read_bytes())
            return record if isinstance(record, dict) else {}
        except (OSError, ValueError, RecursionError):
            return {}

    def finished(self, name: str, digest: str) -> JsonObject | None:
        """Return the record of a job if `digest` matches and the files it wrote are unchanged."""
        record = self.note(name)
        with contextlib.suppress(OSError, ValueError, TypeError):  # whatever is written there
            files = record.get("outputs", [])
            if record.get("fingerprint") == digest and all(map(_is_as_written, files)):
                return record
        return None

    def edited(self, name: str) -> list[str]:
        """Return the outputs of a finished job that were changed since it wrote them."""
        paths = []
        for entry in self.note(name).get("outputs", []):
            with contextlib.suppress(OSError, ValueError, TypeError):
                if len(entry) == _ENTRY and entry[3] and not _is_as_written(entry):
                    paths.append(str(entry[0]))
        return paths

    def left_over(self, outputs: Collection[str]) -> list[str]:
        """Return the outputs of earlier runs that are still there, but not among `outputs`."""
        paths: set[str] = set()
        for note in self.kept.glob("*.json"):
            with contextlib.suppress(TypeError, AttributeError, IndexError):
                entries = self.note(note.stem).get("outputs", [])
                paths.update(
                    str(entry[0]) for entry in entries if len(entry) == _ENTRY and entry[3]
                )
        return sorted(path for path in paths - {*outputs} if os.path.exists(path))

    def _note(self, name: str) -> Path:
        return self.kept / f"{name}.json"

    def remove(self, ending: str, but: Collection[str] = ()) -> None:
        """Remove the files with an ending, except those named in `but`."""
        for path in self.kept.glob(f"*{ending}"):
            if path.name not in but:
                path.unlink(missing_ok=True)


#: Values of a file in a record: its name, size, time, and digest.
_ENTRY = 4


def written(outputs: Sequence[str | os.PathLike]) -> list[list[Any]]:
    """Return names, sizes, times and digests of files just written, for a record.

    The run's own arrays, which nobody edits, have an empty digest.
    """
    entries = []
    for path in map(str, outputs):
        status = os.stat(path)
        digest = "" if path.endswith(_ARRAYS) else digest_of_file(path)
        entries.append([path, status.st_size, status.st_mtime_ns, digest])
    return entries


def _is_as_written(entry: Sequence[Any]) -> bool:
    """Return whether a file of a record holds what was written; OSError where it is gone.

    It is read only where its size or time differ, as after it was copied.
    """
    path, size, time_ns, digest = entry
    status = os.stat(path)
    if [status.st_size, status.st_mtime_ns] == [size, time_ns]:
        return True
    return bool(digest) and digest_of_file(path) == digest


def save_arrays(path: str | Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays into a file, whole or not at all."""
    with whole_files(path, what="result") as (partial,), open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: str | Path, only: Collection[str] | None = None) -> dict[str, NDArray]:
    """Return the arrays of a file by name, or those that are named in `only`.

    A file that cannot be read is removed, so that a later run makes it again.
    """
    with _opened(path) as file:
        return {name: file[name] for name in file.files if only is None or name in only}


class SavedArrays(LazyColumns):
    """The arrays of a file by name, each of which is read when it is asked for, and not kept."""

    def __init__(self, path: str | Path) -> None:
        """Read the names; StageError as of :func:`load_arrays`, here and later."""
        self._path = path
        with _opened(path) as file:
            self._names = file.files

    @property
    def names(self) -> Collection[str]:
        """Return the names of the arrays."""
        return self._names

    def __getitem__(self, name: str) -> NDArray:
        """Return an array."""
        return load_arrays(self._path, [name])[name]


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    """Open a file of arrays; one that cannot be read is removed."""
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            yield file
    except MemoryError:
        raise
    except Exception as error:  # zipfile and numpy raise many types
        Path(path).unlink(missing_ok=True)
        raise StageError(
            "a temporary result of the run cannot be read back, and was removed",
            found=f"{path}: {error}",
            cure="Run it again with --resume",
        ) from error
