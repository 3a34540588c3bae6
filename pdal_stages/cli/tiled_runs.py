"""Runs at the command line: flags of tiles, Ctrl-C, what is printed and written, exit codes."""

from __future__ import annotations

import argparse
import contextlib
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

from ..base.asprs import class_name
from ..base.errors import OptionError
from ..base.files import JSON, Output, write_json
from ..base.memory import parse_size
from ..base.messages import count_of, one_line, print_messages
from ..stages.registry import describe_count
from ..tiling.options import PER, TilingOptions
from .parser import Parser

if TYPE_CHECKING:
    from ..tiling.jobs import TiledRun, WritingJob

#: Reasons of failures that are printed, a screenful; reports hold all of them.
_MOST_FAILURES = 20
#: Names of what failed for one reason that are printed.
_MOST_NAMES = 10
#: Tiles of a dry run that are printed.
_MOST_TILES = 50


def run_files(options: argparse.Namespace) -> list[Output]:
    """Return the files about a run that flags name."""
    named = {"metadata": options.metadata, "report": options.report}
    return [Output(name, what, JSON) for what, name in named.items() if name]


def add_tile_options(command: Parser, survey: bool = False) -> None:
    """Add the flags to the parser of ``pipeline``, or of ``classify`` (a `survey`)."""
    when = "Several inputs and large files are cut into tiles" if survey else "Run in tiles"
    add = add_survey_options(command, when)
    overwrite = "With --resume: replace outputs that were edited since they were written"
    add("--overwrite", action="store_true", help=overwrite)
    add("--per", choices=PER, default="file", help="One output per input file or per tile")
    buffer = argparse.SUPPRESS if survey else "How far PDAL's own filters look beyond a tile"
    add("--buffer", type=float, metavar="METERS", help=buffer)
    add("--dry-run", action="store_true", help="Show tiles, memory and disk needed, then stop")
    add("--report", metavar="FILE", help="Write counts of outputs, tiles, classes to a JSON file")


def add_survey_options(command: Parser, when: str) -> Callable:
    """Add the flags of all commands that read surveys in tiles; return what adds others."""
    group = command.add_argument_group("large areas", f"{when} (docs/large-areas.md).")
    add = command.adder_to(group)
    side = "Side of the tiles in the cloud's unit (default: auto)"
    add("--tile", type=_tile_side, metavar="SIZE", help=side)
    add("--memory", metavar="SIZE", help="Most memory to use, e.g. 4GB (default: half of free)")
    workers = "Worker processes, 0 for none (default: half the cores)"
    add("--workers", type=int, metavar="N", help=workers)
    scheduler = "A running Dask scheduler, tcp://HOST:8786"
    add("--scheduler", default="", metavar="ADDRESS", help=scheduler)
    add("--resume", action="store_true", help="Continue a run that was stopped or failed")
    return add


def _tile_side(text: str) -> float | str:
    """Return the value of ``--tile``."""
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a length or auto, not {text!r}") from None


def tiling_options(options: argparse.Namespace) -> TilingOptions:
    """Return the options of tiles from the flags."""
    names = {field.name for field in fields(TilingOptions)}
    values = {name: value for name, value in vars(options).items() if name in names}
    values["tile"] = None if options.tile == "auto" else options.tile
    values["memory"] = None if options.memory is None else parse_size(options.memory)
    return TilingOptions(**values)


def requests_tiles(options: argparse.Namespace) -> bool:
    """Return whether ``pipeline`` runs in tiles; refuse other flags of tiles without it."""
    if options.tile is None:
        add_tile_options(usual := Parser())
        for name, default in vars(usual.parse_args([])).items():
            if getattr(options, name) != default:
                raise OptionError(
                    f"--{name.replace('_', '-')} needs --tile",
                    cure="Give the side of the tiles, e.g. --tile 500, or --tile auto",
                )
    return options.tile is not None


# ---- Ctrl-C and SIGTERM --------------------------------------------------------------------------


@contextlib.contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Make SIGTERM, which service managers and batch systems send, clean up like Ctrl-C."""
    before = None
    with contextlib.suppress(ValueError):  # not in the main thread
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def run_until_interrupted(start: Callable[[], TiledRun]) -> tuple[TiledRun, bool]:
    """Call `start`; return its run, or what was done of it, and whether it was interrupted."""
    from ..tiling.jobs import InterruptedRun

    with sigterm_like_ctrl_c():
        try:
            return start(), False
        except InterruptedRun as interrupted:
            return interrupted.run, True


def end_at_ctrl_c(is_program: bool) -> None:
    """Let Ctrl-C end the program while PDAL works, when Python cannot handle signals.

    The next run removes what this one leaves.
    """
    if is_program and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


# ---- results -------------------------------------------------------------------------------------


def print_classes(
    classes: Mapping[str, int], point_counts: Mapping[str, int], names: Mapping[int, str]
) -> None:
    """Print the points of each class in all files together, and those without a class.

    `classes` are numbers of points by code, `point_counts` by the name of the count; `names` are
    the model's by code.
    """
    for code, points in sorted((int(code), points) for code, points in classes.items()):
        print(f"  {code:3d} {names.get(code, class_name(code)):28s} {points:>12,}")
    for name, points in sorted(point_counts.items()):
        print(f"  {describe_count(name):32s} {points:>12,}")


def print_output(job: WritingJob, names: Mapping[int, str]) -> None:
    """Print a finished output, as ``out.laz: 500 points; 2 ground 61.3 %, 6 building 12.0 %``."""
    assert job.outputs is not None and job.record is not None
    classes = {int(code): n for code, n in (job.record.classes or {}).items()}
    total = sum(classes.values())
    shares = ", ".join(
        f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
        for code, n in sorted(classes.items())
    )
    points = count_of(job.record.written or 0, "point")
    print(f"{one_line(job.outputs[0])}: {points}{f'; {shares}' if shares else ''}", flush=True)


def print_run(run: TiledRun) -> None:
    """Print the result of a run."""
    s = run.summary
    parts = []
    if run.outputs:
        files = Counter[str](output.state for output in run.outputs)
        parts.append(f"{count_of(files['done'], 'file')} written{_other_states(files)}")
    parts.append(f"{count_of(s['states']['done'], 'tile')} done{_other_states(s['states'])}")
    speed = f"{s['points_per_second']:,.0f} points/s"
    parts.append(f"{count_of(s['points'], 'point')} in {s['seconds']:.1f} s ({speed})")
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
    """Print the first reasons of failures, each with what failed for it."""
    failed: dict[str, list[str]] = {}
    for what, reason in run.failures:
        failed.setdefault(reason, []).append(what)
    for reason, names in [*failed.items()][:_MOST_FAILURES]:
        more = f" and {len(names) - _MOST_NAMES:,} more" if len(names) > _MOST_NAMES else ""
        print_messages(f"{', '.join(names[:_MOST_NAMES])}{more}: {reason}")
    if len(failed) > _MOST_FAILURES:
        print_messages(f"and {len(failed) - _MOST_FAILURES:,} more reasons; see --report")


def end_run(files: Sequence[Output], run: TiledRun, again: str) -> int:
    """Write metadata and reports; return the exit code.

    `again` tells how to continue an interrupted run, else it is empty.
    """
    content = run.to_dict()
    for file in files:
        if file.what == "metadata" and run.metadata is not None:
            write_json(file.path, run.metadata, file.what)
        else:
            write_json(file.path, content, file.what)
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
