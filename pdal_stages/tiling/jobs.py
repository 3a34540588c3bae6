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
from dataclasses import KW_ONLY, dataclass, field, fields
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..base.checks import strict_json
from ..base.columns import LazyColumns
from ..base.errors import StageError
from ..base.files import make_own_folder, try_lock, whole_files
from ..base.hashing import fingerprint
from ..base.json_types import JsonObject
from ..base.messages import Message, Topic, count_of, drop_repeated
from ..base.version import __version__
from ..pipeline.workers import Cost
from .inputs import CloudIndex, InputSource
from .records import (
    ARRAYS,
    FilesRecord,
    JobRecord,
    OutputRecord,
    RunGrids,
    TileRecord,
    written_files,
)

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


#: ``ready`` are outputs whose tiles are done, ``kept`` are results of an earlier run.
JobState = Literal["waiting", "ready", "done", "kept", "failed"]


@dataclass
class Job:
    """A task of a run and its state; subclasses tell what the task is about."""

    name: str  #: its key in the work folder
    points: int = 0  #: its own; 0 where unknown before it is read
    _: KW_ONLY
    #: files of the writers; None where its results go into outputs of other jobs
    outputs: list[str] | None = None
    needs: list[Job] = field(default_factory=list)  #: jobs before: tiles of an output
    digest: str = ""  #: of everything that affects its result
    state: JobState = "waiting"
    record: JobRecord | None = None  #: once it is done
    record_type: type[JobRecord] = FilesRecord
    cost: Cost | None = None  #: of its task
    reason: str = ""  #: why it failed
    failure: type[Exception] | None = None  #: the error of its task
    blocked: bool = False  #: an unreadable input is the reason

    def fail(self, reason: str, blocked: bool = False) -> None:
        """Mark it as failed."""
        self.state, self.reason, self.blocked = "failed", reason, blocked

    def fail_with_needed(self) -> None:
        """Mark it as failed where any job that it needs has failed."""
        if reason := next((job.reason for job in self.needs if job.reason), ""):
            self.fail(reason)

    def keep(self, saved: JsonObject) -> None:
        """Mark it as kept from an earlier run, with what that saved, if this version reads it."""
        self.state = "kept"
        with contextlib.suppress(TypeError, KeyError, ValueError):
            self.record = self.record_type.from_json(saved)
            self.cost = Cost(**{each.name: saved[each.name] for each in fields(Cost)})

    def to_json(self) -> JsonObject:
        """Return its record and what it took, as they are saved."""
        record = {} if self.record is None else self.record.to_json()
        return record | ({} if self.cost is None else vars(self.cost))

    def to_dict(self) -> JsonObject:
        """Return what a report tells of it, as of all jobs."""
        reason = {"reason": self.reason} if self.reason else {}
        record = {} if self.record is None else self.record.to_report()
        cost = {} if self.cost is None else vars(self.cost)
        return {"state": self.state, **record, **cost, **reason}


@dataclass
class InputJob(Job):
    """Read an input and sort its points."""

    _: KW_ONLY
    source: InputSource
    record: CloudIndex | None = None
    record_type: type[CloudIndex] = CloudIndex


@dataclass
class TileJob(Job):
    """Run a round on a tile, or on a square of tiles."""

    tile: tuple[int, int] = (0, 0)  #: column and row
    _: KW_ONLY
    record: TileRecord | None = None
    record_type: type[TileRecord] = TileRecord

    @property
    def is_short(self) -> bool:
        """Return whether its halo was too narrow, and could not be widened."""
        return self.record is not None and self.record.short


@dataclass
class BlockJob(Job):
    """Compute a block of the raster of a far-reaching stage."""

    block: tuple[int, int] = (0, 0)  #: column and row


@dataclass
class OutputJob(Job):
    """Assemble an output from tiles."""

    _: KW_ONLY
    source: InputSource  #: the input that it is of
    record: OutputRecord | None = None
    record_type: type[OutputRecord] = OutputRecord


#: A job that may write outputs.
WritingJob = TileJob | OutputJob


class InterruptedRun(KeyboardInterrupt):
    """Ctrl-C in a tiled run; `run` is what was done until then."""

    def __init__(self, run: TiledRun) -> None:
        super().__init__()
        self.run = run


@dataclass
class TiledRun:
    """The result of a run."""

    tiles: list[TileJob]
    outputs: list[OutputJob]  #: empty where each tile is an output
    unreadable: dict[str, str]  #: unreadable inputs, and why
    changed: list[str]  #: files that changed during the run
    messages: list[str]  #: what the user should know
    summary: JsonObject  #: figures for people; see :meth:`to_dict`
    #: PDAL's, of a run in one piece, which has no tiles
    metadata: JsonObject | None = None

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Return what failed, and why: inputs, then tiles and outputs with other reasons."""
        jobs: list[tuple[str, Job]] = [(f"tile {job.name}", job) for job in self.tiles]
        jobs += [(job.outputs[0], job) for job in self.outputs if job.outputs]
        return [
            *((path, why + _BLOCKS) for path, why in self.unreadable.items()),
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
                {"input": job.source.path, "output": job.outputs} | job.to_dict()
                for job in self.outputs
            ],
        }


def _records_of(jobs: Iterable[TileJob]) -> list[TileRecord]:
    """Return the records of the jobs that have one."""
    return [job.record for job in jobs if job.record is not None]


def summarize(
    tiles: list[TileJob], squares: list[TileJob], cpu_seconds: float, seconds: float
) -> JsonObject:
    """Return the figures of all tiles and squares of rounds, for :attr:`TiledRun.summary`."""
    worked = _records_of(job for job in tiles if job.state == "done")
    classes: Counter[str] = Counter()
    point_counts: Counter[str] = Counter()
    for record in _records_of(tiles):
        classes.update(record.classes)
    for record in _records_of([*tiles, *squares]):
        point_counts.update(record.point_counts)
    points = sum(record.points for record in worked)
    return {
        "points": points,
        "points_read": sum(record.read for record in worked),
        "dropped": sum(record.dropped for record in _records_of(tiles)),
        "seconds": seconds,
        "points_per_second": points / seconds if seconds else 0.0,
        "cpu_seconds": cpu_seconds,
        "states": {s: sum(job.state == s for job in tiles) for s in ("done", "kept", "failed")},
        "classes": dict(sorted(classes.items(), key=lambda item: int(item[0]))),
        "point_counts": dict(point_counts),
    }


def messages_of(
    tiles: list[TileJob],
    rounds: Sequence[list[TileJob]],
    inputs: Sequence[Message],
    most_points: int,
) -> list[str]:
    """Return the messages about inputs, then those of tiles and of squares of the rounds before.

    These come once each, frequent ones first, whether this run or an earlier one did the tiles.
    That nothing matches is told where it holds for a whole round.
    """
    counts: Counter[Message] = Counter()
    for jobs in (tiles, *rounds):
        records = [record for record in _records_of(jobs) if record.points]
        lines = (each for record in records for each in dict.fromkeys(record.messages))
        for message, n in Counter(lines).items():
            if message.topic is not Topic.NOTHING_MATCHES:
                counts[message] += n
            elif n == len(records):
                counts[message] = max(counts[message], n)
    shown = Counter({message: counts[message] for message in drop_repeated(counts)})
    if any(each.topic is Topic.NO_REFERENCE for each in inputs):  # it tells what is assumed
        for message in [each for each in shown if each.topic is Topic.METERS_ASSUMED]:
            del shown[message]
    messages = [*map(str, inputs)]
    messages += [f"{m} ({count_of(n, 'tile')})" for m, n in shown.most_common(_MOST_MESSAGES)]
    if len(shown) > _MOST_MESSAGES:
        messages.append(f"and {len(shown) - _MOST_MESSAGES} more; see --report")
    if short := [job.name for job in [*tiles, *chain(*rounds)] if job.is_short]:
        messages.append(
            f"{len(short)} tile{'s have' if len(short) > 1 else ' has'} points whose neighborhoods "
            f"or terrain reach farther than the next files, or {most_points:,} points; they may "
            "differ from an untiled run: " + ", ".join(short[:5])
        )
    return messages + _shared_points(_records_of(tiles))


def _shared_points(tiles: Sequence[TileRecord]) -> list[str]:
    """Return a message about the pair of inputs that share most points, if any do."""
    pairs: Counter[tuple[str, str]] = Counter()
    for shared in (shared for record in tiles for shared in record.shared):
        pairs[shared.path, shared.other] += shared.points
    more = f" (so do {len(pairs) - 1:,} more pairs of files)" if len(pairs) > 1 else ""
    return [
        f"{first} and {other} both hold {count_of(count, 'point')} at the same place and time"
        f"{more}: all are written, but points look twice as dense there; leave one of the two out"
        for (first, other), count in pairs.most_common(1)
    ]


# ---- the working folder -------------------------------------------------------------------------

#: The folder beside the outputs.
FOLDER = ".pdal-stages"


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
        return str(self.kept / f"{name}{ARRAYS}")

    def finish(self, name: str, content: JsonObject, digest: str = "") -> None:
        """Save what a job that is done tells of itself, and the digest of all that affects it.

        A check of all this tells later whether it is what was saved.
        """
        partial, record = self.kept / f"{name}.partial", {**content, "fingerprint": digest}
        partial.write_text(json.dumps({**record, "check": fingerprint(record)}))
        os.replace(partial, self._note(name))

    def forget(self, name: str) -> None:
        """Remove the record of a job that runs again: it must not match a newer file."""
        self._note(name).unlink(missing_ok=True)

    def note(self, name: str) -> JsonObject:
        """Return the record of a finished job as it was saved; empty where it is not that."""
        record = self._saved(name)
        check = record.pop("check", None)
        return record if check == fingerprint(record) else {}

    def grids(self) -> RunGrids | None:
        """Return the grids of the run before; None where it is not known."""
        with contextlib.suppress(TypeError):
            return RunGrids.from_json(self.note("run"))
        return None

    def record(self, name: str, digest: str) -> JsonObject | None:
        """Return the record of a job if `digest` matches, whatever became of its files."""
        record = self.note(name)
        return record if record.get("fingerprint") == digest else None

    def finished(self, name: str, digest: str) -> JsonObject | None:
        """Return the record of a job if `digest` matches and the files it wrote are unchanged."""
        record = self.record(name, digest)
        with contextlib.suppress(OSError):  # a file is gone
            if record and all(file.is_unchanged for file in written_files(record)):
                return record
        return None

    def edited(self, name: str) -> list[str]:
        """Return the outputs of a finished job that were changed since it wrote them."""
        paths = []
        with contextlib.suppress(TypeError):
            for file in written_files(self._saved(name)):
                with contextlib.suppress(OSError, ValueError, TypeError):
                    if file.digest and not file.is_unchanged:
                        paths.append(str(file.path))
        return paths

    def left_over(self, outputs: Collection[str]) -> list[str]:
        """Return the outputs of earlier runs that are still there, but not among `outputs`."""
        paths: set[str] = set()
        for note in self.kept.glob("*.json"):
            with contextlib.suppress(TypeError):
                files = written_files(self._saved(note.stem))
                paths.update(str(file.path) for file in files if file.digest)
        return sorted(path for path in paths - {*outputs} if os.path.exists(path))

    def _saved(self, name: str) -> JsonObject:
        """Return what is saved of a job, by any version and damaged or not; empty for no object."""
        try:
            record = strict_json(self._note(name).read_bytes())
            return record if isinstance(record, dict) else {}
        except (OSError, ValueError, RecursionError):
            return {}

    def _note(self, name: str) -> Path:
        return self.kept / f"{name}.json"

    def remove(self, ending: str, but: Collection[str] = ()) -> None:
        """Remove the files with an ending, except those named in `but`."""
        for path in self.kept.glob(f"*{ending}"):
            if path.name not in but:
                path.unlink(missing_ok=True)


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
