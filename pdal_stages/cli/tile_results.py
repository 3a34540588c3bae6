"""What is printed and written about runs in tiles, and their exit codes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..base.asprs import class_name
from ..base.files import write_json, write_whole
from ..base.messages import count_of, print_messages
from ..stages.registry import describe_count

if TYPE_CHECKING:
    from ..tiling.jobs import Job, TiledRun
    from .tile_options import RunFiles

_MOST_FAILURES = 20  #: are printed; reports have all
_MOST_TILES = 50  #: of a dry run are printed


def print_classes(
    classes: Mapping[str, int], left_alone: Mapping[str, int], names: Mapping[int, str]
) -> None:
    """Print the points of each class in all files together, and those without a class.

    `classes` are numbers of points by code, `left_alone` by the name of the count; `names` are the
    model's by code.
    """
    for code, points in sorted((int(code), points) for code, points in classes.items()):
        print(f"  {code:3d} {names.get(code, class_name(code)):28s} {points:>12,}")
    for name, points in left_alone.items():
        print(f"  {describe_count(name):32s} {points:>12,}")


def print_output(job: Job, names: Mapping[int, str]) -> None:
    """Print an output when it is finished.

    For instance ``out.laz: 500 points; 2 ground 61.3 %, 6 building 12.0 %``.
    """
    assert job.outputs is not None
    classes = {int(code): n for code, n in job.record.get("classes", {}).items()}
    total = sum(classes.values())
    shares = ", ".join(
        f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
        for code, n in sorted(classes.items())
    )
    points = count_of(job.record.get("written", 0), "point")
    print(f"{job.outputs[0]}: {points}{f'; {shares}' if shares else ''}", flush=True)


def print_run(run: TiledRun) -> None:
    """Print the result of a run."""
    s = run.summary
    parts = []
    if run.outputs:
        files = Counter(output.state for output in run.outputs)
        parts.append(f"{count_of(files['done'], 'file')} written{_other_states(files)}")
    parts.append(f"{count_of(s['states']['done'], 'tile')} done{_other_states(s['states'])}")
    speed = f"{s['points_per_second']:,.0f} points/s"
    parts.append(f"{s['points']:,} points in {s['seconds']:.1f} s ({speed})")
    print("; ".join(parts))
    if s["dropped"]:
        print(f"{s['dropped']:,} points were dropped by filters of the pipeline")
    print_messages(*run.messages)
    _print_failures(run)
    if run.failures:
        print_messages("run it again with --resume to try only what failed")


def print_plan(run: TiledRun) -> None:
    """Print what a run would do."""
    s = run.summary
    processes = {0: "this process", 1: "the worker"}
    workers = processes.get(s["workers"], f"each of {s['workers']} workers")
    memory = f"{s['memory_mb_of_a_worker']:,.0f} MB for {workers}"
    print(
        f"{count_of(len(run.tiles), 'tile')} of {s['tile']:g}, each read with {s['halo_m']:g} m "
        "around it",
        f"{count_of(s['inputs'], 'input')}, {s['points']:,} points; one output for each {s['per']}",
        f"about {s['points_read_by_a_tile']:,} points read for a tile",
        f"up to {memory} with {s['threads_per_worker']} threads",
        f"about {s['disk_gb']:,.2f} GB of disk beside the outputs",
        *(f"  {job.name}" for job in run.tiles[:_MOST_TILES]),
        sep="\n",
    )
    if len(run.tiles) > _MOST_TILES:
        print(f"  and {len(run.tiles) - _MOST_TILES} more")
    print_messages(*run.messages)
    _print_failures(run)


def _other_states(states: Mapping[str, int]) -> str:
    """Return the numbers of kept and failed jobs, for the end of a line."""
    words = {"kept": "kept from an earlier run", "failed": "failed"}
    return "".join(
        f", {states[state]:,} {text}" for state, text in words.items() if states.get(state)
    )


def _print_failures(run: TiledRun) -> None:
    """Print the first failures."""
    failures = run.failures
    print_messages(*(f"{what}: {reason}" for what, reason in failures[:_MOST_FAILURES]))
    if len(failures) > _MOST_FAILURES:
        print_messages(f"and {len(failures) - _MOST_FAILURES:,} more; see --report")


def end_run(files: RunFiles, run: TiledRun, again: str) -> int:
    """Write metadata and reports; return the exit code.

    `again` says how to continue an interrupted run, else it is empty.
    """
    content = run.to_dict()
    if files.metadata:
        write_json(files.metadata, content if run.metadata is None else run.metadata, "metadata")
    for name in files.reports:
        if Path(name).suffix.lower() != ".json":
            from ..reports.run_page import run_page

            write_whole(name, run_page(content).encode(), "report")
        else:
            write_json(name, content, "report")
    if not again:
        return 1 if run.failures else 0
    states = run.summary["states"]
    outputs = sum(output.state in ("done", "kept") for output in run.outputs)
    total = count_of(len(run.outputs), "file")
    written = f"{outputs:,} of {total} written, " if run.outputs else ""
    print_messages(
        f"interrupted; no partial output was left. {written}{states['done'] + states['kept']:,} of "
        f"{count_of(len(run.tiles), 'tile')} done. For the rest: {again}"
    )
    return 130
