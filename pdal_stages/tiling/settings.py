"""How a pipeline is run in tiles."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ..base import checks
from ..base.errors import OptionError
from ..base.threads import available_threads

#: Ways to cut the output.
PER = ("auto", "file", "tile")


@dataclass(frozen=True)
class TilingOptions:
    """How a pipeline is run in tiles.

    Attributes
    ----------
    tile : float, optional
        Side of a tile, in the unit of the coordinates. By default as large as the memory allows.
    workers : int, optional
        Worker processes; 0 works in this process. Default: one for every two cores.
    scheduler : str
        Address of a running Dask scheduler (``tcp://host:8786``) instead of processes on this machine.
    per : str
        ``file`` writes one output for each input file, in that file's order of points; ``tile`` one for each
        tile; ``auto`` is ``file`` for LAS and LAZ inputs and ``tile`` for others.
    buffer : float, optional
        Meters of halo each tile is read with, for PDAL filters that look at neighbors; it is added
        to what our stages ask for.
    memory : int, optional
        Bytes that all processes of this machine together may hold; of a run on a scheduler, each worker. Default: half of
        what is free.
    resume : bool
        Keep what an earlier run finished.
    most_points : int
        A tile whose neighborhoods turn out to reach farther than its halo is read again with a
        wider one, up to so many points.
    """

    tile: float | None = None
    workers: int | None = None
    scheduler: str = ""
    per: str = "auto"
    buffer: float | None = None
    memory: int | None = None
    resume: bool = False
    most_points: int = 5_000_000

    def __post_init__(self) -> None:
        # 20 and 20.0 are one run
        if self.tile is not None:
            object.__setattr__(self, "tile", checks.number("--tile", self.tile, 0, above=True))
        if self.memory is not None:
            checks.whole("--memory", self.memory, 1, unit="bytes")
        if self.workers is not None:
            checks.whole("--workers", self.workers, 0)
        if self.scheduler and "inproc" not in self.scheduler and not re.search(r":\d+$", self.scheduler):
            raise OptionError(
                "--scheduler needs an address with its port",
                found=self.scheduler,
                cure="For example tcp://localhost:8786",
            )
        if self.workers is not None and self.scheduler:
            raise OptionError(
                "--workers starts processes on this machine, and --scheduler uses others",
                cure="Give one of them",
            )
        checks.one_of("--per", self.per, PER)
        if self.buffer is not None:
            checks.number("--buffer", self.buffer, 0, unit="meters")
        cores = available_threads()
        if self.workers is not None and self.workers > cores:
            raise OptionError(
                "there are more workers than cores",
                found=f"{self.workers} workers, {cores} cores",
                cure=f"Give --workers {cores} or fewer",
            )

    @property
    def local_workers(self) -> int:
        """Worker processes on this machine."""
        return max(1, available_threads() // 2) if self.workers is None else self.workers

    @property
    def threads(self) -> int:
        """Threads of each local worker: workers times threads never exceed the cores."""
        return max(1, available_threads() // max(1, self.local_workers))
