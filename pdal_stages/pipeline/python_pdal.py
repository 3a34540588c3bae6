"""python-pdal objects of our stages, to be joined with PDAL's by ``|``.

``pdal.Reader.las("in.laz") | ps.Filter.hag_minima() | pdal.Writer.las("out.laz")``
"""

from __future__ import annotations

import inspect
import logging
from typing import Any

from ..base.errors import StageError
from ..base.json_types import StageJson
from ..stages.base import Stage
from ..stages.registry import stage_type, stage_types
from . import pdal as pdal_env
from . import runtime
from .expansion import expand_stage


class _Family:
    """Attribute access gives a maker per stage: ``Filter.hag_minima(cell=20, tag="h")``."""

    def __init__(self, family: str) -> None:
        self._family = family

    def __getattr__(self, name: str):
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            kind = stage_type(f"{self._family}.{name}")
        except StageError as error:
            raise AttributeError(str(error)) from None  # as completion and hasattr expect
        signature = _signature(kind)

        def make(*by_place: Any, **options: Any):
            options = signature.bind_partial(*by_place).arguments | options
            merge = options.pop("merge", True)
            if not isinstance(merge, bool):  # filters.accuracy has an option of this name
                options["merge"], merge = merge, True
            # Points of several readers must see each other; of one reader merging costs nothing.
            wired = {"inputs": options["inputs"]} if merge and "inputs" in options else {}
            unwired = {name: value for name, value in options.items() if name not in wired}
            expanded = expand_stage({"type": kind.type, **unwired})
            runtime.remember_stdout()
            merging = [{"type": "filters.merge", **wired}] if merge else []
            joined = _joined([*merging, expanded.plain], expanded)
            joined.type, joined.tag = kind.type, options.get("tag")
            joined.options = {"type": kind.type, **options}
            return joined

        make.__name__ = make.__qualname__ = name
        make.__signature__ = signature  # type: ignore[attr-defined]
        make.__doc__ = "\n".join(
            [f"{kind.summary}.", *(f"{o.name}: {o.help}" for o in kind.all_options())]
        )
        return make

    def __dir__(self):
        prefix = self._family + "."
        return [name[len(prefix) :] for name in stage_types() if name.startswith(prefix)]


def _signature(kind: type[Stage]) -> inspect.Signature:
    """Return a stage's parameters: required options by place or name, others by name."""
    make = inspect.Parameter
    needed = [option.name for option in kind.all_options() if option.required]
    defaults = {option.name: option.default for option in kind.all_options() if not option.required}
    by_name = {"tag": None, "inputs": None, "merge": True} | defaults
    parameters = [make(name, make.POSITIONAL_OR_KEYWORD) for name in needed]
    parameters += [make(n, make.KEYWORD_ONLY, default=d) for n, d in by_name.items()]
    return inspect.Signature(parameters)


def _joined(stages: list[StageJson], made_from: runtime.ExpandedStage):
    """Return the filters that PDAL runs as one object, which joins others by ``|``.

    `made_from` is kept as long as they are.
    """
    pdal = pdal_env.bindings()

    class Filter(pdal.Pipeline):  # type: ignore[name-defined]
        def pipeline(self, *arrays, loglevel: int = logging.ERROR):
            whole = pdal.Pipeline(arrays=arrays, loglevel=loglevel)
            whole |= self
            return whole

        def __or__(self, other):
            known = isinstance(other, pdal.Pipeline | pdal.pipeline.Stage)
            return super().__or__(other) if known else NotImplemented

        def __copy__(self):
            return self.pipeline(loglevel=self.loglevel)

    joined = Filter()
    for stage in stages:
        step = pdal.Filter(**stage)
        step.made_from = made_from
        joined |= step
    return joined


#: ``Filter.hag_minima(...)``, ``Filter.multiscalefeatures(...)``, ``Filter.modelclassifier(...)``,
#: ...
Filter = _Family("filters")
#: ``Writer.classifiermodel(filename, ...)``
Writer = _Family("writers")
