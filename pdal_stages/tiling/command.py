"""The flags of ``pdal-stages pipeline --tile``, and what it prints."""

from __future__ import annotations

import argparse
import json
import signal
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from ..base.errors import OptionError, StageError
from ..base.files import check_writable, write_whole
from ..base.plain import tell
from ..pipeline.read import PipelineSource
from ..pipeline.run import Pipeline
from .outcome import InterruptedRun, TiledRun
from .settings import PER, TilingOptions
from .tiledrun import run_tiled
from .tileplan import make_plan


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the flags to the parser of ``pipeline``."""
    group = command.add_argument_group("large areas", "Run the pipeline in tiles; see docs/large-areas.md.")
    takes = group.add_argument
    takes("--tile", type=float, metavar="SIZE", help="Side of the tiles, in the unit of the coordinates")
    takes(
        "--workers",
        type=int,
        metavar="N",
        help="Worker processes; 0 runs everything in this process (default: half the cores)",
    )
    takes("--scheduler", default="", metavar="ADDRESS", help="A running Dask scheduler, tcp://HOST:8786")
    takes("--per", choices=PER, default="auto", help="One output per input file or per tile (auto: per file)")
    takes(
        "--buffer", type=float, metavar="METRES", help="Surroundings for PDAL filters that look at neighbors"
    )
    takes("--resume", action="store_true", help="Keep what an earlier run in this folder finished")
    takes("--retries", type=int, default=2, metavar="N", help="How often a failed tile is tried again (2)")
    takes("--dry-run", action="store_true", help="Show the tiles and an estimate, then stop")
    takes(
        "--report",
        action="append",
        default=[],
        metavar="FILE",
        help="Write a report, .html or .json; may be repeated",
    )


def wants_tiles(options: argparse.Namespace) -> bool:
    """Whether a run in tiles is asked for."""
    if options.tile is not None:
        return True
    given = {
        "--workers": options.workers is not None,
        "--scheduler": options.scheduler,
        "--per": options.per != "auto",
        "--buffer": options.buffer is not None,
        "--resume": options.resume,
        "--dry-run": options.dry_run,
        "--report": options.report,
    }
    for flag, used in given.items():
        if used:
            raise OptionError(f"{flag} needs --tile", cure="Give the side of the tiles, e.g. --tile 500")
    return False


def run_command(options: argparse.Namespace, source: Path | PipelineSource) -> int:
    """Run ``pdal-stages pipeline --tile``; the exit code, 1 where anything failed."""
    for name in options.report:
        if Path(name).suffix.lower() not in (".html", ".htm", ".json"):
            raise OptionError("--report writes .html or .json", found=name)
        check_writable(name, "report")
    if options.metadata:
        check_writable(options.metadata, "metadata")
    names = {field.name for field in fields(TilingOptions)}
    chosen = TilingOptions(**{name: value for name, value in vars(options).items() if name in names})
    pipeline = Pipeline(source, options.overrides, whole=False)
    if options.validate:
        make_plan(pipeline, chosen.buffer)
        print(pipeline.validate())
        return 0
    interrupted = False
    with _terminated_as_interrupted():
        try:
            run = run_tiled(pipeline, chosen, dry_run=options.dry_run)
        except InterruptedRun as stopped:
            run, interrupted = stopped.run, True
    _print_dry(run) if options.dry_run else _print(run)
    if options.metadata:
        _write_json(options.metadata, run, "--metadata")
    for name in options.report:
        _write_report(name, run)
    if interrupted:
        tell(
            "interrupted; nothing half-written was left. Run it again with --resume for the rest of the "
            f"{_counted(len(run.tiles), 'tile')}"
        )
        return 130
    return 1 if run.failures else 0


@contextmanager
def _terminated_as_interrupted():
    """A run stopped by a service manager or batch system cleans up like one stopped by Ctrl-C."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print(run: TiledRun) -> None:
    s = run.summary
    states = s["states"]
    line = f"{_counted(states['done'], 'tile')} done"
    if states["kept"]:
        line += f", {states['kept']} kept from an earlier run"
    if states["failed"]:
        line += f", {states['failed']} failed"
    print(f"{line}; {s['points']:,} points in {s['seconds']:.1f} s ({s['points_per_second']:,.0f} points/s)")
    if s["dropped"]:
        print(f"{s['dropped']:,} points were dropped by filters of the pipeline")
    failures = run.failures
    tell(*run.notes, *(f"{what}: {reason}" for what, reason in failures[:20]))
    if len(failures) > 20:
        tell(f"and {len(failures) - 20} more; see --report")
    if failures:
        tell("run it again with --resume to try only what failed")


def _print_dry(run: TiledRun) -> None:
    s = run.summary
    print(
        f"{_counted(len(run.tiles), 'tile')} of {s['tile']:g}, each read with {s['halo_m']:g} m of surroundings"
    )
    print(f"{_counted(s['inputs'], 'input')}, {s['points']:,} points; one output for each {s['per']}")
    print(
        f"about {s['points_read_by_a_tile']:,} points read for a tile, {s['points_of_largest_tile']:,} its own at most"
    )
    memory, rate = s["memory_mb_of_a_worker"], s["assumed_points_per_core_second"]
    workers = {0: "this process", 1: "the worker"}.get(s["workers"], f"each of {s['workers']} workers")
    print(f"up to {memory:,.0f} MB for {workers} with {_counted(s['threads_per_worker'], 'thread')}")
    hours = f"roughly {s['core_hours']:.2f}" if s["core_hours"] >= 0.01 else "less than 0.01"
    print(f"{hours} core hours at {rate:,} points/s and core; the model decides")
    for job in run.tiles[:50]:
        print(f"  {job.name:24s} {job.points:>14,} points  {_counted(len(job.sources), 'input')}")
    if len(run.tiles) > 50:
        print(f"  and {len(run.tiles) - 50} more")
    tell(*run.notes, *(f"{what}: {reason}" for what, reason in run.failures))


def _counted(count: int, word: str) -> str:
    return f"{count:,} {word}{'s' * (count != 1)}"


def _write_report(name: str, run: TiledRun) -> None:
    if Path(name).suffix.lower() == ".json":
        _write_json(name, run, "--report")
        return
    from ..reports.runpage import write_run_report

    write_run_report(name, run.to_dict())


def _write_json(name: str, run: TiledRun, flag: str) -> None:
    try:
        write_whole(name, (json.dumps(run.to_dict(), indent=1) + "\n").encode())
    except StageError as error:
        raise error.at(flag) from None
