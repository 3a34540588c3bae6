"""The flags of runs in tiles, of ``pipeline`` and of ``classify``, and what they print."""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from ..base.asprs import class_name
from ..base.errors import OptionError, StageError
from ..base.files import check_writable, write_whole
from ..base.messages import one_line, print_messages
from ..base.resources import parse_size
from ..pipeline.inputs_outputs import is_ept, is_folder, is_las
from ..pipeline.read import PipelineSource
from ..pipeline.run import Pipeline
from .classify import ClassifyTask, Written
from .plan import make_plan
from .report import LEFT_ALONE, FoundObjects, InterruptedRun, TiledRun
from .run import run_tiled
from .settings import PER, TilingOptions

#: Failures printed, and tiles of a dry run.
_MOST_FAILURES, _MOST_TILES = 20, 50


def add_arguments(command: argparse.ArgumentParser, survey: bool = False) -> None:
    """Add the flags to the parser of ``pipeline``, or of ``classify`` (a `survey`)."""
    when = "Several inputs, and files too large for memory, are cut into tiles" if survey else "Run in tiles"
    takes = _add_sizes(command, f"{when}; see docs/large-areas.md.")
    takes("--scheduler", default="", metavar="ADDRESS", help="A running Dask scheduler, tcp://HOST:8786")
    takes("--per", choices=PER, default="auto", help="One output per input file or per tile (auto: per file)")
    surroundings = "Surroundings for PDAL filters that look at neighbors"
    takes("--buffer", type=float, metavar="METERS", help=argparse.SUPPRESS if survey else surroundings)
    takes("--resume", action="store_true", help="Keep what an earlier run in this folder finished")
    takes("--dry-run", action="store_true", help="Show the tiles and an estimate, then stop")
    report = "Write a report, .html or .json; may be repeated"
    takes("--report", action="append", default=[], metavar="FILE", help=report)


def add_tile_arguments(command: argparse.ArgumentParser) -> None:
    """Add the flags of ``train``, whose only output is a model."""
    _add_sizes(
        command, "Points that do not fit into the memory are worked on in tiles; the model is the same."
    )


def _add_sizes(command: argparse.ArgumentParser, what: str) -> Callable:
    takes = command.add_argument_group("large areas", what).add_argument
    takes(
        "--tile",
        type=_side,
        metavar="SIZE",
        help="Side of the tiles, in the unit of the coordinates; auto takes what the memory allows",
    )
    takes(
        "--memory",
        metavar="SIZE",
        help="What all processes together may hold, e.g. 4GB (default: half of what is free)",
    )
    takes(
        "--workers",
        type=int,
        metavar="N",
        help="Worker processes; 0 runs everything in this process (default: half the cores)",
    )
    return takes


def _side(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a length or auto, not {text!r}") from None


def options_of(options: argparse.Namespace) -> TilingOptions:
    """What the flags say."""
    names = {field.name for field in fields(TilingOptions)}
    chosen = {name: value for name, value in vars(options).items() if name in names}
    chosen["tile"] = None if options.tile == "auto" else options.tile
    chosen["memory"] = None if options.memory is None else parse_size(options.memory)
    return TilingOptions(**chosen)


def wants_tiles(options: argparse.Namespace) -> bool:
    """Whether ``pipeline`` is asked for a run in tiles; other flags of tiles mean nothing without it."""
    if options.tile is None:
        for name in ("memory", "workers", "scheduler", "per", "buffer", "resume", "dry_run", "report"):
            value = getattr(options, name)
            if (value is not None and value not in (False, "", "auto", [])) or (
                value == 0 and name == "workers"
            ):
                raise OptionError(
                    f"--{name.replace('_', '-')} needs --tile",
                    cure="Give the side of the tiles, e.g. --tile 500, or --tile auto",
                )
    return options.tile is not None


def run_command(options: argparse.Namespace, source: Path | PipelineSource) -> int:
    """Run ``pdal-stages pipeline --tile``; the exit code, 1 where anything failed."""
    _check_reports(options)
    chosen = options_of(options)
    pipeline = Pipeline(source, options.overrides, whole=False)
    if options.validate:
        make_plan(pipeline, chosen.buffer)
        print(pipeline.validate())
        return 0
    run, interrupted = _ran(lambda: run_tiled(pipeline, chosen, dry_run=options.dry_run))
    _print_dry(run) if options.dry_run else _print(run)
    return _end(options, run, "run it again with --resume" if interrupted else "")


def _ran(go: Callable[[], TiledRun]) -> tuple[TiledRun, bool]:
    """What a run did, and whether it was interrupted."""
    with interruptible():
        try:
            return go(), False
        except InterruptedRun as stopped:
            return stopped.run, True


@contextmanager
def interruptible():
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


def end_at_once(options: argparse.Namespace) -> None:
    """Ctrl-C ends the program although PDAL works: Python cannot handle signals meanwhile. The next run sweeps up."""
    if options.is_program and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _check_reports(options: argparse.Namespace) -> None:
    for name in options.report:
        if Path(name).suffix.lower() not in (".html", ".htm", ".json"):
            raise OptionError("--report writes .html or .json", found=name)
        check_writable(name, "report")
    if options.metadata:
        check_writable(options.metadata, "metadata")


def _end(options: argparse.Namespace, run: TiledRun, again: str) -> int:
    """Write reports; the exit code. `again`: of an interrupted run, how to go on."""
    reports = [(name, "--report") for name in options.report]
    for name, flag in [(options.metadata, "--metadata"), *reports] if options.metadata else reports:
        if Path(name).suffix.lower() == ".json" or flag == "--metadata":
            try:
                write_whole(name, (json.dumps(run.to_dict(), indent=1) + "\n").encode())
            except StageError as error:
                raise error.at(flag) from None
        else:
            from ..reports.runpage import write_run_report

            write_run_report(name, run.to_dict())
    if not again:
        return 1 if run.failures else 0
    states = run.summary["states"]
    files = sum(out.state in ("done", "kept") for out in run.outputs)
    written = f"{files:,} of {_counted(len(run.outputs), 'file')} written, " if run.outputs else ""
    print_messages(
        f"interrupted; nothing half-written was left. {written}{states['done'] + states['kept']:,} of "
        f"{_counted(len(run.tiles), 'tile')} done. For the rest: {again}"
    )
    return 130


# ---- classify --------------------------------------------------------------------------------------------


def classify(
    task: ClassifyTask, options: argparse.Namespace, then: Callable[[], FoundObjects] | None = None
) -> int:
    """Run ``pdal-stages classify``; the exit code, 1 where anything failed. `then`: what is done with whole outputs."""
    _check_reports(options)
    whole = task.in_one_piece() and not options.report
    if not whole and (odd := [name for name in task.files if not is_las(name) and not is_ept(name)]):
        raise OptionError(
            "several inputs, and the options of tiles, are for LAS, LAZ, COPC and EPT: others cannot be cut into tiles",
            found=odd[0],
            cure="Convert them first (pdal translate INPUT input.laz), or classify one after the other without options "
            "of tiles",
        )
    names = {code: one_line(name) for code, name in task.request.loaded.classes}
    if not whole:
        return _classify_tiles(task, options, names, then)
    if options.dry_run:
        target = str(Path(task.output) / "dry-run.laz") if is_folder(task.output) else task.output
        task.request.pipeline(task.files[0], target)
        print("1 input, in one piece")
        return 0
    end_at_once(options)
    written = task.run_whole()
    print_messages(*written.messages)
    print(f"{_counted(written.points, 'point')} written to {written.path}")
    _print_classes([written], names)
    if then is not None:
        then()
    return 0


def _classify_tiles(
    task: ClassifyTask,
    options: argparse.Namespace,
    names: Mapping[int, str],
    then: Callable[[], FoundObjects] | None,
) -> int:
    done: list[Written] = []

    def finished(written: Written) -> None:
        done.append(written)
        _print_written(written, names)

    run, interrupted = _ran(lambda: task.run_tiles(dry_run=options.dry_run, finished=finished))
    if options.dry_run:
        _print_dry(run)
    else:
        _print(run)
        _print_classes(done, names, run.summary["left_alone"])
        if then is not None and not interrupted and not run.failures:
            try:
                run.objects = then()
            except StageError:
                _end(options, run, "")
                raise
    words = [word for word in options.arguments if word != "--resume"]
    same = shlex.join(["pdal-stages", *words]) if len(words) <= 20 else "the same command with"
    return _end(options, run, f"{same} --resume" if interrupted else "")


# ---- what is printed ---------------------------------------------------------------------------------------


def _print_written(written: Written, names: Mapping[int, str]) -> None:
    """``out.laz: 500 points; 2 ground 61.3 %, 6 building 12.0 %``"""
    total = sum(written.classes.values())
    shares = [
        f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
        for code, n in sorted(written.classes.items())
    ]
    said = f"; {', '.join(shares)}" if shares else ""
    print(f"{written.path}: {_counted(written.points, 'point')}{said}", flush=True)


def _print_classes(
    done: Sequence[Written], names: Mapping[int, str], more: Mapping[str, int] | None = None
) -> None:
    """The points of each class in all files together, and of those that got none; `more` of these are of all tiles."""
    classes: Counter[int] = Counter()
    counts: Counter[str] = Counter(more)
    for written in done:
        classes.update(written.classes)
        counts.update(written.counts)
    for code, points in sorted(classes.items()):
        print(f"  {code:3d} {names.get(code, class_name(code)):28s} {points:>12,}")
    for key, what in LEFT_ALONE.items():
        if counts[key]:
            print(f"  {what:32s} {counts[key]:>12,}")


def _print(run: TiledRun) -> None:
    s = run.summary
    lines = []
    if run.outputs:
        files = Counter(out.state for out in run.outputs)
        lines.append(f"{_counted(files['done'], 'file')} written{_others(files)}")
    lines.append(f"{_counted(s['states']['done'], 'tile')} done{_others(s['states'])}")
    lines.append(f"{s['points']:,} points in {s['seconds']:.1f} s ({s['points_per_second']:,.0f} points/s)")
    print("; ".join(lines))
    if s["dropped"]:
        print(f"{s['dropped']:,} points were dropped by filters of the pipeline")
    print_messages(*run.messages)
    _print_failures(run)
    if run.failures:
        print_messages("run it again with --resume to try only what failed")


def _others(states: Mapping[str, int]) -> str:
    told = {"kept": "kept from an earlier run", "failed": "failed"}
    return "".join(f", {states[state]:,} {what}" for state, what in told.items() if states.get(state))


def _print_failures(run: TiledRun) -> None:
    failures = run.failures
    print_messages(*(f"{what}: {reason}" for what, reason in failures[:_MOST_FAILURES]))
    if len(failures) > _MOST_FAILURES:
        print_messages(f"and {len(failures) - _MOST_FAILURES:,} more; see --report")


def _print_dry(run: TiledRun) -> None:
    s = run.summary
    workers = {0: "this process", 1: "the worker"}.get(s["workers"], f"each of {s['workers']} workers")
    print(f"{_counted(len(run.tiles), 'tile')} of {s['tile']:g}, each read with {s['halo_m']:g} m around it")
    print(f"{_counted(s['inputs'], 'input')}, {s['points']:,} points; one output for each {s['per']}")
    print(f"about {s['points_read_by_a_tile']:,} points read for a tile")
    print(f"up to {s['memory_mb_of_a_worker']:,.0f} MB for {workers} with {s['threads_per_worker']} threads")
    print(f"about {s['disk_gb']:,.2f} GB of disk beside the outputs")
    for job in run.tiles[:_MOST_TILES]:
        print(f"  {job.name}")
    if len(run.tiles) > _MOST_TILES:
        print(f"  and {len(run.tiles) - _MOST_TILES} more")
    print_messages(*run.messages)
    _print_failures(run)


def _counted(count: int, word: str) -> str:
    return f"{count:,} {word}{'s' * (count != 1)}"
