"""A country, simulated: what planning, a dry run and its report cost with 100,000 inputs of ten million points each.

    python benchmarks/country.py --inputs 100000 --points 10000000

The inputs are LAS files of 1 km whose headers are honest: of the size that so many points take, but without content on disk
(sparse). Headers are read, tiles planned, and the report page written; nothing is classified. Then it is noted that all
outputs are written, as a run does in the end, and the command is asked with `--resume` to find that nothing is to be done.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import laspy
from pdal_stages.tiling.complete import remember

from pdal_stages.base.complete import remember
from pdal_stages.tiling.classify import ClassifyTask
from pdal_stages.tiling.store import Store
from pdal_stages.tiling.survey import Survey


def make(folder: Path, count: int, points: int) -> None:
    """Sparse files side by side, as square as it goes."""
    side = math.isqrt(count - 1) + 1
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.01] * 3, [0.0] * 3
    template = folder / "template.las"
    laspy.LasData(header).write(template)
    head = bytearray(template.read_bytes())
    template.unlink()
    offset, width = int.from_bytes(head[96:100], "little"), int.from_bytes(head[105:107], "little")
    head = head[:offset]
    head[247:255] = points.to_bytes(8, "little")
    import struct

    for number in range(count):
        x, y = 500_000.0 + 1000.0 * (number % side), 5_400_000.0 + 1000.0 * (number // side)
        struct.pack_into("<6d", head, 179, x + 999.99, x, y + 999.99, y, 400.0, 0.0)
        with open(folder / f"{int(x)}_{int(y)}.las", "wb") as file:
            file.write(head)
            file.truncate(offset + points * width)


def finish(inputs: Path, outputs: Path) -> None:
    """What a run leaves that has done everything: an output for each input, and its notes."""
    task = ClassifyTask((str(inputs),), f"{outputs}/")
    outputs.mkdir()
    plan = task.plan()
    survey = Survey(plan, task.options)
    jobs = [SimpleNamespace(state="done", outputs=None)] * len(survey.tiles())
    with Store(outputs) as store:
        outs = []
        for source in survey.sources:
            path = outputs / source.plain_name
            path.touch()
            status = path.stat()
            store.wrote(source.key, "", {"outputs": [[str(path), status.st_size, status.st_mtime_ns]]})
            outs.append(SimpleNamespace(state="done", source=source))
        remember(store, plan, task.options, SimpleNamespace(survey=survey, jobs=jobs, outputs=outs))


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--inputs", type=int, default=100_000)
    p.add_argument("--points", type=int, default=10_000_000)
    p.add_argument("--memory", default="4GB")
    p.add_argument("--json", type=Path)
    o = p.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "in").mkdir()
        began = time.perf_counter()
        make(folder / "in", o.inputs, o.points)
        print(
            f"{o.inputs:,} inputs of {o.points:,} points made in {time.perf_counter() - began:.0f} s",
            flush=True,
        )
        command = [
            sys.executable,
            "-m",
            "pdal_stages.cli",
            "classify",
            str(folder / "in"),
            str(folder / "out/"),
        ]
        command += ["--dry-run", "--memory", o.memory, "--report", str(folder / "r.html"), "--no-progress"]
        began = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True)
        wall = time.perf_counter() - began
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(done.stdout[:1500], done.stderr[:1500])
        if done.returncode:
            sys.exit(1)
        found = {
            "inputs": o.inputs,
            "points": o.inputs * o.points,
            "wall_seconds": wall,
            "cpu_seconds": used.ru_utime + used.ru_stime,
            "peak_mb": used.ru_maxrss / 1024,
            "page_bytes": os.path.getsize(folder / "r.html"),
        }
        finish(folder / "in", folder / "out")
        command = [
            *command[:3],
            "classify",
            str(folder / "in"),
            str(folder / "out/"),
            "--resume",
            "--no-progress",
        ]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True)
        found["resume_wall_seconds"] = time.perf_counter() - began
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        found["resume_cpu_seconds"] = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
        print(done.stdout[:500], done.stderr[:500])
        if done.returncode or "nothing is to be done" not in done.stdout + done.stderr:
            sys.exit(1)
        print(json.dumps(found, indent=1))
        if o.json:
            o.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
