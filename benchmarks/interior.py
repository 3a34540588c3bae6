"""What a tile inside a survey costs, part by part, against the same points in one piece.

    python benchmarks/interior.py --side 500 --around 3

A generated town of --side meters is repeated in files side by side, --around of them on each side of the one in the middle,
which is a tile. `classify` with the model that comes with the package runs on the tile in the middle of the survey, then on
its file in one piece: all rounds in this process, CPU seconds of each task. Of blocks of the ground's raster a tile pays its
share by area. The program's start is left out of both.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pdal_stages.pipeline.workers import ThisProcess
from pdal_stages.synthetic import TownOptions, write_town
from pdal_stages.tiling import firstround
from pdal_stages.tiling.classify import ClassifyTask
from pdal_stages.tiling.dispatch import run_all, run_first_round
from pdal_stages.tiling.index import sort_points
from pdal_stages.tiling.settings import TilingOptions
from pdal_stages.tiling.store import Store
from pdal_stages.tiling.survey import Survey
from pdal_stages.tiling.worklist import Worklist


def repeated(town: Path, folder: Path, side: float, around: int) -> Path:
    """Files of the same points side by side; the one in the middle."""
    folder.mkdir()
    head = bytearray(town.read_bytes())
    offsets, box = struct.unpack_from("<3d", head, 155), struct.unpack_from("<6d", head, 179)
    for row in range(-around, around + 1):
        for column in range(-around, around + 1):
            x, y = column * side, row * side
            struct.pack_into("<2d", head, 155, offsets[0] + x, offsets[1] + y)
            struct.pack_into("<4d", head, 179, box[0] + x, box[1] + x, box[2] + y, box[3] + y)
            (folder / f"{row + around}_{column + around}.laz").write_bytes(head)
    return folder / f"{around}_{around}.laz"


class Timed(ThisProcess):
    """Notes what tasks cost, by their kind."""

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        self.costs: dict[str, list[float]] = {}

    def submit(self, task: Any) -> Any:
        future = super().submit(task)
        kind = type(getattr(task, "__self__", None)).__name__
        self.costs.setdefault(kind, []).append(future.result().cost["cpu_seconds"])
        return future


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--side", type=float, default=500.0, help="Of the town and the tiles, meters")
    p.add_argument("--density", type=float, default=5.0)
    p.add_argument("--around", type=int, default=3, help="Files on each side of the middle one")
    p.add_argument("--threads", type=int, default=2)
    p.add_argument(
        "--memory",
        type=float,
        help="Of a run with one worker, GB: what blocks may take; without, no more than a tile",
    )
    p.add_argument(
        "--runs", type=int, default=1, help="Of the tile in the middle, and of its file in one piece"
    )
    p.add_argument("--folder", type=Path, help="Where the town is kept for another time")
    p.add_argument("--json", type=Path)
    o = p.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        town = (o.folder or folder) / f"town_{o.side:g}_{o.density:g}.laz"
        if not town.exists():
            write_town(TownOptions(size=o.side, density=o.density, seed=11), town)
        middle = repeated(town, folder / "in", o.side, o.around)

        memory = None if o.memory is None else int(o.memory * 1e9)
        options = TilingOptions(o.side, workers=1, memory=memory)
        task = ClassifyTask((str(folder / "in"),), f"{folder / 'out'}/", options=options)
        (folder / "out").mkdir()
        plan = task.plan()
        survey = Survey(plan, task.options)
        plan = survey.plan
        pool = Timed(o.threads)
        with Store(folder / "out") as store, contextlib.suppress(KeyboardInterrupt):
            survey.read_inputs(store, pool, False)
            work = Worklist(plan, survey)
            inside = next(out for out in work.outputs if out.source.path == str(middle))
            for item in [*work.jobs, *work.outputs]:
                if item is not inside and item not in inside.jobs:
                    item.state = "kept"
            assert len(inside.jobs) == 1, "the file in the middle is not one tile"
            run_first_round(work, store, pool, False)
            costs = {kind: list(values) for kind, values in pool.costs.items()}
            costs["index"] = []
            for _ in range(3):
                began = time.process_time()
                sort_points(str(middle), survey.grid, str(folder / "copy"))
                costs["index"].append(time.process_time() - began)
            pool.costs.clear()
            for _ in range(o.runs + 1):  # the first compiles, or loads what is compiled
                for item in (inside, *inside.jobs):
                    item.state = "waiting"
                run_all(work, store, pool, False)
                if inside.state != "done":
                    sys.exit(inside.reason)
            costs |= {kind: values[1:] for kind, values in pool.costs.items()}
        whole = []
        for number in range(o.runs + 1):
            began = time.process_time()
            written = ClassifyTask((str(middle),), str(folder / f"whole{number}.laz")).run_whole()
            whole.append(time.process_time() - began)
        whole = whole[1:]
        points = written.points

        assert plan.first is not None
        share = min(1.0, (o.side / firstround.block_grid(plan.first).size) ** 2)
        parts = {
            "index": statistics.median(costs["index"]),
            "first round": statistics.median(costs["FirstRoundTask"]),
            "share of a block": share * max(costs["BlockTask"]),
            "tile": statistics.median(costs["TileTask"]),
            "output": statistics.median(costs["FileTask"]),
        }
        one = statistics.median(whole)
        print(f"{points:,} points; in one piece {one:.1f} CPU s")
        for what, seconds in parts.items():
            print(f"  {what:18s} {seconds:6.2f}")
        total = sum(parts.values())
        print(f"in a tile of {o.side:g} m {total:.1f} CPU s, {total / one:.2f} times")
        record = inside.jobs[0].record
        print(f"read {record['read']:,} points; the process held {record['peak_mb']:,.0f} MB at most")
        if o.json:
            found = {"points": points, "whole": one, "parts": parts, "ratio": total / one, "record": record}
            o.json.write_text(json.dumps(found, indent=1, default=str))


if __name__ == "__main__":
    main()
