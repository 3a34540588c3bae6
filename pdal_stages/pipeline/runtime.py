"""Where a lowered stage arrives inside PDAL: from ``filters.python``'s globals to a stage's run().

The script that PDAL executes is a few lines that call :func:`run_stage`; everything else
lives here, in the installed package, where compiled code can be cached.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..stages import registry
from ..stages.points import Points
from . import pdal as pdal_env

#: What ``source`` of a lowered stage holds. PDAL sets the globals before each call.
TRAMPOLINE = (
    "from pdal_stages import run_stage\ndef stage(ins, outs):\n    return run_stage(globals(), ins, outs)\n"
)

#: What an error says when Ctrl-C came while a stage ran; the runners turn it back into KeyboardInterrupt.
INTERRUPTED = "interrupted"

_lock = threading.Lock()
_reports: dict[str, list[dict[str, Any]]] = {}
_failures: dict[str, StageError] = {}
_stdout: dict[str, Any] = {}
_kept: list[Any] = []


def place(type_name: str, tag: str | None) -> str:
    """How errors name a stage: its type, and its tag where it has one."""
    return f"{type_name} (tag '{tag}')" if tag else type_name


def run_stage(module: dict[str, Any], ins: Mapping[str, Any], outs: dict[str, Any]) -> bool:
    """Run one lowered stage on one point view.

    Parameters
    ----------
    module : dict
        Globals of the script: PDAL's `pdalargs`, `metadata` and `spatialreference`.
        `out_metadata` is set in it.
    ins, outs : dict
        PDAL's dimensions, and the ones to write back.
    """
    arguments = module["pdalargs"]
    label = str(arguments.get("label", ""))
    sys.modules.pop(label, None)  # PDAL's module object stays alive; the register need not grow
    try:
        report = _run(module, arguments, ins, outs)
    except BaseException as error:
        failure = _as_stage_error(error, place(arguments["stage"], arguments.get("tag")))
        with _lock:
            _failures[label] = failure
            original = _stdout.pop(label, None)
        if original is not None:  # PDAL restores it only where nothing is raised
            sys.stdout = original
            # PDAL remembers the object without holding it, until a run succeeds: it must not be freed.
            if not any(kept is original for kept in _kept):
                _kept.append(original)
        # A class of our own, raised afresh: some exception types crash python-pdal at exit.
        raise failure from None
    with _lock:
        _reports.setdefault(label, []).append(report)
    module["out_metadata"] = _metadata_node(arguments["stage"], report)
    return True


def _run(module, arguments, ins, outs) -> dict[str, Any]:
    stage = registry.get(arguments["stage"])
    where = place(stage.type, arguments.get("tag"))
    options = stage.parse(arguments.get("options", {}), where)
    points = Points(
        ins,
        wkt=_wkt(module.get("spatialreference")),
        options=options,
        legacy_flags=pdal_env.flags_inside_classification(ins, module.get("metadata")),
    )
    for name in stage.reads(options):
        if name not in ins:
            points.dimension(name)  # raises, naming the stage that makes it
    for name, values in stage.run(points, options).items():
        target = ins[name].dtype
        # PDAL copies raw memory: exactly this type, contiguous, one value per point.
        array = np.ascontiguousarray(values, dtype=target)
        if array.shape != (points.count,):
            raise StageError(f"internal: '{name}' has {array.shape} values for {points.count} points")
        outs[name] = array
    return points.report


def _as_stage_error(error: BaseException, where: str) -> StageError:
    if isinstance(error, StageError):
        return error.at(where)
    if isinstance(error, MemoryError):
        return StageError(
            "memory ran out",
            where=where,
            cure="Lower 'memory', work in tiles (--tile), or take fewer features",
        )
    if isinstance(error, KeyboardInterrupt):
        return StageError(INTERRUPTED, where=where)
    failure = StageError(
        f"{type(error).__name__}: {error}", where=where, cure="Run with --debug and report it"
    )
    failure.__traceback__ = error.__traceback__
    return failure


def _wkt(reference: Any) -> str:
    """The well-known text in PDAL's description of a spatial reference."""
    if isinstance(reference, dict):
        srs = reference.get("srs", reference)
        if isinstance(srs, dict):
            return str(srs.get("compoundwkt") or srs.get("wkt") or srs.get("horizontal") or "")
    return ""


def _metadata_node(name: str, report: Mapping[str, Any]) -> dict[str, Any]:
    """A report in the form PDAL takes metadata: every value as text, with its type."""
    children = []
    for key, value in report.items():
        if isinstance(value, bool):
            children.append(_leaf(key, str(value).lower(), "boolean"))
        elif isinstance(value, int | np.integer):
            children.append(_leaf(key, str(int(value)), "integer"))
        elif isinstance(value, float | np.floating):
            children.append(_leaf(key, repr(float(value)), "double"))
        elif isinstance(value, str):
            children.append(_leaf(key, value, "string"))
        elif value is not None:
            children.append(_leaf(key, json.dumps(value, default=str), "json"))
    return {"name": name, "value": "", "type": "", "description": "", "children": children}


def _leaf(name: str, value: str, kind: str) -> dict[str, Any]:
    return {"name": name, "value": value, "type": kind, "description": "", "children": []}


# ---- for the runners in the same process -----------------------------------------------------------


def remember_stdout(label: str) -> None:
    """Keep this process's ``sys.stdout``, to be put back if the stage raises."""
    with _lock:
        _stdout[label] = sys.stdout


def collect(label: str) -> tuple[list[dict[str, Any]], StageError | None]:
    """Reports (one per point view) and the failure of a lowered stage, which are then forgotten."""
    with _lock:
        _stdout.pop(label, None)
        return _reports.pop(label, []), _failures.pop(label, None)
