"""Functions of this process as filters of a pipeline: PDAL calls them between stages."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any

from .interrupts import catches
from .runtime import as_stage_error, hand_over, python_filter

#: Gets the script's globals, the dimensions, and a dict for those to write back.
Function = Callable[[dict[str, Any], Mapping[str, Any], dict[str, Any]], None]
_CALLBACK = """\
def stage(ins, outs):
    from pdal_stages.pipeline.callbacks import call_back
    return call_back(globals(), ins, outs)
"""
_functions: dict[str, Function] = {}


class Callbacks(AbstractContextManager):
    """Filters that call functions of this process, which are forgotten when the ``with`` block ends."""

    def __init__(self) -> None:
        self._labels: list[str] = []

    def __exit__(self, *exc: object) -> None:
        for label in self._labels:
            _functions.pop(label, None)

    def filter(self, function: Function, adds: Mapping[str, str] | None = None, **own: Any) -> dict[str, Any]:
        """A ``filters.python`` that calls a function and adds dimensions (name -> PDAL type); `own`: its tag, inputs."""
        label = f"pdal_stages_callback_{uuid.uuid4().hex}"
        _functions[label] = function
        self._labels.append(label)
        return {**python_filter(label, _CALLBACK, {"label": label}, adds or {}), **own}


def function_of(label: str) -> Function | None:
    """The function of a filter that :class:`Callbacks` made, by its label."""
    return _functions.get(label)


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
