"""How fast runs in tiles were on this machine: kept in the user's cache folder, for the estimate of a dry run."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..base import strictjson
from ..base.errors import StageError
from ..base.files import write_whole
from ..base.version import __version__
from .outcome import TiledRun
from .store import fingerprint

#: What a point that is only read costs, as a share of one whose results are made.
BESIDE = 0.16
#: Points that a run must have worked on to be believed, points of a tile, and runs that are remembered.
_ENOUGH, _ENOUGH_OF_TILE, _MOST = 200_000, 20_000, 50
_LARGEST = 1 << 20


@dataclass(frozen=True)
class MeasuredPace:
    """What a run took."""

    tile_seconds: float  #: of a core for a point of its own tile; see :data:`BESIDE` for the others
    other_seconds: float  #: of a core for a point before the tiles and in outputs
    points: int  #: of the run
    day: str  #: when it was

    def core_seconds(self, own: float, beside: float) -> float:
        """What so many points will take, and so many that tiles read around them."""
        return (own + BESIDE * beside) * self.tile_seconds + own * self.other_seconds


#: Where no run was measured: the model that comes with the package (benchmarks/interior.py).
ASSUMED = MeasuredPace(8.0e-6, 5.0e-6, 0, "")


def remember(run: TiledRun, head: list[dict[str, Any]]) -> None:
    """Keep the pace of a run, where there was enough of it; it is no harm if it cannot be kept."""
    if (pace := pace_of(run)) is None:
        return
    with contextlib.suppress(OSError, StageError, ValueError, RuntimeError):  # one may have no home
        path = _path()
        known = _known()
        known.pop(_key(head), None)
        known = dict(list(known.items())[1 - _MOST :]) | {_key(head): asdict(pace)}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(known, indent=1).encode(), "note")


def pace_of(run: TiledRun) -> MeasuredPace | None:
    """The pace of a run; its first tiles loaded and compiled, so the middle one of all is taken."""
    records = [job.record for job in run.tiles if job.state == "done"]
    each = [
        one["cpu_seconds"] / (one["points"] + BESIDE * (one["read"] - one["points"]))
        for one in records
        if one.get("points", 0) >= _ENOUGH_OF_TILE and one.get("cpu_seconds")
    ]
    points = sum(one.get("points", 0) for one in records)
    if points < _ENOUGH or not each:
        return None
    steps = run.summary["cpu_seconds_by_step"]
    other = sum(seconds for step, seconds in steps.items() if step != "tiles")
    return MeasuredPace(statistics.median(each), other / points, points, time.strftime("%Y-%m-%d"))


def pace_before(head: list[dict[str, Any]]) -> MeasuredPace:
    """The pace of the last run of the same stages and models here; otherwise what is assumed."""
    with contextlib.suppress(ValueError, TypeError, KeyError):
        found = _known()[_key(head)]
        pace = MeasuredPace(
            float(found["tile_seconds"]),
            float(found["other_seconds"]),
            int(found["points"]),
            str(found["day"]),
        )
        if 0 < pace.tile_seconds < 10 and 0 <= pace.other_seconds < 10 and len(pace.day) == 10:
            return pace
    return ASSUMED


def _key(head: list[dict[str, Any]]) -> str:
    stages = [[stage["type"], Path(str(stage.get("model", ""))).name] for stage in head]
    return fingerprint(__version__, platform.node(), platform.machine(), stages)


def _known() -> dict[str, Any]:
    try:
        with open(_path(), "rb") as file:
            found = strictjson.loads(file.read(_LARGEST))
    except (OSError, ValueError, RuntimeError):  # RecursionError is one
        return {}
    return found if isinstance(found, dict) else {}


def _path() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or "~/AppData/Local"
    elif sys.platform == "darwin":
        base = "~/Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "pdal-stages" / "measured.json"
