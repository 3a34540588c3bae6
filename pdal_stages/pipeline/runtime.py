"""Run an expanded stage inside PDAL: from ``filters.python``'s globals to a stage's run().

The script that PDAL executes is a few lines that call :func:`run_stage`; everything else lives
here, in the installed package, where compiled code can be cached.

No exception may reach ``filters.python``: it releases the exception, its type and its traceback
twice, so Python crashes, at once or minutes later. A stage that fails therefore returns normally
and hands over one array under a name no dimension has, its message; PDAL refuses that with an error
that holds the name.
"""

from __future__ import annotations

import json
import sys
import uuid
from collections import ChainMap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import InterruptedStage, StageError
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Report
from ..stages.base import WHOLE_CLOUD, Stage, StageContext
from ..stages.points import SELECTED, Points
from ..stages.preprocessing import NEEDS_GROUND
from ..stages.registry import place, stage_from
from ..stages.where_expression import Expression
from . import pdal as pdal_env
from .interrupts import check_interrupt, interruptible
from .pdal_errors import FLAGS_CURE, FLAGS_IN_CLASSES


@dataclass(eq=False)
class ExpandedStage:
    """One of our stages after expanding, and the results of its last run in this process."""

    stage: Stage
    number: int  #: its index in the pipeline as written
    index: int  #: its index in the expanded pipeline
    as_written: StageJson  #: its object in the pipeline
    plain: StageJson  #: the ``filters.python`` that PDAL runs
    context: StageContext = WHOLE_CLOUD  #: of its runs
    reports: list[Report] = field(default_factory=list)  #: one per point view
    failure: StageError | None = None

    def update_context(self, **facts: Any) -> None:
        """Put facts into the context of the runs to come."""
        self.context = replace(self.context, **facts)

    def function(
        self, module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        """Run the stage on one view; its report is kept, and becomes PDAL's metadata."""
        report = run_on_view(self.stage, self.context, module, ins, outs)
        module["out_metadata"] = node(self.stage.type, leaves(report))
        self.reports.append(report)


#: Gets the script's globals, the dimensions, and a dict for those to write back.
Function = Callable[[JsonObject, Mapping[str, NDArray], dict[str, NDArray]], None]


@dataclass(eq=False)
class Callback:
    """A function of this process that a filter calls, and how it failed, if it did."""

    function: Function
    failure: StageError | None = None


#: What ``source`` of an expanded stage holds. PDAL sets the globals before each call.
TRAMPOLINE = """\
def stage(ins, outs):
    try:
        from pdal_stages import run_stage
    except Exception as error:  # raised, it would end the process
        outs[f"{type(error).__name__}: {error}"] = None
        return True
    return run_stage(globals(), ins, outs)
"""

#: Before and after a stage's message in the name of the array that PDAL refuses.
_OPENING = "of a stage that failed:\n\n"
_CLOSING = "\n\n"

_usual_stdout: Any = sys.__stdout__
#: Stages and callbacks of this process by label, as long as someone holds them; in another process
#: options are parsed again.
BY_LABEL: WeakValueDictionary[str, ExpandedStage | Callback] = WeakValueDictionary()


def python_filter(
    label: str, source: str, arguments: JsonObject, adds: Mapping[str, str]
) -> JsonObject:
    """Return a ``filters.python`` that runs `source` and adds dimensions (name -> PDAL type)."""
    return {
        "type": "filters.python",
        "module": label,
        "function": "stage",
        "source": source,
        "pdalargs": arguments,
        "add_dimension": [f"{name}={kind}" for name, kind in adds.items()],
    }


def run_stage(module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Run an expanded stage, or several together, on one point view; always True (see above).

    Parameters
    ----------
    module : dict
        Globals of the script: PDAL's `pdalargs`, `metadata` and `spatialreference`.
        `out_metadata` is set in it.
    ins, outs : dict
        PDAL's dimensions, and the ones to write back.
    """
    several = module["pdalargs"].get("stages", [module["pdalargs"]])
    for arguments in several:
        label = str(arguments.get("label", ""))
        # PDAL's module object stays alive; the register need not grow.
        sys.modules.pop(label, None)
        seen = ChainMap(outs, cast(dict, ins))
        try:
            _run_interruptible(arguments, module, seen, outs)
        except BaseException as error:
            where = place(arguments.get("stage", "filters.python"), arguments.get("tag"))
            failure = as_stage_error(error, where)
            if held := BY_LABEL.get(label):
                held.failure = failure
            outs.clear()
            outs[f"{_OPENING}{_encodable(str(failure))}{_CLOSING}"] = cast(NDArray, None)
            if _redirected():  # PDAL restores it only after a run that succeeds
                sys.stdout = _usual_stdout
                pdal_env.keep_alive(_usual_stdout)
            break
    return True


@interruptible
def _run_interruptible(
    arguments: JsonObject,
    module: JsonObject,
    ins: Mapping[str, NDArray],
    outs: dict[str, NDArray],
) -> None:
    """Run a stage or a function on one view; any exception may come out, Ctrl-C too."""
    check_interrupt()
    held = BY_LABEL.get(str(arguments.get("label", "")))
    (held or _from_arguments(arguments)).function(module, ins, outs)


def _from_arguments(arguments: JsonObject) -> ExpandedStage:
    """Return the stage of a pipeline that another process expanded."""
    named = {"type": arguments["stage"], "tag": arguments.get("tag")}
    as_written = {**arguments.get("options", {}), **named}
    stage = stage_from(as_written).after(arguments.get("preparation", ()))
    context = StageContext(arguments.get("created_before", False))
    return ExpandedStage(stage, 0, 0, as_written, {}, context)


def points_of(
    stage: Stage,
    context: StageContext,
    module: JsonObject,
    ins: Mapping[str, NDArray],
) -> Points:
    """Return the points of a view, as a stage sees them; `module` are the script's globals."""
    metadata = module.get("metadata")
    return stage.points(
        ins,
        context,
        wkt=wkt_of(module.get("spatialreference")),
        legacy_flags=pdal_env.flags_inside_classification(ins, metadata),
        overlap_as_flag=pdal_env.overlap_as_flag(ins, metadata),
    )


def points_of_views(
    arrays: Sequence[np.ndarray], metadata: JsonObject, make: Callable[..., Points] = Points
) -> Points:
    """Return the points of all views that a pipeline gave, with the pipeline's metadata.

    `make` is :class:`Points` or a stage's method `points`.
    """
    arrays = [array for array in arrays if len(array)] or list(arrays[:1])
    names = arrays[0].dtype.names or () if arrays else ()
    columns = {name: np.concatenate([array[name] for array in arrays]) for name in names}
    flags = pdal_env.flags_inside_classification(names, metadata)
    return make(columns, wkt=wkt_of(reader_metadata(metadata)), legacy_flags=flags)


def run_on_view(
    stage: Stage,
    context: StageContext,
    module: JsonObject,
    ins: Mapping[str, NDArray],
    outs: dict[str, NDArray],
) -> Report:
    """Run a stage on one view; return its report."""
    points = points_of(stage, context, module, ins)
    _refuse_mixed_flags(points, pdal_env.point_formats(module.get("metadata")))
    for name in stage.reads():
        if name not in ins:
            raise points.missing(name, stage.hint)
    if not points.count:
        return run_on_nothing(stage)
    for name, values in stage.run(points, context).items():
        # PDAL copies raw memory: exactly this type, contiguous, one value per point.
        array = np.ascontiguousarray(values, dtype=ins[name].dtype)
        if array.shape != (points.count,):
            raise StageError(
                f"internal: '{name}' has {array.shape} values for {points.count} points"
            )
        outs[name] = array
    return points.report


def _refuse_mixed_flags(points: Points, formats: Sequence[int]) -> None:
    """Refuse classes with flags of LAS 1.0-1.3 that PDAL before 2.6 mixes up with those of LAS 1.4.

    `formats` are the point formats of the files that were read. Beside formats 6 to 10, whose
    classes go up to 255, nobody can tell flags from classes.
    """
    if not formats or min(formats) > 5 or max(formats) <= 5 or pdal_env.splits_class_flags():
        return
    largest = int(points.arrays["Classification"].max(initial=0))
    if largest > LEGACY_LIMIT:
        seen = f"PDAL {pdal_env.dotted_version()}, Classification {largest}"
        raise StageError(FLAGS_IN_CLASSES, found=seen, cure=FLAGS_CURE)


def run_on_nothing(stage: Stage) -> Report:
    """Return a stage's report on no points at all; StageError where it needs some."""
    if stage.needs_points:
        raise StageError(
            f"there are no points to {stage.needs_points}",
            where=stage.place,
            cure="Check the reader's file and the filters before this stage",
        )
    return Report({"points": 0})


def as_stage_error(error: BaseException, where: str) -> StageError:
    """Return any exception of a stage as one of our errors."""
    if isinstance(error, StageError):
        return error.at(where)
    if isinstance(error, MemoryError):
        cure = "Lower 'memory_mb', take fewer points, or work in tiles (--tile)"
        return StageError("memory ran out", where=where, cure=cure)
    if isinstance(error, KeyboardInterrupt):
        return InterruptedStage("interrupted", where=where)
    cure = "Run with --debug and report it"
    failure = StageError(f"{type(error).__name__}: {error}", where=where, cure=cure)
    failure.__traceback__ = error.__traceback__
    return failure


# ---- PDAL's metadata -----------------------------------------------------------------------------


def reader_metadata(metadata: JsonObject) -> JsonObject:
    """Return what PDAL's metadata of a run holds about the first reader; empty without one."""
    inner = metadata.get("metadata", {})
    node: Any = next((node for kind, node in inner.items() if kind.startswith("readers.")), {})
    return node[0] if isinstance(node, list) else node


def wkt_of(reference: object) -> str:
    """Return the well-known text in PDAL's description of a spatial reference."""
    srs = reference.get("srs", reference) if isinstance(reference, dict) else None
    if not isinstance(srs, dict):
        return ""
    return str(srs.get("compoundwkt") or srs.get("wkt") or srs.get("horizontal") or "")


def node(name: str, children: list[JsonObject], value: str = "", kind: str = "") -> JsonObject:
    """Return a node of PDAL's metadata, as a script sets it."""
    return {"name": name, "value": value, "type": kind, "description": "", "children": children}


def leaves(report: Report) -> list[StageJson]:
    """Return a report as nodes of PDAL's metadata."""
    return [leaf(key, value) for key, value in report.to_dict().items() if value is not None]


def leaf(name: str, value: object) -> JsonObject:
    """Return one value as a node of PDAL's metadata: its text and type."""
    if isinstance(value, str):
        return node(name, [], _encodable(value), "string")
    text = json.dumps(value, default=lambda v: v.item() if isinstance(v, np.generic) else str(v))
    kind = "integer" if isinstance(value, int | np.integer) else "json"
    kind = "double" if isinstance(value, float | np.floating) else kind
    return node(name, [], _encodable(text), "boolean" if isinstance(value, bool) else kind)


def _encodable(text: str) -> str:
    """Return a text that PDAL can take: valid UTF-8 without NUL."""
    return text.encode("utf-8", "replace").decode().replace("\0", "?")


# ---- standard output -----------------------------------------------------------------------------


def remember_stdout() -> None:
    """Keep this process's ``sys.stdout``, to be restored if a stage fails."""
    global _usual_stdout
    if not _redirected():
        _usual_stdout = sys.stdout


def _redirected() -> bool:
    return type(sys.stdout).__module__ == "redirector"  # PDAL's own type


remember_stdout()


# ---- functions of this process as filters, which PDAL calls between stages -----------------------


class Callbacks:
    """Filters that call functions of this process, as long as this object is held."""

    def __init__(self) -> None:
        self._held: list[Callback] = []

    def filter(
        self, function: Function, adds: Mapping[str, str] | None = None, **wiring: Any
    ) -> JsonObject:
        """Return a ``filters.python`` that calls a function and adds dimensions.

        `adds` maps their names to PDAL's types; `wiring` are the filter's tag and inputs.
        """
        label = f"pdal_stages_callback_{uuid.uuid4().hex}"
        self._held.append(callback := Callback(function))
        BY_LABEL[label] = callback
        return {**python_filter(label, TRAMPOLINE, {"label": label}, adds or {}), **wiring}

    def select(self, where: str, unknown: Collection[str]) -> JsonObject:
        """Return a filter that marks points for which a condition holds, as they come in.

        `unknown` are dimensions that only stages create, so that no condition can name them.
        """
        condition = Expression(where)

        def mark(module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
            seen = {name: values for name, values in ins.items() if name not in unknown}
            if pdal_env.flags_inside_classification(ins, module.get("metadata")):
                seen["Classification"] = seen["Classification"] & np.uint8(LEGACY_LIMIT)
            seen.pop(SELECTED, None)
            outs[SELECTED] = condition.evaluate(seen).astype(np.uint8)

        return self.filter(mark, {SELECTED: "uint8_t"})

    def check_ground(self, stages: Sequence[StageJson]) -> list[StageJson]:
        """Return the stages, with a check before those that crash old PDAL without ground."""
        out: list[StageJson] = []
        for stage in stages:
            if stage["type"] in NEEDS_GROUND and pdal_env.needs_ground_check():
                stage = dict(stage)
                wired = {"inputs": stage.pop("inputs")} if "inputs" in stage else {}
                check = partial(_check_ground, place(stage["type"], stage.get("tag")))
                out.append(self.filter(check, **wired))
            out.append(stage)
        return out


def _check_ground(
    where: str, module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
) -> None:
    """Refuse points of which none has class 2."""
    codes = ins.get("Classification")
    # As PDAL counts: flags inside the class make another class of it. No points at all do no harm.
    if codes is None or not len(codes) or (np.asarray(codes) == 2).any():
        return
    classes = ", ".join(map(str, np.unique(codes)[:10].tolist()))
    raise StageError(
        "no ground was found: none of the points has class 2",
        where=where,
        found=f"{len(codes)} points of class {classes}",
        cure="Classify ground first, with filters.smrf or filters.csf, or use "
        "filters.hag_morphological, which needs no classes",
    )
