"""Tiles and outputs of a run, and their results."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..base.messages import count_of
from ..base.version import __version__
from ..stages.points import NO_POINT_MATCHES, NO_POLYGON_NEAR

if TYPE_CHECKING:
    from .inputs import InputSource

#: Most distinct warnings of tiles that a run repeats.
_MOST_MESSAGES = 20
_CHANGED = (
    "it changed during the run, so outputs may hold results from before and after. Once it no "
    "longer changes, run "
    "it again with --resume"
)


@dataclass
class Job:
    """A task of a run and its state: a tile, an output to be assembled from tiles, or a task of the
    first round.
    """

    name: str  #: its key in the work folder
    points: int = 0  #: its own; 0 where unknown before it is read
    tile: tuple[int, int] = (0, 0)  #: of a tile or block: column and row
    source: InputSource | None = None  #: the input that an output is of
    #: files of the writers; None for a tile whose points go into outputs of input files
    outputs: list[str] | None = None
    jobs: list[Job] = field(default_factory=list)  #: the tiles that an output is assembled from
    mark: str = ""  #: fingerprint of everything that affects its result
    #: ``waiting``, ``ready`` (an output whose tiles are done), ``done``, ``kept`` (from an earlier
    #: run) or ``failed``.
    state: str = "waiting"
    #: The result of its task, as saved in the work folder: counts, messages, outputs, cost,
    #: fingerprint.
    record: dict[str, Any] = field(default_factory=dict)
    reason: str = ""  #: why it failed
    blocked_by: str = ""  #: the unreadable input that is the reason, if any

    @property
    def is_output(self) -> bool:
        """Whether it is an output that is assembled from tiles."""
        return self.source is not None and self.outputs is not None

    def fail(self, reason: str, blocked_by: str = "") -> None:
        """Mark it as failed."""
        self.state, self.reason, self.blocked_by = "failed", reason, blocked_by

    def fail_with(self, needed: Iterable[Job]) -> None:
        """Mark it as failed where any job that it needs has failed."""
        if reason := next((job.reason for job in needed if job.reason), ""):
            self.fail(reason)


class InterruptedRun(KeyboardInterrupt):
    """Ctrl-C in a tiled run; `run` is what was done until then."""

    def __init__(self, run: TiledRun) -> None:
        super().__init__()
        self.run = run


@dataclass
class TiledRun:
    """The result of a tiled run."""

    tiles: list[Job]
    outputs: list[Job]  #: empty where each tile is an output
    unreadable: dict[str, str]  #: unreadable inputs, and why
    changed: list[str]  #: files that changed during the run
    messages: list[str]  #: what the user should know
    summary: dict[str, Any]  #: figures for people; see :meth:`to_dict`
    #: objects of the outputs: their files, and counts by kind
    objects: dict[str, Any] | None = None
    #: PDAL's, of a run in one piece, which has no tiles
    metadata: dict[str, Any] | None = None

    @property
    def failures(self) -> list[tuple[str, str]]:
        """What failed, and why: inputs with the jobs that depend on them, then other tiles and
        outputs.
        """
        jobs = [(f"tile {job.name}", job) for job in self.tiles]
        jobs += [(job.outputs[0], job) for job in self.outputs if job.outputs]
        return [
            *(
                (p, why.removeprefix(f"{p}: ") + self._blocked_by(p))
                for p, why in self.unreadable.items()
            ),
            *((path, _CHANGED) for path in self.changed),
            *(
                (what, job.reason)
                for what, job in jobs
                if job.state == "failed" and not job.blocked_by
            ),
        ]

    def _blocked_by(self, path: str) -> str:
        """A remark on the jobs that depend on an unreadable input."""
        tiles, outputs = (
            sum(j.blocked_by == path for j in jobs) for jobs in (self.tiles, self.outputs)
        )
        if not tiles and not outputs:
            return ""
        return (
            f" ({count_of(tiles, 'tile')} and {count_of(outputs, 'output')} depend on it and are "
            "not made. Remove it from "
            "the inputs to make them without it)"
        )

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able report."""
        told = ("written", "classes", "seconds", "cpu_seconds", "peak_mb")
        return {
            "pdal_stages": __version__,
            **self.summary,
            "messages": self.messages,
            "failures": [{"what": what, "reason": reason} for what, reason in self.failures],
            "tiles": [
                {"name": j.name, "tile": list(j.tile), "state": j.state, "points": j.points}
                | {
                    k: v
                    for k, v in j.record.items()
                    if k != "fingerprint" and (k != "outputs" or j.outputs)
                }
                | ({"reason": j.reason} if j.reason else {})
                for j in self.tiles
            ],
            "outputs": [
                {"input": o.source and o.source.path, "output": o.outputs, "state": o.state}
                | ({"reason": o.reason} if o.reason else {})
                | {k: o.record[k] for k in told if k in o.record}
                for o in self.outputs
            ],
            **({"objects": self.objects} if self.objects else {}),
        }


def summarize(tiles: list[Job], cpu_seconds: float, seconds: float) -> dict[str, Any]:
    """Figures of all tiles together, for :attr:`TiledRun.summary`."""
    worked = [job.record for job in tiles if job.state == "done"]
    classes: Counter[str] = Counter()
    alone: Counter[str] = Counter()
    for job in tiles:
        classes.update(job.record.get("classes") or {})
        alone.update(job.record.get("left_alone") or {})

    def total(key: str) -> int:
        return sum(record.get(key, 0) for record in worked)

    return {
        "points": total("points"),
        "points_read": total("read"),
        "dropped": total("dropped"),
        "seconds": seconds,
        "points_per_second": total("points") / seconds if seconds else 0.0,
        "cpu_seconds": cpu_seconds,
        "states": {s: sum(job.state == s for job in tiles) for s in ("done", "kept", "failed")},
        "classes": dict(sorted(classes.items(), key=lambda item: int(item[0]))),
        "left_alone": dict(alone),
    }


def messages_on_folders(
    outputs: Iterable[str], inputs: Iterable[str], resumed: bool = False
) -> list[str]:
    """Return what the user should know of LAS and LAZ files that are in the folders of outputs
    before a run.

    Outputs that are there will be replaced, unless the run is `resumed` and may keep them; others
    stay.
    """
    names = {os.path.realpath(name) for name in outputs}
    known = names | {os.path.realpath(name) for name in inputs}
    there = {
        entry.path
        for folder in {os.path.dirname(name) for name in names}
        if os.path.isdir(folder)
        for entry in os.scandir(folder)
        if entry.name.lower().endswith((".las", ".laz")) and entry.is_file()
    }
    told = []
    if (replaced := names & there) and not resumed:
        told.append(
            f"{count_of(len(replaced), 'existing output file')} replaced: {_some(replaced)}"
        )
    if others := there - known:
        told.append(
            f"{count_of(len(others), 'LAS or LAZ file')} in the folder of the outputs not written "
            "by this run, left as "
            f"before: {_some(others)}"
        )
    return told


def _some(paths: Iterable[str]) -> str:
    """Return the names of a few files, in alphabetical order."""
    names = sorted(map(os.path.basename, paths))
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def messages_of(tiles: list[Job], before: list[list[str]], most_points: int) -> list[str]:
    """Warnings and notes of tiles and of the first round, once each, the most frequent first."""
    done = [job for job in tiles if job.state == "done"]
    found: Counter[str] = Counter()
    for lines in ([j.record.get("messages", []) for j in done if j.record.get("points")], before):
        for text, n in Counter(text for each in lines for text in set(each)).items():
            if not text.startswith((NO_POINT_MATCHES, NO_POLYGON_NEAR)):
                found[text] += n
            elif n == len(lines):  # that there is nothing to do in some tiles is normal
                found[text] = max(found[text], n)
    # Messages of one stage that several stages report, too.
    for text in [text for text in found if text.partition(": ")[2] in found]:
        del found[text]
    told = [f"{text} ({count_of(n, 'tile')})" for text, n in found.most_common(_MOST_MESSAGES)]
    if len(found) > _MOST_MESSAGES:
        told.append(f"and {len(found) - _MOST_MESSAGES} more; see --report")
    if short := [job.name for job in done if job.record.get("short")]:
        told.append(
            f"{len(short)} tile{'s have' if len(short) > 1 else ' has'} points whose neighborhoods "
            "or terrain reach farther "
            f"than could be read within {most_points:,} points; they may differ from an untiled "
            "run: " + ", ".join(short[:5])
        )
    return told
