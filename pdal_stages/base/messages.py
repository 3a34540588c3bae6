"""What the user is told: reports of runs, and texts that are safe for terminals."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, TextIO

from .json_types import JsonObject

#: Control characters, and those that change the direction of text, but for tabs and line breaks.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """Return a text with its control characters escaped, except line breaks and tabs."""
    return _CONTROLS.sub(lambda match: ascii(match.group())[1:-1], text)


def one_line(text: str) -> str:
    """Return a text on one line, escaped, so that a file name cannot look like separate lines."""
    return plain(text).replace("\n", "\\n")


def shorten(text: str, most: int = 200) -> str:
    """Return a text of at most about `most` characters, and how long it was where it is cut."""
    return text if len(text) <= most else f"{text[:most]}... ({len(text):,} characters)"


class Topic(Enum):
    """Subjects of messages that decide who shows them."""

    OTHER = "other"
    #: a file as it is read: runs in tiles report on the inputs, not on what is cut from these
    INPUT = "input"
    #: inputs without a spatial reference beside others that have one
    NO_REFERENCE = "no reference"
    METERS_ASSUMED = "meters assumed"  #: which a message about the inputs may say better
    #: no point or polygon meets a condition: normal in a tile, and reported if it holds for all
    NOTHING_MATCHES = "nothing matches"
    OTHER_DENSITY = "other density"  #: than that of the clouds the model was trained on
    SCORE = "score"  #: of a model that was trained, which is described afterwards


@dataclass(frozen=True)
class Message:
    """A text for the user, and what is known about it."""

    text: str
    topic: Topic = Topic.OTHER
    place: str = ""  #: the stage that reports it; empty for others, and where several do

    def __str__(self) -> str:
        """Return the text after the name of its stage."""
        return f"{self.place}: {self.text}" if self.place else self.text

    def to_json(self) -> list[str]:
        """Return the values, as JSON can hold them."""
        return [self.text, self.topic.value, self.place]

    @classmethod
    def from_json(cls, text: str, topic: str, place: str) -> Message:
        """Return a message that was saved; ValueError for an unknown topic."""
        return cls(text, Topic(topic), place)


def drop_repeated(messages: Iterable[Message]) -> list[Message]:
    """Return messages but those of a stage that are there without its name, too."""
    several = dict.fromkeys(messages)
    return [m for m in several if not m.place or replace(m, place="") not in several]


def print_messages(*lines: str | Message) -> None:
    """Print messages for the user on standard error, each on one line."""
    for line in lines:
        print(f"pdal-stages: {one_line(str(line))}", file=sys.stderr)


def count_of(count: int, word: str) -> str:
    """Return a number of things in words: ``1 tile``, ``1,200 tiles``."""
    return f"{count:,} {word}{'s' * (count != 1)}"


def duration(seconds: float) -> str:
    """Return a time in seconds, from two minutes on in minutes, later in hours: ``3 h 20 min``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


class PlainStream:
    """A text stream that passes text through :func:`plain` and delegates everything else."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write the escaped text; return the number of characters before escaping."""
        self.stream.write(plain(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the stream underneath."""
        return getattr(self.stream, name)


class Count:
    """A number of points that a stage reports; an attribute of its class, which names it.

    Tiles add it up, and `classify` prints it.
    """

    name: str

    def __init__(self, words: str) -> None:
        self.words = words  #: which points these are

    def __set_name__(self, owner: type, name: str) -> None:
        """Take the attribute's name."""
        self.name = name


@dataclass
class Report:
    """Counts, notes and warnings of a run."""

    #: JSON-able values by name, e.g. ``points`` or ``classes``
    figures: JsonObject = field(default_factory=dict)
    counts: dict[Count, int] = field(default_factory=dict)  #: which are among the figures, too
    notes: list[Message] = field(default_factory=list)  #: what one should know; nothing is wrong
    warnings: list[Message] = field(default_factory=list)  #: what is likely wrong, and the cure
    #: By neighborhood, the points whose nearest neighbors lay farther away than the halo: in a tile
    #: of that halo their values may differ from those of the whole cloud.
    beyond_halo: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0  #: meters to the farthest of these neighbors; not in the metadata
    #: number of points of each class code, after a stage that gives classes; not in the metadata
    codes: dict[str, int] | None = None

    def note(self, text: str, topic: Topic = Topic.OTHER) -> None:
        """Report what the user should know."""
        self.notes.append(Message(text, topic))

    def warn(self, text: str, topic: Topic = Topic.OTHER) -> None:
        """Report what is likely wrong."""
        self.warnings.append(Message(text, topic))

    def merge(self, other: Report) -> None:
        """Merge another report into this one. Existing figures stay; dicts are merged by key.

        ``counts`` and ``codes`` are not merged: they are those of a stage's own report.
        """
        _merge(self.figures, other.figures)
        _merge(self.beyond_halo, other.beyond_halo)
        self.reach = max(self.reach, other.reach)
        for texts, more in ((self.notes, other.notes), (self.warnings, other.warnings)):
            texts += [text for text in more if text not in texts]

    @property
    def messages(self) -> list[Message]:
        """Warnings, then notes."""
        return [*self.warnings, *self.notes]

    def to_dict(self) -> JsonObject:
        """Return the metadata: figures and, if any, ``beyond_halo``, ``warning`` and ``note``."""
        texts = {"warning": self.warnings, "note": self.notes}
        return (
            self.figures
            | ({"beyond_halo": self.beyond_halo} if self.beyond_halo else {})
            | {name: ". ".join(map(str, lines)) for name, lines in texts.items() if lines}
        )


def _merge(target: JsonObject, source: JsonObject) -> None:
    for name, value in source.items():
        if isinstance(value, dict) and isinstance(target.get(name), dict):
            target[name] = {**value, **target[name]}
        else:
            target.setdefault(name, dict(value) if isinstance(value, dict) else value)
