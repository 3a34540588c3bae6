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
from typing import TYPE_CHECKING

from ..base.asprs import class_name
from ..base.errors import OptionError, StageError
from ..base.files import check_writable, write_whole
from ..base.memory import parse_size
from ..base.plain import one_line, print_messages
from ..pipeline.inputs_outputs import is_ept, is_folder, is_las
from ..pipeline.read import PipelineSource
from ..pipeline.run import Pipeline
from .classify import ClassifyTask, Written
from .outcome import LEFT_ALONE, FoundObjects, InterruptedRun, TiledRun
from .settings import PER, TilingOptions
from .tiledrun import run_tiled
from .tileplan import make_plan

if TYPE_CHECKING:
    from .training import TrainTask


def add_arguments(command: argparse.ArgumentParser, survey: bool = False) -> None:
    """Add the flags to the parser of ``pipeline``, or of ``classify`` (a `survey`)."""
    when = "Several inputs, and files too large for memory, are cut into tiles" if survey else "Run in tiles"
    group = command.add_argument_group("large areas", f"{when}; see docs/large-areas.md.")
    takes = group.add_argument
    _add_sizes(takes)
    takes("--scheduler", default="", metavar="ADDRESS", help="A running Dask scheduler, tcp://HOST:8786")
    takes("--per", choices=PER, default="auto", help="One output per input file or per tile (auto: per file)")
    takes(
        "--buffer",
        type=float,
        metavar="METERS",
        help=argparse.SUPPRESS if survey else "Surroundings for PDAL filters that look at neighbors",
    )
    takes("--resume", action="store_true", help="Keep what an earlier run in this folder finished")
    takes("--dry-run", action="store_true", help="Show the tiles and an estimate, then stop")
    takes(
        "--report",
        action="append",
        default=[],
        metavar="FILE",
        help="Write a report, .html or .json; may be repeated",
    )


def add_tile_arguments(command: argparse.ArgumentParser) -> None:
    """Add the flags of ``train``, whose only output is a model."""
    what = "Points that do not fit into the memory are worked on in tiles; the model is the same."
    _add_sizes(command.add_argument_group("large areas", what).add_argument)


def _add_sizes(takes: Callable) -> None:
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
    """Whether a run in tiles is asked for."""
    if options.tile is not None:
        return True
    given = {
        "--memory": options.memory is not None,
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
            raise OptionError(
                f"{flag} needs --tile", cure="Give the side of the tiles, e.g. --tile 500, or --tile auto"
            )
    return False


def run_training(task: TrainTask) -> list[str]:
    """Train in tiles; what is to be told."""
    with interruptible():
        return task.run()


def run_command(options: argparse.Namespace, source: Path | PipelineSource) -> int:
    """Run ``pdal-stages pipeline --tile``; the exit code, 1 where anything failed."""
    _check_reports(options)
    chosen = options_of(options)
    pipeline = Pipeline(source, options.overrides, whole=False)
    if options.validate:
        make_plan(pipeline, chosen.buffer)
        print(pipeline.validate())
        return 0
    interrupted = False
    with interruptible():
        try:
            run = run_tiled(pipeline, chosen, dry_run=options.dry_run)
        except InterruptedRun as stopped:
            run, interrupted = stopped.run, True
    _print_dry(run) if options.dry_run else _print(run)
    return _end(options, run, "run it again with --resume" if interrupted else "")


def _check_reports(options: argparse.Namespace) -> None:
    for name in options.report:
        if Path(name).suffix.lower() not in (".html", ".htm", ".json"):
            raise OptionError("--report writes .html or .json", found=name)
        check_writable(name, "report")
    if options.metadata:
        check_writable(options.metadata, "metadata")


def _end(options: argparse.Namespace, run: TiledRun, again: str) -> int:
    """Write reports; the exit code. `again`: of an interrupted run, how to go on."""
    if options.metadata:
        _write_json(options.metadata, run, "--metadata")
    for name in options.report:
        _write_report(name, run)
    if not again:
        return 1 if run.failures else 0
    states = run.summary["states"]
    done = states["done"] + states["kept"]
    files = sum(out.state in ("done", "kept") for out in run.outputs)
    written = f"{files:,} of {_counted(len(run.outputs), 'file')} written, " if run.outputs else ""
    print_messages(
        f"interrupted; nothing half-written was left. {written}{done:,} of {_counted(len(run.tiles), 'tile')} done. "
        f"For the rest: {again}"
    )
    return 130


# ---- classify --------------------------------------------------------------------------------------------


def classify(
    task: ClassifyTask, options: argparse.Namespace, then: Callable[[], FoundObjects] | None = None
) -> int:
    """Run ``pdal-stages classify``; the exit code, 1 where anything failed. `then`: what is done with whole outputs."""
    _check_reports(options)
    if not task.can_be_cut:
        _refuse_tiles(task, options)
    names = {code: one_line(name) for code, name in task.request.loaded.classes}
    if options.dry_run and (task.in_one_piece() or not task.can_be_cut):
        task.request.pipeline(
            task.files[0], str(Path(task.output) / "dry-run.laz") if is_folder(task.output) else task.output
        )
        print(f"{_counted(len(task.files), 'input')}, each in one piece")
        return 0
    if task.in_one_piece() and not options.report:
        end_at_once(options)
        written = task.run_whole()
        print_messages(*written.messages)
        print(f"{_counted(written.points, 'point')} written to {written.path}")
        _print_classes([written], names)
        if then is not None:
            then()
        return 0
    if not task.can_be_cut:
        code = _classify_each(task, options, names)
        if then is not None and code == 0:
            then()
        return code
    done: list[Written] = []

    def finished(written: Written) -> None:
        done.append(written)
        print(f"{written.path}: {_counted(written.points, 'point')}{_shares(written, names)}", flush=True)

    interrupted = False
    with interruptible():
        try:
            run = task.run_tiles(dry_run=options.dry_run, finished=finished)
        except InterruptedRun as stopped:
            run, interrupted = stopped.run, True
    if options.dry_run:
        _print_dry(run)
    else:
        _print(run, "files" if run.outputs else "")
        _print_classes(done, names, run.summary["left_alone"])
        if then is not None and not interrupted and not run.failures:
            try:
                run.objects = then()
            except StageError:
                _end(options, run, "")
                raise
    return _end(options, run, _again(options) if interrupted else "")


def _again(options: argparse.Namespace) -> str:
    """The command that goes on where this one stopped."""
    words = [word for word in options.arguments if word != "--resume"]
    same = shlex.join(["pdal-stages", *words]) if len(words) <= 20 else "the same command with"
    return f"{same} --resume"


def _refuse_tiles(task: ClassifyTask, options: argparse.Namespace) -> None:
    """Flags that mean nothing for inputs of which parts cannot be read."""
    asked = {
        flag: getattr(options, flag) not in (None, False, "", "auto", [])
        for flag in ("tile", "memory", "per", "scheduler", "buffer", "resume", "report")
    }
    asked["tile"] = options.tile is not None  # auto is a wish as well
    for flag, used in asked.items():
        if used:
            raise OptionError(
                f"--{flag} needs inputs that can be cut into tiles: LAS, LAZ, COPC or EPT",
                found=next(name for name in task.files if not is_las(name) and not is_ept(name)),
                cure=f"Convert them first: pdal translate INPUT input.laz; or leave --{flag} out",
            )


def _classify_each(task: ClassifyTask, options: argparse.Namespace, names: Mapping[int, str]) -> int:
    """Inputs of which parts cannot be read, one after the other."""
    messages = _MessagesOnce()
    done: dict[str, Written] = {}
    failed: dict[str, str] = {}
    interrupted = False
    try:
        for source, what in task.run_each(apart=options.is_program):
            if isinstance(what, Written):
                done[source] = what
                print(f"{what.path}: {_counted(what.points, 'point')}{_shares(what, names)}", flush=True)
            else:
                failed[source] = what
            for line in [what] if isinstance(what, str) else what.messages:
                messages.add(source, line)
    except KeyboardInterrupt:
        interrupted = True
    messages.end()
    if len(task.files) > 1:
        print_messages(
            "each file was classified by itself: only LAS, LAZ, COPC and EPT inputs can be cut into tiles"
        )
    _print_classes([done[source] for source in task.files if source in done], names)
    if options.metadata:
        files = [
            {"input": source}
            | ({"output": done[source].path, "metadata": done[source].metadata} if source in done else {})
            | ({} if source in done else {"error": failed.get(source, "not done")})
            for source in task.files
        ]
        text = json.dumps({"files": files}, indent=2, default=str)
        write_whole(options.metadata, (text + "\n").encode())
    if failed:
        print_messages(f"{len(failed)} of {_counted(len(task.files), 'file')} failed")
    if interrupted:
        left = [source for source in task.files if source not in done and source not in failed]
        print_messages(
            f"interrupted; {len(done)} of {len(task.files)} files are finished and whole, of the others nothing was left. "
            f"Still to be done: {', '.join(left[:5])}{f' and {len(left) - 5:,} more' * (len(left) > 5)}"
        )
        return 130
    return 1 if failed else 0


def end_at_once(options: argparse.Namespace) -> None:
    """Ctrl-C ends the program although PDAL works: Python cannot handle signals meanwhile. The next run sweeps up."""
    if options.is_program and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


class _MessagesOnce:
    """Messages about many files: printed at once for the first, and in the end which others have it."""

    def __init__(self) -> None:
        self._files: dict[str, list[str]] = {}

    def add(self, file: str, text: str) -> None:
        text = text.removeprefix(f"{file}: ")
        if text not in self._files:
            print_messages(f"{file}: {text}")
        self._files.setdefault(text, []).append(file)

    def end(self) -> None:
        for text, (_, *others) in self._files.items():
            if others:
                more = f" and {len(others) - 3:,} more" if len(others) > 3 else ""
                print_messages(f"also {', '.join(others[:3])}{more}: {text}")


def _shares(written: Written, names: Mapping[int, str]) -> str:
    """``; 2 ground 61.3 %, 6 building 12.0 %``"""
    total = sum(written.classes.values())
    shares = [
        f"{code} {names.get(code, class_name(code))} {100.0 * n / total:.1f} %"
        for code, n in sorted(written.classes.items())
    ]
    return f"; {', '.join(shares)}" if shares else ""


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


def _print(run: TiledRun, unit: str = "") -> None:
    s = run.summary
    states = s["states"]
    line = f"{_counted(states['done'], 'tile')} done"
    if states["kept"]:
        line += f", {states['kept']} kept from an earlier run"
    if states["failed"]:
        line += f", {states['failed']} failed"
    if unit:
        files = [sum(out.state == state for out in run.outputs) for state in ("done", "kept", "failed")]
        more = [
            f"{n:,} {what}"
            for n, what in zip(files[1:], ("kept from an earlier run", "failed"), strict=True)
            if n
        ]
        line = f"{_counted(files[0], 'file')} written{''.join(f', {words}' for words in more)}; {line}"
    print(f"{line}; {s['points']:,} points in {s['seconds']:.1f} s ({s['points_per_second']:,.0f} points/s)")
    if s["dropped"]:
        print(f"{s['dropped']:,} points were dropped by filters of the pipeline")
    failures = run.failures
    print_messages(*run.messages, *(f"{what}: {reason}" for what, reason in failures[:20]))
    if len(failures) > 20:
        print_messages(f"and {len(failures) - 20} more; see --report")
    if failures:
        print_messages("run it again with --resume to try only what failed")


def _print_dry(run: TiledRun) -> None:
    s = run.summary
    print(f"{_counted(len(run.tiles), 'tile')} of {s['tile']:g}, each read with {s['halo_m']:g} m around it")
    print(f"{_counted(s['inputs'], 'input')}, {s['points']:,} points; one output for each {s['per']}")
    print(
        f"about {s['points_read_by_a_tile']:,} points read for a tile, {s['points_of_largest_tile']:,} its own at most"
    )
    memory = s["memory_mb_of_a_worker"]
    workers = {0: "this process", 1: "the worker"}.get(s["workers"], f"each of {s['workers']} workers")
    print(f"up to {memory:,.0f} MB for {workers} with {_counted(s['threads_per_worker'], 'thread')}")
    hours = f"roughly {s['core_hours']:.2f}" if s["core_hours"] >= 0.01 else "less than 0.01"
    print(f"{hours} core hours, at {s['points_per_core_second']:,.0f} points/s and core; the model decides")
    if s["disk_gb"] >= 0.01:
        print(f"{s['disk_gb']:,.2f} GB of disk beside the outputs, until these are written")
    for job in run.tiles[:50]:
        print(f"  {job.name:24s} {job.points:>14,} points  {_counted(len(job.sources), 'input')}")
    if len(run.tiles) > 50:
        print(f"  and {len(run.tiles) - 50} more")
    print_messages(*run.messages, *(f"{what}: {reason}" for what, reason in run.failures))


def _counted(count: int, word: str) -> str:
    return f"{count:,} {word}{'s' * (count != 1)}"


def _write_report(name: str, run: TiledRun) -> None:
    if Path(name).suffix.lower() == ".json":
        _write_json(name, run, "--report")
        return
    from ..reports.runpage import write_run_report

    write_run_report(name, run.to_dict(), run.objects.picture if run.objects else None)


def _write_json(name: str, run: TiledRun, flag: str) -> None:
    try:
        write_whole(name, (json.dumps(run.to_dict(), indent=1) + "\n").encode())
    except StageError as error:
        raise error.at(flag) from None
