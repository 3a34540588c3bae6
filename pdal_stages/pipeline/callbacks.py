"""Functions of this process as filters of a pipeline: PDAL calls them between stages."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..stages.preparation import NEEDS_GROUND
from . import pdal as pdal_env
from .interrupts import catches
from .runtime import as_stage_error, hand_over, place, python_filter

#: Gets the script's globals, the dimensions, and a dict for those to write back.
Function = Callable[[dict[str, Any], Mapping[str, Any], dict[str, Any]], None]
_CALLBACK = """\
def stage(ins, outs):
    from pdal_stages.pipeline.callbacks import call_back
    return call_back(globals(), ins, outs)
"""
_functions: dict[str, Function] = {}


class Callbacks(AbstractContextManager):
    """Filters that call functions of this process, which are forgotten when the ``with`` block ends.

    Attributes
    ----------
    failure : StageError or None
        What the first function that failed raised.
    """

    def __init__(self) -> None:
        self._labels: list[str] = []
        self.failure: StageError | None = None

    def __exit__(self, *exc: object) -> None:
        for label in self._labels:
            _functions.pop(label, None)

    def filter(self, function: Function, adds: Mapping[str, str] | None = None, **own: Any) -> dict[str, Any]:
        """A ``filters.python`` that calls a function and adds dimensions (name -> PDAL type); `own`: its tag, inputs."""
        label = f"pdal_stages_callback_{uuid.uuid4().hex}"

        def called(module: dict[str, Any], ins: Mapping[str, Any], outs: dict[str, Any]) -> None:
            try:
                function(module, ins, outs)
            except StageError as error:
                self.failure = self.failure or error
                raise

        _functions[label] = called
        self._labels.append(label)
        return {**python_filter(label, _CALLBACK, {"label": label}, adds or {}), **own}

    def check_ground(self, stages: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """The stages, with a check before each that ends the process of old PDAL where no point is ground."""
        if not pdal_env.crashes_without_ground():
            return list(stages)
        out: list[dict[str, Any]] = []
        for stage in stages:
            if stage.get("type") in NEEDS_GROUND:
                named = place(stage["type"], stage.get("tag"))
                check = self.filter(partial(_check_ground, named))
                check["tag"] = check["module"]
                if "inputs" in stage:
                    check["inputs"] = stage["inputs"]
                stage = {**stage, "inputs": [check["tag"]]}
                out.append(check)
            out.append(stage)
        return out


def _check_ground(where: str, module: dict[str, Any], ins: Mapping[str, Any], outs: dict[str, Any]) -> None:
    codes = ins.get("Classification")
    # As PDAL counts: flags inside the class make another class of it. No points at all do no harm.
    if codes is None or not len(codes) or (np.asarray(codes) == 2).any():
        return
    raise StageError(
        "no ground was found: none of the points is of class 2",
        where=where,
        found=f"{len(codes)} points of class {', '.join(map(str, np.unique(codes)[:10].tolist()))}",
        cure="Find ground before, with filters.smrf or filters.csf, or take filters.hag_morphological, which reads no "
        "classes",
    )


@catches
def call_back(module: dict[str, Any], ins: Mapping[str, Any], outs: dict[str, Any]) -> bool:
    """Call the function of a filter that :class:`Callbacks` made."""
    label = module["pdalargs"]["label"]
    sys.modules.pop(label, None)
    try:
        _functions[label](module, ins, outs)
    except BaseException as error:
        hand_over(as_stage_error(error, "filters.python"), outs)
    return True
