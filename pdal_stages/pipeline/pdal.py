"""Call PDAL: run pipelines, ask for versions and drivers, and hide differences between versions.

No other module runs PDAL or asks it anything. But :mod:`.python_pdal` makes objects of
python-pdal's classes, ``plugin/install.py`` looks for PDAL's library and headers, and
``plugin/stage.cpp`` runs inside PDAL.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any

from ..base.errors import DependencyError, PipelineError
from ..base.json_types import JsonObject, StageJson
from ..base.las import header_there, named_copc, named_las
from ..base.las_check import check_readable
from .inputs_outputs import readers_files
from .interrupts import runs_pdal
from .pdal_errors import translate

INSTALL = (
    "Install PDAL with its Python bindings and its program 'pdal' on PATH: conda install -c "
    "conda-forge python-pdal pdal-plugins; on Debian or Ubuntu see docs/install.md"
)


@dataclass
class Execution:
    """The result of running a pipeline."""

    count: int
    metadata: JsonObject = field(default_factory=dict)
    arrays: list = field(default_factory=list)
    log: str = ""


def bindings() -> ModuleType:
    """Return the module `pdal`; DependencyError with the cure where it is absent or broken."""
    try:
        import pdal
    except (ImportError, OSError, subprocess.SubprocessError) as error:  # it runs program `pdal`
        reason = f"{sys.executable}: {error}"
        what = "python-pdal cannot be imported"
        raise DependencyError(what, found=reason, cure=INSTALL) from error
    return pdal


@cache
def version() -> tuple[int, int, int]:
    """Return PDAL's version, e.g. (2, 2, 0)."""
    major, minor, patch, *_ = [*map(int, re.findall(r"\d+", str(bindings().info.version))), 0, 0, 0]
    return major, minor, patch


def dotted_version() -> str:
    """Return PDAL's version as text, e.g. 2.2.0."""
    return ".".join(map(str, version()))


def program() -> str:
    """Return the path of the program `pdal`, the one beside this Python first."""
    beside = os.path.join(os.path.dirname(sys.executable), "pdal")
    if path := beside if os.access(beside, os.X_OK) else shutil.which("pdal"):
        return path
    raise DependencyError("the program 'pdal' is not on PATH", cure=INSTALL)


def _run_program(
    *arguments: str, timeout: float, input: str | None = None
) -> subprocess.CompletedProcess[str]:
    command = [program(), *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=timeout, input=input
    )


def ask_program(*arguments: str) -> str:
    """Return what `pdal` prints for some arguments."""
    done = _run_program(*arguments, timeout=120)  # so that one that hangs does not hold ours
    if not done.returncode:
        return done.stdout
    output = (done.stderr or done.stdout).strip()[-500:]
    raise PipelineError(f"pdal {' '.join(arguments)} failed", found=output)


def drivers() -> list[StageJson]:
    """Return PDAL's stages: name, description, link, extensions."""
    return json.loads(ask_program("--drivers", "--showjson"))


# ---- stages --------------------------------------------------------------------------------------


def reader_of(source: str, tag: str) -> StageJson:
    """Return the reader of a file."""
    plain = {"type": "readers.las"} if named_las(source) and not named_copc(source) else {}
    return with_types([{"filename": str(source), "tag": tag, **plain}])[0]


def writer_of(target: str) -> StageJson:
    """Return a writer that keeps the input's header, where it is a LAS file."""
    stage: StageJson = {"filename": target, "tag": "output"}
    if named_las(target):
        kind = "writers.copc" if named_copc(target) and knows_copc() else "writers.las"
        stage |= {"type": kind, "forward": "all"}
    return stage


def with_types(
    stages: Sequence[object], where: Callable[[int], str] | None = None
) -> list[StageJson]:
    """Return stages as objects with the types that PDAL infers from file names.

    Readers of LAS read extra dimensions of all versions.

    The name of a file alone is a reader, or as the last of several stages a writer. PipelineError
    where PDAL infers no type; `where` tells where a stage stands.
    """
    out = []
    for number, as_written in enumerate(stages):
        stage = dict(as_written) if isinstance(as_written, dict) else {"filename": as_written}
        if not stage.get("type"):
            bindings()
            from pdal import libpdalpython

            name = str(stage.get("filename", ""))
            kind = "writer" if 0 < number == len(stages) - 1 else "reader"
            plain = "".join(c if c.isascii() else "_" for c in name)  # that no locale refuses
            stage["type"] = str(getattr(libpdalpython, f"infer_{kind}_driver")(plain))
            if not name or not stage["type"]:
                what = f"PDAL has no {kind} for a file of this name"
                what = what if name else "a stage has neither a type nor the name of a file"
                cure = "Is the suffix mistyped (.laz, .las)? A folder is named with a slash at its "
                cure += "end. Otherwise give the stage a type: "
                place = where(number) if where else None
                raise PipelineError(what, where=place, found=name, cure=f'{cure}"{kind}s.las"')
        if isinstance(named := stage.get("filename"), str) and named.startswith("~"):
            stage["filename"] = os.path.join(".", named)  # PDAL takes ~ for somebody's home
        if stage["type"] == "readers.las" and not stage.keys() & {"extra_dims", "ignore_vlr"}:
            stage.setdefault("use_eb_vlr", True)  # else PDAL drops extra bytes of LAS 1.0-1.3
        out.append(stage)
    return out


# ---- running -------------------------------------------------------------------------------------


def execute(
    stages: list[StageJson], *, arrays: bool = True, loglevel: int = logging.WARNING
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
        check_readable(path)  # newer PDAL crashes on a LAZ file that is cut short
    with _one_run:
        return _execute(stages, arrays, loglevel)


#: PDAL puts its log in the place of sys.stdout while it runs and restores what it replaced, which
#: in two threads is the other's log. It also holds Python still, so runs in threads gain nothing
#: from each other.
_one_run = threading.RLock()
#: A reader of one point, without a file.
ONE_POINT: StageJson = {
    "type": "readers.faux",
    "mode": "constant",
    "count": 1,
    "bounds": "([1, 2], [1, 2], [1, 2])",
}
_FAILED_WRITER = re.compile(r"(writers\.\w+) Error\) (GDAL failure (?!\(\d+\) PROJ:).*)")


@cache
def _lasting_pipeline() -> Any:
    """Return a pipeline that lives as long as the program.

    When PDAL runs a pipeline it lets GDAL report errors to the log of that one, also when it is
    gone: the next error, as of a reference system that PROJ does not know, crashes. Running this
    one gives GDAL a log that stays.
    """
    return bindings().Pipeline(json.dumps([ONE_POINT]))


@runs_pdal
def _execute(stages: list[StageJson], arrays: bool, loglevel: int) -> Execution:
    pdal = bindings()
    stdout = sys.stdout
    pipeline = None
    _lasting_pipeline().execute()  # after pipelines that others ran
    try:
        pipeline = pdal.Pipeline(json.dumps(for_this_version(stages)), loglevel=loglevel)
        count = pipeline.execute()
        metadata = pipeline.metadata  # text in older python-pdal, a dict in newer
    except (RuntimeError, ValueError, IndexError, OverflowError) as error:  # of C++
        keep_alive(stdout)
        raise translate(str(error), log_lines(_log(pipeline))[-3:]) from None
    finally:
        # A stage that raises leaves sys.stdout pointing into PDAL's log.
        sys.stdout = stdout
        _lasting_pipeline().execute()
    log = _log(pipeline)
    if failure := _FAILED_WRITER.search(log):  # after which PDAL goes on
        reason = ": ".join(failure.groups())
        raise PipelineError("an output file could not be written", found=reason)
    if isinstance(metadata, str):
        with contextlib.suppress(ValueError):
            metadata = json.loads(metadata)
    metadata = metadata if isinstance(metadata, dict) else {}
    return Execution(int(count), metadata, list(pipeline.arrays) if arrays else [], log)


#: How PDAL begins a line of its log; some stages say their name once more.
_BY_PROGRAM = re.compile(
    r"^\((?:pypipeline|pdal pipeline)\s+(\S+?)\s+\w+\)\s*(?:\1:\s*)?", re.IGNORECASE
)
_kept_alive: dict[int, object] = {}


def keep_alive(stdout: object) -> None:
    """Keep a sys.stdout after a script failed: PDAL borrows the reference until a run succeeds."""
    _kept_alive[id(stdout)] = stdout


def log_lines(log: str) -> list[str]:
    """Return warnings and errors of a log, once each: ``filters.smrf: ...``."""
    lines = [_BY_PROGRAM.sub(r"\1: ", line.strip()) for line in str(log or "").splitlines()]
    return list(dict.fromkeys(filter(None, lines)))


def _log(pipeline: Any) -> str:
    """Return the log of PDAL and GDAL, which may quote names that are not UTF-8."""
    try:
        return str(getattr(pipeline, "log", "") or "")
    except UnicodeDecodeError as error:
        return error.object.decode(errors="backslashreplace")
    except RuntimeError:  # a pipeline that PDAL could not make has no log
        return ""


def validate(stages: list[StageJson]) -> None:
    """Let the program `pdal` check stages and their options, without reading points."""
    text = json.dumps({"pipeline": for_this_version(stages)})
    done = _run_program("pipeline", "--validate", "--stdin", input=text, timeout=300)
    output = (done.stderr or done.stdout).strip()
    verdict = {"valid": done.returncode == 0, "error_detail": output}
    with contextlib.suppress(ValueError):
        verdict = json.loads(done.stdout)
    if not verdict.get("valid", False):
        raise translate(str(verdict.get("error_detail") or "the pipeline is not valid"))


# ---- what differs between versions ---------------------------------------------------------------


def for_this_version(stages: list[StageJson]) -> list[StageJson]:
    """Return stages that this PDAL knows: before 2.4 a COPC file is read as plain LAZ.

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
            stage = {**stage, "type": "readers.las"}  # which refuses options to read a part
        out.append(stage)
    return out


def _file_source(writer: StageJson, before: list[StageJson]) -> int:
    """Return the file source id that a writer forwards; 0 where inputs differ or are LAS 1.0."""
    forward = str(writer.get("forward", ""))
    forwards = any(word in forward for word in ("all", "header", "filesource_id"))
    headers = map(header_there, readers_files(before, las=True)) if forwards else ()
    ids = {header.source_id for header in headers if header}
    return ids.pop() if len(ids) == 1 else 0


@cache
def las_writer_defaults() -> tuple[int, int]:
    """Return (minor_version, dataformat_id) that `writers.las` uses where neither is set."""
    described = ask_program("--options", "writers.las")
    minor = re.search(r"minor_version \[(\d+)\]", described)
    format_id = re.search(r"dataformat_id \[(\d+)\]", described)
    # Newer PDAL's defaults, should it print none.
    return int(minor.group(1)) if minor else 4, int(format_id.group(1)) if format_id else 7


def knows_copc() -> bool:
    """Return whether this PDAL reads and writes COPC."""
    return version() >= (2, 4, 0)


def needs_ground_check() -> bool:
    """Return whether this PDAL crashes in heights above ground where no point is ground."""
    return version() < (2, 9, 0)


def compresses_las_14() -> bool:
    """Return whether this PDAL compresses LAS 1.4 with class codes above 31."""
    return version() >= (2, 3, 0)


@cache
def splits_class_flags() -> bool:
    """Return whether readers split the flags of LAS 1.0-1.3 from the class (from PDAL 2.6 on)."""
    return "Withheld" in {dimension["name"] for dimension in bindings().dimensions}


def flags_inside_classification(dimensions: Container[str], metadata: object) -> bool:
    """Return whether flag bits of LAS 1.0-1.3 sit inside `Classification`, as before PDAL 2.6.

    Newer versions have a dimension for each flag; LAS 1.4 formats have `ClassFlags`.
    """
    flags = ("Synthetic", "KeyPoint", "Withheld", "Overlap", "ClassFlags")
    return max(point_formats(metadata), default=6) <= 5 and not any(f in dimensions for f in flags)


def overlap_as_flag(dimensions: Container[str], metadata: object) -> bool:
    """Return whether class 12 (overlap) of LAS 1.0-1.3 is class 0 with the flag Overlap (2.6 on).

    Files of LAS 1.4 have both the class and the flag: there class 0 with the flag is a point not
    yet classified.
    """
    return "Overlap" in dimensions and min(point_formats(metadata), default=6) <= 5


def point_formats(metadata: object) -> list[int]:
    """Return the point data record formats of the files that were read, from PDAL's metadata."""
    return [int(v) for v in map(str, _values(metadata, "dataformat_id")) if v.isdigit()]


def _values(node: object, name: str) -> list[object]:
    """Return all values of a name in metadata: nodes in filters.python, a dict in a pipeline."""
    if isinstance(node, list):
        return [value for child in node for value in _values(child, name)]
    if not isinstance(node, dict):
        return []
    values = [node.get("value")] if node.get("name") == name else []
    for key, child in node.items():
        is_value = key == name and not isinstance(child, dict | list)
        values += [child] if is_value else _values(child, name)
    return values
