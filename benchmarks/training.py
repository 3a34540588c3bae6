"""Training on a survey larger than the memory: a generated town repeated, in tiles and in one piece.

    python benchmarks/training.py --files 40 --memory 2GB --whole 14GB

Prints the most memory that program and workers held together (RSS, looked at five times a second), their CPU seconds, and
whether the two models are the same file.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

import pdal_stages as ps

#: Meters between a town and the next.
SIDE = 224.0


def write_survey(folder: Path, files: int) -> int:
    """One town in many places; its points."""
    town = ps.make_town(SIDE, 10.0, seed=3)
    xyz = town.xyz - town.xyz.min(axis=0)
    one = np.ones(len(xyz), np.uint8)
    for number in range(files):
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = [0.001] * 3, [500_000, 5_400_000, 0]
        las = laspy.LasData(header)
        las.x = xyz[:, 0] + 500_000 + (number % 8) * SIDE
        las.y = xyz[:, 1] + 5_400_000 + (number // 8) * SIDE
        las.z = xyz[:, 2] + 50
        las.classification, las.return_number, las.number_of_returns = town.classification, one, one
        las.write(folder / f"town{number:03d}.laz")
    return files * len(xyz)


def held(root: int) -> int:
    """Bytes that a process and all that it started hold now."""
    children: dict[int, list[int]] = {}
    sizes: dict[int, int] = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        children.setdefault(int(fields[1]), []).append(int(name))
        sizes[int(name)] = int(fields[21]) * resource.getpagesize()
    total, waiting = 0, [root]
    while waiting:
        one = waiting.pop()
        total += sizes.get(one, 0)
        waiting += children.get(one, [])
    return total


def train(survey: Path, model: Path, memory: str) -> None:
    """Train, and print what it took."""
    words = ["train", str(survey), "--model", str(model), "--classes", "2,3,4,5,6", "--memory", memory]
    before, most = resource.getrusage(resource.RUSAGE_CHILDREN), 0
    run = subprocess.Popen([sys.executable, "-m", "pdal_stages.cli", *words], stdout=subprocess.DEVNULL)
    while run.poll() is None:
        most = max(most, held(run.pid))
        time.sleep(0.2)
    if run.returncode:
        sys.exit(run.returncode)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"--memory {memory}: {most / 2**20:,.0f} MiB at most, {cpu:.0f} CPU s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=40)
    parser.add_argument("--memory", default="2GB", help="of the run in tiles")
    parser.add_argument("--whole", help="of a run in one piece to compare with")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        survey = Path(folder) / "survey"
        survey.mkdir()
        print(f"{write_survey(survey, options.files):,} points in {options.files} files", flush=True)
        models = [Path(folder) / f"{number}.model" for number in range(2)]
        train(survey, models[0], options.memory)
        if options.whole:
            train(survey, models[1], options.whole)
            same = models[0].read_bytes() == models[1].read_bytes()
            print("the models are the same file" if same else "the models differ")


if __name__ == "__main__":
    main()
