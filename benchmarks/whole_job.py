"""A whole job, from the command to the written file: time, memory, and where both go.

    # 500,000 points of a generated town
    python benchmarks/whole_job.py
    # millions of points, peak memory
    python benchmarks/whole_job.py --sizes 0.5 5 20
    # points per square meter, time per point
    python benchmarks/whole_job.py --densities 1 7 50 200 500
    # a generated wood at 1.7 points/m2 side by side, or a real tile; 1, 2 and all threads
    python benchmarks/whole_job.py --sparse --sizes 0.25 1 4 --threads 1 2 0 --model standard
    python benchmarks/whole_job.py --sparse DATA/bridge/ign_0299_6802.laz --sizes 4 --model standard
    # beside OpenPointClass (built with -DWITH_PDAL=OFF -DWITH_GBT=OFF), by turns
    python benchmarks/whole_job.py --openpointclass BUILD
    # CPU and wall seconds and memory of each part of one job
    python benchmarks/whole_job.py --parts --sparse --sizes 4 --model standard
    python benchmarks/whole_job.py --json FILE

Trains a model with all defaults on one generated town (kept in --folder), classifies another with
`pdal-stages classify`, and tells least / median / largest of --repeats runs. The command runs as a
process of its own, so start, import, reading and writing LAZ are in its times; memory is the
largest that the process ever held. OpenPointClass is trained on the same town with its defaults,
reads and writes binary PLY, and does not smooth.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from woods import closed_wood

from pdal_stages.base.version import __version__
from pdal_stages.classifier import context_features as contexts
from pdal_stages.classifier.random_forest import Forest
from pdal_stages.features import engine as feature_engine
from pdal_stages.pipeline import classify_file
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.pipeline.runtime import ExpandedStage
from pdal_stages.synthetic import make_town, write_town

CLASSES = '{"2":2,"3":3,"4":4,"5":5,"6":6}'


def command(*words: object) -> list[str]:
    """The command line in this interpreter."""
    return [sys.executable, "-m", "pdal_stages.cli", *map(str, words)]


def town(folder: Path, millions: float, density: float, seed: int) -> Path:
    """A generated town of so many points, made once."""
    path = folder / f"town-{millions:g}-{density:g}-{seed}.laz"
    if not path.exists():
        size = (millions * 1e6 / density) ** 0.5
        if size < 20.0:
            raise SystemExit(
                f"{millions:g} million points at {density:g} per square meter are too small a town"
            )
        write_town(make_town(size=size, density=density, seed=seed, progress=False), path)
    return path


def wood(folder: Path) -> Path:
    """A generated closed wood on a slope, 300 m wide, at 1.7 points per square meter, made once."""
    path = folder / "wood.laz"
    if not path.exists():
        xyz, _, _ = closed_wood(0.25, 1.7, 0.1, 1, 300.0)
        las = laspy.create(point_format=6, file_version="1.4")
        las.header.scales = np.full(3, 0.01)
        las.xyz = xyz
        las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
        las.write(path)
    return path


def side_by_side(folder: Path, source: Path, millions: float) -> Path:
    """Copies of a cloud set side by side in a square, each shifted by whole meters, made once."""
    path = folder / f"{source.stem}-{millions:g}.laz"
    if path.exists():
        return path
    las, count = laspy.read(source), int(millions * 1e6)
    points, scales = las.points.array, las.header.scales
    side = np.ceil(las.header.maxs - las.header.mins)
    across = int(np.ceil((count / len(points)) ** 0.5))
    parts = []
    for number in range(-(-count // len(points))):
        part, (row, column) = points.copy(), divmod(number, across)
        part["X"] += round(column * side[0] / scales[0])
        part["Y"] += round(row * side[1] / scales[1])
        parts.append(part)
    header = las.header
    record = laspy.ScaleAwarePointRecord(
        np.concatenate(parts)[:count], header.point_format, scales, header.offsets
    )
    joined = laspy.LasData(header, record)
    joined.update_header()
    joined.write(path)
    return path


def trained(folder: Path) -> Path:
    """A model with all defaults, trained once on a town of half a million points."""
    path = folder / f"defaults-{__version__}.model"
    if not path.exists():
        cloud = town(folder, 0.5, 7.0, 1)
        subprocess.run(
            command(
                "train", cloud, "--model", path, f"--writers.classifiermodel.classes={CLASSES}"
            ),
            check=True,
            capture_output=True,
        )
    return path


def once(command: list[str], threads: int) -> dict[str, float]:
    """Wall and CPU seconds of one run of a command, and the most memory of it in MiB."""
    counts = {"LOKY_MAX_CPU_COUNT": str(threads), "OMP_NUM_THREADS": str(threads)}
    began = time.perf_counter()
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, **(counts if threads else {})},
    )
    assert process.stderr is not None
    errors = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(errors.decode(errors="replace"))
    wall = time.perf_counter() - began
    return {"wall": wall, "cpu": usage.ru_utime + usage.ru_stime, "memory": usage.ru_maxrss / 1024}


def write_ply(cloud: Path) -> Path:
    """Write a cloud as the PLY that OpenPointClass reads, beside it, once."""
    path = cloud.with_suffix(".ply")
    if path.exists():
        return path
    las = laspy.read(cloud)
    points = np.empty(
        len(las.points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("classification", "u1")]
    )
    for axis in "xyz":
        points[axis] = las[axis] - np.floor(np.min(las[axis]))
    points["classification"] = las.classification
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}"
    head += "property uchar classification\nend_header\n"
    path.write_bytes(head.encode() + points.tobytes())
    return path


def openpointclass(folder: Path, programs: Path, cloud: Path, out: Path) -> list[str]:
    """Train OpenPointClass once as our model is, and return the command that classifies a cloud."""
    model = folder / "openpointclass.bin"
    if not model.exists():
        ply = write_ply(town(folder, 0.5, 7.0, 1))
        train = [programs / "pctrain", ply, "--output", model]
        subprocess.run(list(map(str, train)), check=True, capture_output=True)
    words = [programs / "pcclassify", write_ply(cloud), out, model, "--regularization", "none"]
    return list(map(str, words))


def measured(
    cloud: Path,
    model: str,
    repeats: int,
    threads: int,
    peer: Callable[[Path, Path], list[str]] | None,
) -> list[dict[str, Any]]:
    """Some runs over a cloud with some threads, by turns with a peer; 0: all threads."""
    with laspy.open(cloud) as reader:
        points = reader.header.point_count
    with tempfile.TemporaryDirectory() as folder:
        commands = {
            "pdal_stages": command("classify", cloud, Path(folder, "out.laz"), "--model", model)
        }
        if peer is not None:
            commands["OpenPointClass"] = peer(cloud, Path(folder, "out.ply"))
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in commands}
        for _ in range(repeats):
            for name, words in commands.items():
                runs[name].append(once(words, threads))
    lines = []
    for name, each in runs.items():
        line: dict[str, Any] = {"cloud": cloud.name, "points": points, "threads": threads}
        line["program"] = name
        for key in ("wall", "cpu", "memory"):
            values = [run[key] for run in each]
            line[key] = [min(values), statistics.median(values), max(values)]
        lines.append(line)
    return lines


def table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table."""
    out = [
        "| cloud | points | program | threads | wall s | CPU s | least CPU microseconds a point | "
        "memory, MiB | bytes a point |",
        "|---|---:|---|---:|---:|---:|---:|---:|---:|",
    ]
    for line in lines:
        wall, cpu = (" / ".join(f"{v:.1f}" for v in line[key]) for key in ("wall", "cpu"))
        memory, points = line["memory"][1], line["points"]
        out.append(
            f"| {line['cloud']} | {points:,} | {line['program']} | {line['threads'] or 'all'} | "
            f"{wall} | {cpu} | {1e6 * line['cpu'][0] / points:.1f} | {memory:.0f} | "
            f"{memory * 2**20 / points:.0f} |"
        )
    return "\n".join(out)


class Meter(threading.Thread):
    """What each part of this process takes: CPU and wall seconds, and the most memory held."""

    def __init__(self) -> None:
        """Begin with the start of the process."""
        super().__init__(daemon=True)
        self.part, self.done = "start", threading.Event()
        #: by part: CPU seconds, wall seconds, bytes
        self.parts: dict[str, list[float]] = {"start": [0.0, 0.0, 0.0]}
        self._at = 0.0, time.perf_counter()

    def switch(self, part: str) -> None:
        """Count what was spent up to now, and begin another part."""
        cpu, wall = time.process_time(), time.perf_counter()
        line = self.parts[self.part]
        line[0], line[1] = line[0] + cpu - self._at[0], line[1] + wall - self._at[1]
        self._at, self.part = (cpu, wall), part
        self.parts.setdefault(part, [0.0, 0.0, 0.0])

    def run(self) -> None:
        """Look at the memory again and again."""
        page = resource.getpagesize()
        while not self.done.wait(0.01):
            held = int(Path("/proc/self/statm").read_text().split()[1]) * page
            line = self.parts[self.part]
            line[2] = max(line[2], held)


def parts(cloud: Path, model: str) -> dict[str, list[float]]:
    """CPU and wall seconds of each stage of a job in this process, and the bytes held at most.

    Of what the model does the CPU seconds are counted by thread.
    """
    meter, inside = Meter(), {}
    counted = threading.Lock()

    def timed(name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **more: Any) -> Any:
            began = time.thread_time()
            try:
                return work(*given, **more)
            finally:
                with counted:
                    inside[name] = inside.get(name, 0.0) + time.thread_time() - began

        return run

    def run_stage(stage: ExpandedStage, *given: Any) -> None:
        meter.switch(stage.stage.type)
        function(stage, *given)

    def write(*given: Any) -> None:
        meter.switch("writing")
        write_copy(*given)

    function, ExpandedStage.function = ExpandedStage.function, run_stage  # type: ignore[method-assign]
    write_copy, classify_file.write_copy = classify_file.write_copy, write
    Forest.predict_proba = timed("- forests", Forest.predict_proba)  # type: ignore[method-assign]
    contexts.cell_means = timed("- context: means", contexts.cell_means)
    contexts.describe_segments = timed("- context: segments", contexts.describe_segments)
    contexts.describe_lines = timed("- context: lines", contexts.describe_lines)
    feature_engine.Run.compute = timed(  # type: ignore[method-assign]
        "- features", feature_engine.Run.compute
    )
    meter.start()
    request = ClassifyRequest(model=model)
    with tempfile.TemporaryDirectory() as folder:
        pipeline = request.pipeline(str(cloud), str(Path(folder, "out.laz")))
        meter.switch("reading")
        classify_file.classify_file(pipeline, request, str(cloud))
        meter.switch("end")
    meter.done.set()
    return {
        name: line
        for part, spent in meter.parts.items()
        if part != "end"
        for name, line in [(part, spent), *((k, [v, 0.0, 0.0]) for k, v in inside.items())]
        if name == part or part == "filters.modelclassifier"
    }


def table_of_parts(lines: dict[str, list[float]], points: int) -> str:
    """Return a Markdown table."""
    out = ["| part | CPU s | wall s | bytes held a point |", "|---|---:|---:|---:|"]
    for name, (cpu, wall, held) in lines.items():
        rest = f"{wall:.1f} | {held / points:.0f}" if held else " | "
        out.append(f"| {name} | {cpu:.1f} | {rest} |")
    return "\n".join(out)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir(), "pdal-stages-whole-job")
    )
    options.add_argument("--sizes", type=float, nargs="+", help="millions of points")
    options.add_argument("--densities", type=float, nargs="+", help="points per square meter")
    options.add_argument(
        "--sparse",
        nargs="?",
        const="",
        metavar="FILE",
        help="a cloud set side by side: a generated wood, or FILE",
    )
    options.add_argument("--threads", type=int, nargs="+", default=[0], help="0: all")
    options.add_argument("--parts", action="store_true")
    options.add_argument(
        "--openpointclass", type=Path, metavar="FOLDER", help="its pctrain and pcclassify"
    )
    options.add_argument("--model", help="a model file, or standard; by default one is trained")
    options.add_argument("--repeats", type=int, default=3)
    options.add_argument("--json", type=Path)
    arguments = options.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    model = arguments.model or str(trained(arguments.folder))
    result: dict[str, Any] = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "version": __version__,
        "model": Path(model).name,
    }
    if arguments.sparse is not None:
        source = Path(arguments.sparse) if arguments.sparse else wood(arguments.folder)
        clouds = [side_by_side(arguments.folder, source, n) for n in arguments.sizes or [1]]
    elif arguments.densities:
        clouds = [town(arguments.folder, 0.5, density, 2) for density in arguments.densities]
    else:
        clouds = [town(arguments.folder, size, 7.0, 2) for size in arguments.sizes or [0.5]]
    if arguments.parts:
        with laspy.open(clouds[0]) as reader:
            points = reader.header.point_count
        result["parts"] = parts(clouds[0], model)
        print(table_of_parts(result["parts"], points))
    else:
        peer = None
        if arguments.openpointclass:
            peer = partial(openpointclass, arguments.folder, arguments.openpointclass)
        result["runs"] = [
            line
            for cloud in clouds
            for threads in arguments.threads
            for line in measured(cloud, model, arguments.repeats, threads, peer)
        ]
        print(table(result["runs"]))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
