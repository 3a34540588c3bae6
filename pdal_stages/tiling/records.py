"""What tasks return about their results, saved in the work folder beside the arrays, as JSON."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

from ..base.hashing import digest_of_file
from ..base.json_types import JsonObject
from ..base.messages import Message

#: How the files of arrays end, which tiles leave for outputs.
ARRAYS = ".npz"
_Record = TypeVar("_Record", bound="JobRecord")


class WrittenFile(NamedTuple):
    """A file that a task has written."""

    path: str
    size: int
    time_ns: int
    digest: str  #: empty for the run's own arrays, which nobody edits

    @property
    def is_unchanged(self) -> bool:
        """Return whether it holds what was written; OSError where it is gone.

        It is read only where its size or time differ, as after it was copied.
        """
        status = os.stat(self.path)
        if (status.st_size, status.st_mtime_ns) == (self.size, self.time_ns):
            return True
        return bool(self.digest) and digest_of_file(self.path) == self.digest


def describe_written(paths: Iterable[str | os.PathLike]) -> list[WrittenFile]:
    """Return the descriptions of files just written."""
    described = []
    for path in map(str, paths):
        status = os.stat(path)
        digest = "" if path.endswith(ARRAYS) else digest_of_file(path)
        described.append(WrittenFile(path, status.st_size, status.st_mtime_ns, digest))
    return described


def written_files(saved: JsonObject) -> list[WrittenFile]:
    """Return the files that a saved record of any kind tells of; TypeError where it is damaged."""
    return [WrittenFile(*entry) for entry in saved.get("outputs", ())]


class JobRecord:
    """Base of records, which are dataclasses: their fields are saved by name."""

    def to_json(self) -> JsonObject:
        """Return the fields that are not None, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def to_report(self) -> JsonObject:
        """Return what a report tells of it."""
        return {name: value for name, value in self.to_json().items() if name != "outputs"}

    @classmethod
    def from_json(cls: type[_Record], saved: JsonObject) -> _Record:
        """Return the record that was saved, among other things; TypeError where it is damaged."""
        names = [field.name for field in fields(cls)]  # type: ignore[arg-type]
        return cls(**{name: saved[name] for name in names if name in saved})


@dataclass
class FilesRecord(JobRecord):
    """The files that a task wrote."""

    outputs: Sequence[WrittenFile]

    def __post_init__(self) -> None:
        """Take files as JSON holds them, too."""
        self.outputs = [WrittenFile(*entry) for entry in self.outputs]


@dataclass
class OutputRecord(FilesRecord):
    """The outputs of an input file, or of a tile."""

    written: int | None = None  #: points in them; None where there are no outputs
    classes: Mapping[str, int] | None = None  #: points by class code


class SharedPoints(NamedTuple):
    """Two inputs that hold the same points."""

    path: str
    other: str
    points: int


@dataclass
class TileRecord(JobRecord):
    """A tile that ran."""

    points: int  #: of the tile
    read: int  #: with its halo
    halo_m: float  #: that was used
    short: bool  #: whether that was too narrow
    widened: bool  #: whether it is wider than planned
    dropped: int  #: points that stages removed
    classes: Mapping[str, int]  #: points by class code
    messages: Sequence[Message]
    point_counts: Mapping[str, int]  #: by ``type.name``
    shared: Sequence[SharedPoints]
    outputs: Sequence[WrittenFile] = ()  #: or the file of the arrays
    written: int | None = None  #: points in outputs of its own

    def __post_init__(self) -> None:
        """Take files and shared points as JSON holds them, too."""
        self.shared = [SharedPoints(*entry) for entry in self.shared]
        self.outputs = [WrittenFile(*entry) for entry in self.outputs]

    def to_json(self) -> JsonObject:
        """Return the fields that are not None, by name."""
        return super().to_json() | {"messages": [each.to_json() for each in self.messages]}

    def to_report(self) -> JsonObject:
        """Return what a report tells of it."""
        return super().to_report() | {"messages": [*map(str, self.messages)]}

    @classmethod
    def from_json(cls, saved: JsonObject) -> TileRecord:
        """Return the record that was saved; TypeError or ValueError where it is damaged."""
        messages = [Message.from_json(*entry) for entry in saved.get("messages", ())]
        return super().from_json({**saved, "messages": messages})


@dataclass(frozen=True)
class RunGrids(JobRecord):
    """The grids of a run, for one that resumes it with another amount of free memory."""

    tile: float  #: side of tiles, in the unit of the coordinates
    origin: float  #: x and y of a corner
    square: int  #: tiles along the side of a square
