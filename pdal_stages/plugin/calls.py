"""The Python side of ``stage.cpp``, which calls it through ``filters.python`` in two steps.

In the step ``prepare``, before any point is read, :func:`answer` checks the options and returns
the dimensions they create. In the step ``run`` it processes one point view. Answers are metadata of
the script, a list of named texts; a failure is named ``pdal_stages_error``, which the plugin throws
as a PDAL error. No exception leaves :func:`answer`.
"""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Mapping
from contextlib import suppress

from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.json_types import JsonObject, StageJson
from ..base.version import __version__
from ..pipeline import expansion, pdal_facts, runtime
from ..stages.base import Stage, StageContext
from ..stages.registry import place, stage_from, stage_type, stage_types
from . import declarations


def answer(module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> bool:
    """Answer one call; always True.

    Parameters
    ----------
    module : dict
        Globals of the script: PDAL's `pdalargs` (the question), `metadata` and `spatialreference`.
        `out_metadata` is set in it.
    ins, outs : dict
        PDAL's dimensions, and the ones to write back.
    """
    where = "pdal_stages"
    try:
        question = module["pdalargs"]
        where = place(question["stage"], question.get("tag"))
        _end_on_interrupt()
        # PDAL's module object stays alive; the register need not grow.
        sys.modules.pop(question["label"], None)
        stage, context = _make_stage(question)
        if question["step"] == "prepare":
            leaves = [
                runtime.leaf("dimension", f"{name}={kind}")
                for name, kind in stage.creates().items()
            ]
            warning = stage.check_upstream()
            warnings = [warning] if warning else []
        else:
            report = runtime.run_on_view(stage, context, module, ins, outs)
            leaves, warnings = runtime.leaves(report), [*map(str, report.messages)]
        leaves += [runtime.leaf("pdal_stages_warning", text) for text in warnings]
    except BaseException as error:
        outs.clear()
        leaves = [runtime.leaf("pdal_stages_error", str(runtime.as_stage_error(error, where)))]
    module["out_metadata"] = runtime.node("pdal_stages", leaves)
    return True


def _make_stage(question: JsonObject) -> tuple[Stage, StageContext]:
    """Return the stage of a call, placed in its pipeline, and its context."""
    kind = stage_type(question["stage"])
    if (question["version"], question["digest"]) != (__version__, declarations.digest(kind)):
        raise StageError(
            "PDAL's plugin of this stage was built for another version of pdal_stages",
            found=f"plugin {question['version']} ({question['digest']}), package {__version__} "
            f"({declarations.digest(kind)}) in {sys.prefix}",
            cure="Build it again: pdal-stages plugin --install",
        )
    options: dict[str, str] = {}
    for name, value in question["options"]:  # lists come as several values
        options[name] = f"{options[name]},{value}" if name in options else value
    before = _stages(question["pipeline"])[:-1]
    if question["step"] == "prepare":
        pdal_facts.check_inputs([stage for stage in before if "type" in stage])
    named = {"type": kind.type, "tag": question.get("tag")}
    stage = stage_from({**kind.from_pipeline(options, before), **options, **named})
    upstream = [(earlier, _creates(earlier)) for earlier in before]
    stage, created_before = expansion.settle_upstream(stage, upstream)
    return stage, StageContext(created_before)


def _stages(text: str) -> list[StageJson]:
    """Return the pipeline up to the stage itself; before PDAL 2.9 all its values are text."""
    try:
        stages = json.loads(text)["pipeline"]
    except (ValueError, KeyError):  # `user_data` that is not JSON
        return [{}]
    return stages if isinstance(stages, list) else [stages]


def _creates(stage: StageJson) -> Mapping[str, str]:
    """Return the dimensions that an earlier stage creates; of PDAL's stages, only heights."""
    if stage.get("type") not in stage_types():
        return expansion.heights_of(stage)
    try:
        return stage_from(stage).creates()
    except StageError:  # reported by its own preparation
        return {}


def _end_on_interrupt() -> None:
    """Let Ctrl-C end a program that is not Python, such as `pdal`, at once, as PDAL's stages do.

    There filters.python starts an interpreter, which takes the signal and keeps it while PDAL
    works.
    """
    if not sys.orig_argv and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):  # of another thread
            signal.signal(signal.SIGINT, signal.SIG_DFL)
