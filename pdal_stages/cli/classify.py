"""The command ``classify``; flags and output of runs in tiles, also for other commands."""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.asprs import class_name
from ..base.errors import OptionError, StageError
from ..base.files import HTML, JSON, Output, write_json, write_whole
from ..base.memory import parse_size
from ..base.messages import count_of, one_line, print_messages
from ..stages.registry import describe_count
from ..tiling.jobs import InterruptedRun, TiledRun
from ..tiling.options import PER, TilingOptions
from . import INPUTS, Parser, takes_options

if TYPE_CHECKING:
    from ..tiling.classify import ClassifyTask
    from ..tiling.jobs import Job

#: Failures printed, and tiles of a dry run.
_MOST_FAILURES, _MOST_TILES = 20, 50


def add_commands(parser: Parser) -> None:
    """``classify``."""
    what = "Classify point clouds: ground, vegetation, buildings and more"
    rare = ("ground", "dimensions", "bridges", "metadata", "scheduler", "per")
    takes = parser.command("classify", _classify, what, overrides=True, logged=True, rare=rare)
    takes("inputs", nargs="+", metavar="input", help=INPUTS)
    takes("output", help="A file, a folder, or a name with # for the input's")
    takes("--model", default="standard", help="A model file or a shipped model (default: standard)")
    takes(
        "--ground",
        choices=("found", "given"),
        default="found",
        help="given: points of class 2 are the ground, and stay so (default: found)",
    )
    takes(
        "--dimensions",
        metavar="LIST",
        help="Extra dimensions to write besides the input's own, e.g. Reliability,Margin,Probability_6, or all, or none; "
        "default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 (1.6 %%), which keeps files small",
    )
    for flag, default, help in (
        ("--noise", True, "Mark noise, classes 7 and 18 (default: on)"),
        ("--bridges", False, "Find bridge decks, class 17"),
        ("--wires", False, "Find wires, class 14; without it they become building"),
        ("--towers", False, "Find wires, and their towers, class 15"),
    ):
        takes(flag, action=argparse.BooleanOptionalAction, default=default, help=help)
    takes(
        "--polygons",
        action="append",
        default=[],
        metavar="FILE=CODE",
        help="Class for ground inside polygons, e.g. lakes.gpkg=9; for other classes: bridges.gpkg=17:2,6; may be repeated",
    )
    takes("--objects", metavar="FILE", help="Also write buildings, trees and more to a vector file")
    takes_options(takes, "filters.modelclassifier", "vegetation_heights", "keep_sure")
    takes("--where", help="Classify only points that meet this condition")
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_arguments(parser.commands["classify"], survey=True)


def _classify(options: argparse.Namespace) -> int:
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest
    from ..tiling.classify import ClassifyTask

    own, others = [], list(options.overrides)
    if options.objects:
        from ..tiling.objects_from_files import OPTIONS_OF, objects_of_files, refuse_tiles, writer

        own = [one for one in others if not one.by_tag and one.selector in OPTIONS_OF]
        others = [one for one in others if one not in own]
    listed = options.dimensions
    named = (
        WRITTEN
        if listed is None
        else tuple(name.strip() for name in listed.split(",") if name.strip())
    )
    same = ("noise", "bridges", "towers", "keep_sure")
    request = ClassifyRequest(
        options.model,
        tuple(others),
        options.where,
        named,
        wires=options.wires or options.towers,
        polygons=tuple(options.polygons),
        vegetation_heights=options.vegetation_heights or "",
        given_ground=options.ground == "given",
        **{name: getattr(options, name) for name in same},
    )
    print_messages(*request.cost)
    task = ClassifyTask(
        tuple(options.inputs),
        options.output,
        request,
        options_of(options),
        tuple(extra_files(options)),
    )
    names = {code: one_line(name) for code, name in request.loaded.classes}
    then = None
    if options.objects and not options.dry_run:
        with task.folders():
            stage = writer(options.objects, own)
            refuse_tiles(task)
        then = partial(objects_of_files, task.outputs, stage, max(1, task.options.local_workers))
    if not task.in_one_piece:
        return _classify_tiles(task, options, names, then)
    if options.dry_run:
        request.pipeline(task.files[0], task.outputs[0])
        print("1 input, in one piece")
        return 0
    end_at_once(options)
    if (
        options.is_program and not options.polygons
    ):  # laspy loads them, half of its import, for nothing
        sys.modules.update(dict.fromkeys({"requests", "pyproj"} - sys.modules.keys()))  # type: ignore[arg-type]
    written = task.run_whole()
    if options.metadata:
        write_json(options.metadata, written.metadata, indent=2)
    print_messages(*written.messages)
    print(f"{count_of(written.points, 'point')} written to {written.path}")
    print_classes(written.classes, written.left_alone, names)
    if then is not None:
        then()
    return 0


def _classify_tiles(
    task: ClassifyTask,
    options: argparse.Namespace,
    names: Mapping[int, str],
    then: Callable[[], dict[str, Any]] | None,
) -> int:
    def finished(job: Job) -> None:  # out.laz: 500 points; 2 ground 61.3 %, 6 building 12.0 %
        assert job.outputs is not None
        classes = {int(code): n for code, n in job.record.get("classes", {}).items()}
        total = sum(classes.values())
        shares = [
            f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
            for code, n in sorted(classes.items())
        ]
        said = f"; {', '.join(shares)}" if shares else ""
        print(
            f"{job.outputs[0]}: {count_of(job.record.get('written', 0), 'point')}{said}", flush=True
        )

    run, interrupted = ran(lambda: task.run_tiles(dry_run=options.dry_run, finished=finished))
    if options.dry_run:
        print_dry(run)
    else:
        print_run(run)
        print_classes(run.summary["classes"], run.summary["left_alone"], names)
        if then is not None and not interrupted and not run.failures:
            try:
                run.objects = then()
            except StageError:
                end_run(options, run, "")
                raise
    words = [word for word in options.arguments if word != "--resume"]
    same = shlex.join(["pdal-stages", *words]) if len(words) <= 20 else "the same command with"
    return end_run(options, run, f"{same} --resume" if interrupted else "")


# ---- flags of runs in tiles, which other commands share ----


def add_arguments(command: argparse.ArgumentParser, survey: bool = False) -> None:
    """Add the flags to the parser of ``pipeline``, or of ``classify`` (a `survey`)."""
    when = "Several inputs and large files are cut into tiles" if survey else "Run in tiles"
    takes = add_sizes(command, f"{when} (docs/large-areas.md).")
    takes(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="A running Dask scheduler, tcp://HOST:8786",
    )
    takes(
        "--per",
        choices=PER,
        default="auto",
        help="One output per input or per tile (auto: per input)",
    )
    around = argparse.SUPPRESS if survey else "How far PDAL's own filters look beyond a tile"
    takes("--buffer", type=float, metavar="METERS", help=around)
    takes("--resume", action="store_true", help="Continue a run that was stopped or failed")
    takes("--dry-run", action="store_true", help="Show tiles, memory and disk needed, then stop")
    takes(
        "--report",
        action="append",
        default=[],
        metavar="FILE",
        help="Write a report, .html or .json",
    )


def add_sizes(
    command: argparse.ArgumentParser,
    what: str = "Points that do not fit in memory are read in tiles, which give the same model.",
) -> Callable:
    """Add the flags of ``train``, whose only output is a model; returns a function that adds more."""
    takes = command.add_argument_group("large areas", what).add_argument
    takes(
        "--tile",
        type=_side,
        metavar="SIZE",
        help="Side of the tiles in the cloud's unit (default: auto)",
    )
    takes("--memory", metavar="SIZE", help="Most memory to use, e.g. 4GB (default: half of free)")
    takes(
        "--workers",
        type=int,
        metavar="N",
        help="Worker processes, 0 for none (default: half the cores)",
    )
    return takes


def _side(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a length or auto, not {text!r}") from None


def options_of(options: argparse.Namespace) -> TilingOptions:
    """The options from the flags."""
    names = {field.name for field in fields(TilingOptions)}
    chosen = {name: value for name, value in vars(options).items() if name in names}
    chosen["tile"] = None if options.tile == "auto" else options.tile
    chosen["memory"] = None if options.memory is None else parse_size(options.memory)
    return TilingOptions(**chosen)


def wants_tiles(options: argparse.Namespace) -> bool:
    """Whether ``pipeline`` is to run in tiles; other flags of tiles are refused without it."""
    if options.tile is None:
        add_arguments(usual := argparse.ArgumentParser())
        for name, default in vars(usual.parse_args([])).items():
            if getattr(options, name) != default:
                raise OptionError(
                    f"--{name.replace('_', '-')} needs --tile",
                    cure="Give the side of the tiles, e.g. --tile 500, or --tile auto",
                )
    return options.tile is not None


def ran(go: Callable[[], TiledRun]) -> tuple[TiledRun, bool]:
    """The result of a run, and whether it was interrupted."""
    with interruptible():
        try:
            return go(), False
        except InterruptedRun as stopped:
            return stopped.run, True


@contextmanager
def interruptible():
    """Make SIGTERM, as sent by service managers and batch systems, clean up like Ctrl-C."""
    before = None
    with suppress(ValueError):  # not in the main thread
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def end_at_once(options: argparse.Namespace) -> None:
    """Let Ctrl-C end the program while PDAL works, when Python cannot handle signals. The next run cleans up."""
    if options.is_program and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def extra_files(options: argparse.Namespace) -> list[Output]:
    """The log, the metadata and the reports, which are written beside the outputs."""
    kinds = {".html": HTML, ".htm": HTML, ".json": JSON}
    for name in options.report:
        if Path(name).suffix.lower() not in kinds:
            raise OptionError("--report writes .html or .json", found=name)
    reports = [Output(name, "report", kinds[Path(name).suffix.lower()]) for name in options.report]
    more = [("log", options.log, ""), ("metadata", options.metadata, JSON)]
    if not options.dry_run:  # its folder may not be there yet
        more.append(("objects", getattr(options, "objects", None), ""))
    return [*(Output(name, what, kind) for what, name, kind in more if name), *reports]


def end_run(options: argparse.Namespace, run: TiledRun, again: str) -> int:
    """Write reports; returns the exit code. `again`: how to continue an interrupted run."""
    told = run.to_dict()
    for name in filter(None, [options.metadata, *options.report]):
        if name in options.report and Path(name).suffix.lower() != ".json":
            from ..reports.run_page import run_page

            write_whole(name, run_page(told).encode(), "report")
        else:
            write_json(name, told, "report")
    if not again:
        return 1 if run.failures else 0
    states = run.summary["states"]
    files = sum(out.state in ("done", "kept") for out in run.outputs)
    written = f"{files:,} of {count_of(len(run.outputs), 'file')} written, " if run.outputs else ""
    print_messages(
        f"interrupted; nothing half-written was left. {written}{states['done'] + states['kept']:,} of "
        f"{count_of(len(run.tiles), 'tile')} done. For the rest: {again}"
    )
    return 130


# ---- what is printed ---------------------------------------------------------------------------------------


def print_classes(
    classes: Mapping[str, int], left_alone: Mapping[str, int], names: Mapping[int, str]
) -> None:
    """Print the points of each class in all files together, and those without a class."""
    for code, points in sorted((int(code), points) for code, points in classes.items()):
        print(f"  {code:3d} {names.get(code, class_name(code)):28s} {points:>12,}")
    for name, points in left_alone.items():
        print(f"  {describe_count(name):32s} {points:>12,}")


def print_run(run: TiledRun) -> None:
    """Print the result of a run."""
    s = run.summary
    lines = []
    if run.outputs:
        files = Counter(out.state for out in run.outputs)
        lines.append(f"{count_of(files['done'], 'file')} written{_others(files)}")
    lines.append(f"{count_of(s['states']['done'], 'tile')} done{_others(s['states'])}")
    lines.append(
        f"{s['points']:,} points in {s['seconds']:.1f} s ({s['points_per_second']:,.0f} points/s)"
    )
    print("; ".join(lines))
    if s["dropped"]:
        print(f"{s['dropped']:,} points were dropped by filters of the pipeline")
    print_messages(*run.messages)
    _print_failures(run)
    if run.failures:
        print_messages("run it again with --resume to try only what failed")


def _others(states: Mapping[str, int]) -> str:
    told = {"kept": "kept from an earlier run", "failed": "failed"}
    return "".join(
        f", {states[state]:,} {what}" for state, what in told.items() if states.get(state)
    )


def _print_failures(run: TiledRun) -> None:
    failures = run.failures
    print_messages(*(f"{what}: {reason}" for what, reason in failures[:_MOST_FAILURES]))
    if len(failures) > _MOST_FAILURES:
        print_messages(f"and {len(failures) - _MOST_FAILURES:,} more; see --report")


def print_dry(run: TiledRun) -> None:
    """Print what a run would do."""
    s = run.summary
    workers = {0: "this process", 1: "the worker"}.get(
        s["workers"], f"each of {s['workers']} workers"
    )
    print(
        f"{count_of(len(run.tiles), 'tile')} of {s['tile']:g}, each read with {s['halo_m']:g} m around it"
    )
    print(
        f"{count_of(s['inputs'], 'input')}, {s['points']:,} points; one output for each {s['per']}"
    )
    print(f"about {s['points_read_by_a_tile']:,} points read for a tile")
    print(
        f"up to {s['memory_mb_of_a_worker']:,.0f} MB for {workers} with {s['threads_per_worker']} threads"
    )
    print(f"about {s['disk_gb']:,.2f} GB of disk beside the outputs")
    print(*(f"  {job.name}" for job in run.tiles[:_MOST_TILES]), sep="\n")
    if len(run.tiles) > _MOST_TILES:
        print(f"  and {len(run.tiles) - _MOST_TILES} more")
    print_messages(*run.messages)
    _print_failures(run)
