"""python-pdal objects of our stages, to be joined with PDAL's by ``|``.

``pdal.Reader.las("in.laz") | ps.Filter.hag_minima() | pdal.Writer.las("out.laz")``
"""

from __future__ import annotations

import inspect
from typing import Any

from ..stages import registry
from ..stages.base import Stage
from . import pdal as pdal_env
from . import runtime
from .lowering import lower_stage


class _Family:
    """Attribute access gives a maker per stage: ``Filter.hag_minima(cell=20, tag="h")``."""

    def __init__(self, family: str) -> None:
        self._family = family

    def __getattr__(self, name: str):
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            kind = registry.get(f"{self._family}.{name}")
        except Exception as error:
            raise AttributeError(str(error)) from None  # as completion and hasattr expect
        signature = _signature(kind)

        def make(*given: Any, **options: Any):
            options = signature.bind_partial(*given).arguments | options
            merge = options.pop("merge", True)
            if not isinstance(merge, bool):  # filters.accuracy has an option of this name
                options["merge"], merge = merge, True
            # Points of several readers must see each other; of one reader merging costs nothing.
            wired = {"inputs": options["inputs"]} if merge and "inputs" in options else {}
            own = {k: v for k, v in options.items() if k not in wired}
            lowered = lower_stage({"type": kind.type, **own})
            runtime.remember_stdout()
            before = [{"type": "filters.merge", **wired}] if merge else []
            return pdal_env.python_object([*before, lowered.plain], kind.type, options, lowered.stage)

        make.__name__ = make.__qualname__ = name
        make.__signature__ = signature  # type: ignore[attr-defined]
        make.__doc__ = _help(kind)
        return make

    def __dir__(self):
        prefix = self._family + "."
        return [name[len(prefix) :] for name in registry.stages() if name.startswith(prefix)]


def _signature(kind: type[Stage]) -> inspect.Signature:
    """The required option first, by place or by name; the others by name, with their defaults."""
    by_place, by_name = [], []
    for option in kind.all_options():
        if option.required:
            by_place.append(inspect.Parameter(option.name, inspect.Parameter.POSITIONAL_OR_KEYWORD))
        else:
            by_name.append(
                inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=option.default)
            )
    names = {parameter.name for parameter in by_name}
    for name, default in (("tag", None), ("inputs", None), ("merge", True)):
        if name not in names:
            by_name.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default))
    return inspect.Signature([*by_place, *by_name])


def _help(kind: type[Stage]) -> str:
    lines = [f"{kind.summary}.", "", "Parameters", "----------"]
    for option in kind.all_options():
        unit = f", {option.unit}" if option.unit else ""
        lines += [f"{option.name} : {option.kind}{unit}", f"    {option.help}"]
    lines += ["tag, inputs", "    As for PDAL's stages", "merge : bool"]
    return "\n".join([*lines, "    False keeps point views apart (after filters.splitter, say)"])


#: ``Filter.hag_minima(...)``, ``Filter.multiscalefeatures(...)``, ``Filter.modelclassifier(...)``, ...
Filter = _Family("filters")
#: ``Writer.classifiermodel(filename, ...)``
Writer = _Family("writers")
