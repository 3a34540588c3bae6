"""Tiles and outputs of a run, and what became of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.version import __version__
from .sources import InputSource

#: Points that did not get a class from the classifier, or another one, by their names in the reports of stages.
LEFT_ALONE = {
    "rejected": "rejected as unreliable",
    "ignored": "left out: noise, withheld (ignore)",
    "kept": "class kept (keep)",
    "outside_where": "outside where",
    "decks": "put on bridge decks (bridges)",
    "wires": "found to be wires (wires)",
    "towers": "found to be towers and poles (wires)",
    "changed": "mended by rules (consistency)",
}


def left_alone(reports: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Their numbers, as the last stage says that counts them; `filters.objects` calls something else "decks"."""
    return {
        key: one[key] for one in reports for key in LEFT_ALONE if isinstance(one.get(key), int) and one[key]
    }


@dataclass
class Costs:
    """What the tasks of a run took, tries that failed too, by step: ``index``, ``first_rounds``, ``tiles``, ``outputs``."""

    cpu_seconds: dict[str, float] = field(default_factory=dict)
    peak_mb: float = 0.0  #: the most memory that a process held

    def add(self, step: str, cost: Mapping[str, float]) -> None:
        """A task was done, or failed."""
        self.cpu_seconds[step] = self.cpu_seconds.get(step, 0.0) + cost.get("cpu_seconds", 0.0)
        self.peak_mb = max(self.peak_mb, cost.get("peak_mb", 0.0))


@dataclass(kw_only=True)
class _Work:
    """What became of a tile or an output."""

    #: ``waiting``, ``ready`` (an output whose tiles are done), ``done``, ``kept`` (from an earlier run) or ``failed``.
    state: str = "waiting"
    #: What its task says of it, as it is kept in the work folder: counts, messages, outputs, cost, fingerprint.
    record: dict[str, Any] = field(default_factory=dict)
    reason: str = ""  #: why it failed
    blocked_by: str = ""  #: the unreadable input that it failed for, where that is the reason


@dataclass
class TileJob(_Work):
    """A tile to run."""

    tile: tuple[int, int]
    name: str
    points: int  #: its own; 0 where not known before it is read
    sources: list[InputSource]  #: inputs that may hold points of it or its halo
    outputs: list[str] | None = None  #: what the writers write, where each tile is an output


@dataclass
class FileJob(_Work):
    """An input file whose output is put together from tiles."""

    source: InputSource
    outputs: list[str]
    points: int = 0  #: of the input
    jobs: list[TileJob] = field(default_factory=list)


_CHANGED = (
    "it changed while it was worked on, so outputs may hold results from before and after. Once it stays as it is, "
    "run it again with --resume"
)


class InterruptedRun(KeyboardInterrupt):
    """Ctrl-C in a tiled run; `run` says what it did until then."""

    def __init__(self, run: TiledRun) -> None:
        super().__init__()
        self.run = run


@dataclass(frozen=True)
class FoundObjects:
    """Objects that were found in the outputs: the files they were written to, counts by kind, and a map (h, w, 3)."""

    files: list[str]
    kinds: dict[str, dict[str, Any]]
    picture: NDArray[np.uint8] | None = None


@dataclass
class TiledRun:
    """What a tiled run did.

    Attributes
    ----------
    tiles : list of TileJob
    outputs : list of FileJob
        Empty where each tile is an output.
    unreadable : dict of str to str
        Inputs that could not be read, and why.
    changed : list of str
        Files that changed while they were worked on.
    messages : list of str
        What the user should know.
    summary : dict
        Figures for people; see :meth:`to_dict`.
    objects : FoundObjects, optional
        Those of the outputs, where they were asked for.
    """

    tiles: list[TileJob]
    outputs: list[FileJob]
    unreadable: dict[str, str]
    changed: list[str]
    messages: list[str]
    summary: dict[str, Any]
    objects: FoundObjects | None = None

    @property
    def failures(self) -> list[tuple[str, str]]:
        """What failed, and why: inputs with all that waits for them, then other tiles and outputs."""
        found = [
            (path, reason.removeprefix(f"{path}: ") + self._blocked_by(path))
            for path, reason in self.unreadable.items()
        ]
        failed = [(f"tile {job.name}", job) for job in self.tiles] + [(o.outputs[0], o) for o in self.outputs]
        found += [(path, _CHANGED) for path in self.changed]
        return found + [
            (what, item.reason) for what, item in failed if item.state == "failed" and not item.blocked_by
        ]

    def _blocked_by(self, path: str) -> str:
        """What was not made because an input cannot be read, in words."""
        tiles = sum(job.blocked_by == path for job in self.tiles)
        outputs = [Path(out.outputs[0]).name for out in self.outputs if out.blocked_by == path]
        parts = [f"{tiles} tile{'s' * (tiles != 1)} there"] if tiles else []
        parts += [*outputs[:5], *([f"{len(outputs) - 5} more outputs"] if len(outputs) > 5 else [])]
        if not parts:
            return ""
        cure = ". They are made without it where it is moved out of the inputs" if tiles else ""
        return f" (not made because of it: {', '.join(parts)}{cure})"

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able report."""
        return {
            "pdal_stages": __version__,
            **self.summary,
            "messages": self.messages,
            "failures": [{"what": what, "reason": reason} for what, reason in self.failures],
            "tiles": [
                {"name": j.name, "tile": list(j.tile), "state": j.state, "points": j.points}
                | {k: v for k, v in j.record.items() if k != "fingerprint"}
                | ({"reason": j.reason} if j.reason else {})
                for j in self.tiles
            ],
            "outputs": [
                {"input": o.source.path, "output": o.outputs, "state": o.state}
                | ({"reason": o.reason} if o.reason else {})
                | {
                    k: o.record[k]
                    for k in ("written", "classes", "seconds", "cpu_seconds", "peak_mb")
                    if k in o.record
                }
                for o in self.outputs
            ],
            **({"objects": {"files": self.objects.files, **self.objects.kinds}} if self.objects else {}),
        }


def summarize(tiles: list[TileJob], costs: Costs, seconds: float) -> dict[str, Any]:
    """Figures of all tiles and tasks together, for :attr:`TiledRun.summary`."""
    worked = [job for job in tiles if job.state == "done"]
    classes: dict[str, int] = {}
    for job in tiles:
        for code, count in (job.record.get("classes") or {}).items():
            classes[code] = classes.get(code, 0) + count

    def total(key: str) -> int:
        return sum(job.record.get(key, 0) for job in worked)

    return {
        "points": total("points"),
        "points_read": total("read"),
        "dropped": total("dropped"),
        "seconds": seconds,
        "points_per_second": total("points") / seconds if seconds else 0.0,
        "cpu_seconds": sum(costs.cpu_seconds.values()),
        "cpu_seconds_by_step": costs.cpu_seconds,
        "peak_mb_of_a_worker": costs.peak_mb,
        "states": {s: sum(job.state == s for job in tiles) for s in ("done", "kept", "failed")},
        "classes": dict(sorted(classes.items(), key=lambda item: int(item[0]))),
        "left_alone": {
            key: n
            for key in LEFT_ALONE
            if (n := sum(j.record.get("left_alone", {}).get(key, 0) for j in tiles))
        },
    }
