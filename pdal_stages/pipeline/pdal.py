"""The only module that calls PDAL: running pipelines, versions, drivers, and differences between
versions.
"""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import CodeType, FrameType
from typing import Any, BinaryIO, TypeVar

from ..base.errors import DependencyError, PipelineError
from ..base.las import geotiff_code, read_header, source_id
from ..base.las_check import DAMAGED, check_readable
from ..base.las_repair import LARGEST_HEAD, corrected, overwritten
from .stage_files import reader_files, readers_files, writers_outputs

INSTALL = (
    "Install PDAL with its Python bindings: conda install -c conda-forge python-pdal pdal-plugins; "
    "on Debian or "
    "Ubuntu see docs/install.md"
)
_DRIVER_CURE = (
    "filters.python comes with the package pdal-plugins. Install it for this Python (pip install "
    "pdal-plugins), and "
    "set PDAL_DRIVER_PATH to the folder that holds libpdal_plugin_filter_python"
)


@dataclass
class Execution:
    """The result of running a pipeline."""

    count: int
    metadata: dict[str, Any] = field(default_factory=dict)
    arrays: list = field(default_factory=list)
    log: str = ""


def bindings():
    """The module `pdal`; :class:`DependencyError` with the cure where it is absent or broken."""
    try:
        import pdal
    except ImportError as error:
        found = f"{sys.executable}: {error}"
        raise DependencyError(
            "python-pdal cannot be imported", found=found, cure=INSTALL
        ) from error
    except (
        OSError,
        subprocess.SubprocessError,
    ) as error:  # it asks the program `pdal` for its drivers
        what, cure = (
            "python-pdal could not start the program 'pdal'",
            f"Put pdal on PATH. {INSTALL}",
        )
        raise DependencyError(what, found=str(error), cure=cure) from error
    return pdal


@cache
def version() -> tuple[int, int, int]:
    """PDAL's version, e.g. (2, 2, 0)."""
    major, minor, patch, *_ = [*map(int, re.findall(r"\d+", str(bindings().info.version))), 0, 0, 0]
    return major, minor, patch


def dotted_version() -> str:
    """PDAL's version as text, e.g. 2.2.0."""
    return ".".join(map(str, version()))


def program() -> str:
    """Path of the program `pdal`, the one beside this Python first."""
    beside = os.path.join(os.path.dirname(sys.executable), "pdal")
    if found := beside if os.access(beside, os.X_OK) else shutil.which("pdal"):
        return found
    raise DependencyError("the program 'pdal' is not on PATH", cure=INSTALL)


def _run_program(*arguments: str, **how: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [program(), *arguments], capture_output=True, text=True, check=False, **how
    )


def ask_program(*arguments: str) -> str:
    """What `pdal` prints for some arguments."""
    done = _run_program(*arguments, timeout=120)
    if not done.returncode:
        return done.stdout
    said = (done.stderr or done.stdout).strip()[-500:]
    raise PipelineError(f"pdal {' '.join(arguments)} failed", found=said)


def execute(
    stages: list[dict[str, Any]], *, arrays: bool = True, loglevel: int = logging.WARNING
) -> Execution:
    """Run a plain PDAL pipeline in this process.

    Raises
    ------
    PipelineError
        With PDAL's own words.
    StageError
        If a LAS file that is read is damaged.
    DependencyError
        If python-pdal or filters.python is missing.
    """
    for path in readers_files(stages, las=True):
        check_readable(path)  # newer PDAL crashes of a LAZ file that is cut short
    with _one_run, readable(stages) as copies:
        return _execute(copies, arrays, loglevel)


@contextlib.contextmanager
def readable(stages: list[dict[str, Any]], points: bool = True) -> Iterator[list[dict[str, Any]]]:
    """Give the stages with readers of copies in place of LAS files that PDAL cannot read as they
    are.

    See :mod:`..base.las_repair`. The copies lie beside what is written, and are removed on leaving.
    Without `points` they hold what stands before the points.
    """
    beside = [os.path.dirname(output.path) for output in writers_outputs(stages)][:1]
    with contextlib.ExitStack() as stack:
        made: list[dict[str, Any]] = []
        for stage in stages:
            paths = reader_files(stage, las=True)
            extra = not stage.keys() & {"extra_dims", "ignore_vlr"}
            asked = str(stage.get("use_eb_vlr", "")).lower() == "true"
            streams = [corrected(path, extra and (asked or _is_las_14(path))) for path in paths]
            if any(streams):
                folder = tempfile.TemporaryDirectory(
                    prefix=".pdal-stages-input-", dir=next(filter(os.path.isdir, beside), None)
                )
                most = None if points else LARGEST_HEAD
                name = _copied(stack.enter_context(folder), paths, streams, most)
                stage = {**stage, "filename": name}
            made.append(stage)
        yield made


def _is_las_14(path: str) -> bool:
    header = read_header(path)
    return header is not None and header.minor >= 4


def _copied(
    folder: str, paths: list[str], streams: Sequence[BinaryIO | None], most: int | None
) -> str:
    """Copy corrected files into a folder, with links to the others; return the name or pattern of
    all of them.

    Of each file, `most` bytes are copied, and the rest is a hole.
    """
    names = [os.path.join(folder, f"{n:06}{_suffix(path)}") for n, path in enumerate(paths)]
    for name, path, stream in zip(names, paths, streams, strict=True):
        if stream is None:
            os.symlink(os.path.abspath(path), name)
            continue
        with stream, open(name, "xb") as copy:
            if most is None:
                shutil.copyfileobj(stream, copy, 1 << 20)
            else:
                copy.write(stream.read(most))
                copy.truncate(stream.seek(0, os.SEEK_END))
    return names[0] if len(names) == 1 else os.path.join(folder, "*")


def _suffix(path: str) -> str:
    return ".laz" if path.lower().endswith("z") else ".las"


#: PDAL puts its log in the place of sys.stdout while it runs and puts back what it found there,
#: which in two threads is the other's log. It also holds Python still, so runs in threads gain
#: nothing from each other.
_one_run = threading.RLock()


def _execute(stages: list[dict[str, Any]], arrays: bool, loglevel: int) -> Execution:
    pdal = bindings()
    stdout = sys.stdout
    pipeline = None
    try:
        pipeline = pdal.Pipeline(json.dumps(adapted(stages)), loglevel=loglevel)
        count = pipeline.execute()
        metadata = pipeline.metadata  # text in older python-pdal, a dict in newer
    except (
        RuntimeError,
        ValueError,
        IndexError,
        OverflowError,
    ) as error:  # C++'s errors, as Python has them
        keep(stdout)
        if _CUT_POINTS.search(str(error)) and (read := readers_files(stages, las=True)):
            raise PipelineError(
                "the LAS file is damaged: its points cannot be decoded",
                where=read[0] if len(read) == 1 else "one of " + ", ".join(read),
                found=str(error).strip(),
                cure=DAMAGED,
            ) from None
        raise translate(str(error), log_lines(_log(pipeline))[-3:]) from None
    except MemoryError:
        cure = "Work in tiles (--tile), or read less, e.g. with filters.crop"
        raise PipelineError("memory ran out", cure=cure) from None
    finally:
        # A stage that raises leaves sys.stdout pointing into PDAL's log.
        sys.stdout = stdout
    log = _log(pipeline)
    if failed := _FAILED_WRITER.search(log):  # after which PDAL goes on
        raise PipelineError("an output file could not be written", found=": ".join(failed.groups()))
    if isinstance(metadata, str):
        with contextlib.suppress(ValueError):
            metadata = json.loads(metadata)
    found = metadata if isinstance(metadata, dict) else {}
    return Execution(int(count), found, list(pipeline.arrays) if arrays else [], log)


_CUT_POINTS = re.compile(r"readers\.las: .*(reading point \d+ of \d+|[Cc]ouldn't read .*point)")
_FAILED_WRITER = re.compile(r"(writers\.\w+) Error\) (GDAL failure (?!\(\d+\) PROJ:).*)")
BROKEN_REFERENCE = "the spatial reference in the file cannot be read"
REFERENCE_CURE = 'Name the right one, --readers.las.override_srs=EPSG:CODE (in a pipeline "override_srs" of the reader)'
#: How PDAL begins a line of its log; some stages say their name once more.
_BY_PROGRAM = re.compile(
    r"^\((?:pypipeline|pdal pipeline)\s+(\S+?)\s+\w+\)\s*(?:\1:\s*)?", re.IGNORECASE
)
_kept: list[Any] = []


def keep(stdout: Any) -> None:
    """Keep a reference to sys.stdout after a script failed: PDAL holds a borrowed one until a run
    succeeds.
    """
    if not any(kept is stdout for kept in _kept):
        _kept.append(stdout)


def log_lines(log: str) -> list[str]:
    """Warnings and errors of a log, once each: ``filters.smrf: ...``."""
    lines = [_BY_PROGRAM.sub(r"\1: ", line.strip()) for line in str(log or "").splitlines()]
    return list(dict.fromkeys(line for line in lines if line))


def stages_of(thing: Any) -> list[dict[str, Any]] | None:
    """The stages of an object of python-pdal; None where it is not one."""
    pdal = bindings()
    stages = thing.stages if isinstance(thing, pdal.Pipeline) else [thing]
    if not all(isinstance(stage, pdal.pipeline.Stage) for stage in stages):
        return None
    return [{"type": stage.type, **stage.options} for stage in stages]


def typed(stages: Sequence[Any], where: Callable[[int], str] | None = None) -> list[dict[str, Any]]:
    """Stages as objects with a type: the name of a file stands for the reader or writer that PDAL
    infers from it.

    A writer is meant by the last of several stages. PipelineError where PDAL infers none; `where`
    says where a stage stands.
    """
    out = []
    for number, given in enumerate(stages):
        stage = dict(given) if isinstance(given, dict) else {"filename": given}
        if not stage.get("type"):
            bindings()
            from pdal import libpdalpython

            name = str(stage.get("filename", ""))
            kind = "writer" if 0 < number == len(stages) - 1 else "reader"
            plain = "".join(c if c.isascii() else "_" for c in name)  # that no locale refuses
            stage["type"] = str(getattr(libpdalpython, f"infer_{kind}_driver")(plain))
            if not name or not stage["type"]:
                raise PipelineError(
                    f"PDAL has no {kind} for a file of this name"
                    if name
                    else "a stage has neither a type nor the name of a file",
                    where=where(number) if where else None,
                    found=name,
                    cure="Is the suffix mistyped (.laz, .las)? Otherwise give the stage a type: "
                    f'"{kind}s.las"',
                )
        out.append(stage)
    return out


def validate(stages: list[dict[str, Any]]) -> None:
    """Let the program `pdal` check stages and their options, without reading points."""
    with readable(stages, points=False) as copies:
        text = json.dumps({"pipeline": adapted(copies)})
        done = _run_program("pipeline", "--validate", "--stdin", input=text, timeout=300)
    try:
        verdict = json.loads(done.stdout)
    except ValueError:
        verdict = {
            "valid": done.returncode == 0,
            "error_detail": (done.stderr or done.stdout).strip(),
        }
    if not verdict.get("valid", False):
        raise translate(str(verdict.get("error_detail") or "the pipeline is not valid"))


def translate(message: str, before: Sequence[str] = ()) -> PipelineError | DependencyError:
    """PDAL's error text, and the log lines `before`, as one of our errors, with a cure where the
    cause is known.
    """
    text = message.strip()
    if re.search(r"(create|load|find).*filters\.python", text) or (
        "filters.python" in text and "driver" in text.lower()
    ):
        return DependencyError("PDAL has no filters.python", found=text, cure=_DRIVER_CURE)
    if "ModuleNotFoundError" in text and "pdal_stages" in text:
        return DependencyError(
            "the Python that PDAL runs does not have pdal_stages",
            found=text.splitlines()[-1],
            cure="Install pdal_stages into the Python that the plugin of filters.python was built "
            "for",
        )
    if "convert spatial reference" in text:
        return PipelineError(BROKEN_REFERENCE, found=_one_line(text, before), cure=REFERENCE_CURE)
    if (
        "Traceback (most recent call last)" in text
    ):  # of a script, as the pieces of a list in older PDAL
        lines = [line.strip(" '") for line in text.replace("\\n", "\n").splitlines()]
        place = [line for line in lines if line.startswith("File ")][-1:]
        last = [line for line in lines if line][-1]
        return PipelineError("a script of filters.python failed", found="; ".join([last, *place]))
    return PipelineError("PDAL could not run the pipeline", found=_one_line(text, before))


def _one_line(text: str, before: Sequence[str]) -> str:
    """What PDAL says, which quotes names of files that may hold line breaks, and log lines before
    it.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return "; ".join([*lines, *before])


def _log(pipeline) -> str:
    """The log of PDAL and GDAL, which may quote names that are not UTF-8."""
    try:
        return str(getattr(pipeline, "log", "") or "")
    except UnicodeDecodeError as error:
        return error.object.decode(errors="backslashreplace")
    except RuntimeError:  # a pipeline that PDAL could not even make has none
        return ""


# ---- Ctrl-C while PDAL runs ----------------------------------------------------------------------

# PDAL's plugins crash when KeyboardInterrupt comes up in Python code that PDAL called. So it is
# raised only inside functions that `catches` marks, which hand it on as an error; otherwise it
# waits for `check_interrupt`.
_Function = TypeVar("_Function", bound=Callable)
_catching: set[CodeType] = set()
_handling = False
_asked = False


def catches(function: _Function) -> _Function:
    """Mark a function inside which KeyboardInterrupt may be raised, even if PDAL called it."""
    _catching.add(function.__code__)
    return function


def check_interrupt() -> None:
    """Raise KeyboardInterrupt if the user asked to stop."""
    if _asked:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _asked
    _asked = True
    inside_pdal = False
    while frame is not None:
        if frame.f_code in _catching:
            raise KeyboardInterrupt
        inside_pdal |= frame.f_code is _execute.__code__
        frame = frame.f_back
    if not inside_pdal:
        raise KeyboardInterrupt


@contextlib.contextmanager
def gentle() -> Iterator[None]:
    """Handle Ctrl-C this way, and SIGTERM where Python handles it."""
    global _asked, _handling
    if _handling or threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(n))]
    before = {number: signal.signal(number, _handle) for number in numbers}
    _handling, _asked = True, False
    try:
        yield
    finally:
        _handling = _asked = False
        for number, handler in before.items():
            signal.signal(number, handler)


# ---- what differs between versions ---------------------------------------------------------------


def adapted(stages: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Stages that this PDAL knows: before 2.4 a COPC file is read as plain LAZ.

    Options that old PDAL reads from uninitialized memory are set where the user does not: the file
    source id of `writers.las` to 0, and the measure dimension of `writers.ogr`, which crashes
    otherwise, to Z.
    """
    if version() >= (2, 4, 0):
        return stages
    out: list[Any] = []
    for number, stage in enumerate(stages):
        kind = stage["type"]
        if kind == "writers.las":
            stage = {"filesource_id": _file_source(stage, stages[:number]), **stage}
        elif kind == "writers.ogr":
            stage = {"measure_dim": "Z", **stage}
        elif kind == "readers.copc":
            if beyond := [name for name in stage if name in _COPC_OPTIONS]:
                raise PipelineError(
                    f"PDAL {dotted_version()} reads COPC files whole, without {', '.join(beyond)}",
                    where="readers.copc",
                    found=str(stage.get("filename", "")),
                    cure="Use PDAL 2.4 or later, or filters.crop after the reader",
                )
            stage = {
                **{k: v for k, v in stage.items() if k not in _COPC_TUNING},
                "type": "readers.las",
            }
        else:
            codes = {geotiff_code(path) for path in reader_files(stage, las=True)}
            if len(codes) == 1 and "" not in codes:  # which that PDAL does not look at
                stage = {"default_srs": codes.pop(), **stage}
        out.append(stage)
    return out


def _file_source(writer: dict[str, Any], before: list[dict[str, Any]]) -> int:
    """The file source id that a writer forwards, 0 where it forwards none: inputs differ, or are of
    LAS 1.0.
    """
    forward = str(writer.get("forward", ""))
    forwards = any(word in forward for word in ("all", "header", "filesource_id"))
    ids = {source_id(path) for path in readers_files(before, las=True)} if forwards else set()
    return ids.pop() if len(ids) == 1 else 0


#: Options of readers.copc that choose points, and those that only make it faster.
_COPC_OPTIONS = ("bounds", "polygon", "ogr", "resolution", "origin")
_COPC_TUNING = ("requests", "keep_alive", "header", "query", "vlr", "fix_dims", "srs_vlr_order")


@cache
def las_writer_defaults() -> tuple[int, int]:
    """(minor_version, dataformat_id) that this PDAL's `writers.las` uses where neither is given."""
    described = ask_program("--options", "writers.las")
    minor = re.search(r"minor_version \[(\d+)\]", described)
    format_id = re.search(r"dataformat_id \[(\d+)\]", described)
    return int(minor.group(1)) if minor else 4, int(format_id.group(1)) if format_id else 7


def knows_copc() -> bool:
    """Whether this PDAL reads and writes COPC."""
    return version() >= (2, 4, 0)


@cache
def splits_class_flags() -> bool:
    """Whether readers give the flags of LAS 1.0-1.3 apart from the class (PDAL 2.2 does not)."""
    return "Withheld" in {one["name"] for one in bindings().dimensions}


def flags_inside_classification(dimensions, metadata: Any) -> bool:
    """Whether the flag bits of LAS 1.0-1.3 sit inside `Classification`, as PDAL 2.2 reads them.

    Newer versions have a dimension for each flag; LAS 1.4 formats have `ClassFlags`.
    """
    if any(
        name in dimensions
        for name in ("Synthetic", "KeyPoint", "Withheld", "Overlap", "ClassFlags")
    ):
        return False
    formats = _point_formats(metadata)
    return bool(formats) and max(formats) <= 5


def overlap_as_flag(dimensions, metadata: Any) -> bool:
    """Whether class 12 (overlap) of LAS 1.0-1.3 is read as class 0 with the flag Overlap, as PDAL
    from 2.6 on does.

    Files of LAS 1.4 have both the class and the flag: there class 0 with the flag is a point not
    yet classified.
    """
    return "Overlap" in dimensions and min(_point_formats(metadata), default=6) <= 5


def _point_formats(metadata: Any) -> list[int]:
    """Return the point data record formats of the files that were read, from PDAL's metadata."""
    return [int(v) for v in _values(metadata, "dataformat_id") if str(v).isdigit()]


def overwritten_dimensions(metadata: Any) -> list[str]:
    """Names of dimensions that a reader has overwritten with extra bytes, from metadata as
    filters.python has it.
    """
    nodes = metadata.get("children", []) if isinstance(metadata, dict) else []
    own = {node["name"]: node["value"] for node in nodes if isinstance(node, dict)}
    found = [name for node in nodes for name in overwritten_dimensions(node)]
    for node in nodes if str(own.get("dataformat_id", "")).isdigit() else ():
        record = {child["name"]: child["value"] for child in node.get("children", [])}
        if (record.get("user_id"), str(record.get("record_id"))) == ("LASF_Spec", "4"):
            data = base64.b64decode(record.get("data", ""))
            found += overwritten(int(own["dataformat_id"]), data)
    return found


def _values(node: Any, name: str) -> list[Any]:
    """All values of a name in metadata, as filters.python hands them over (nodes) or a pipeline
    gives them (a dict).
    """
    if isinstance(node, list):
        return [value for child in node for value in _values(child, name)]
    if not isinstance(node, dict):
        return []
    own = [node.get("value")] if node.get("name") == name else []
    for key, child in node.items():
        own += (
            [child] if key == name and not isinstance(child, dict | list) else _values(child, name)
        )
    return own
