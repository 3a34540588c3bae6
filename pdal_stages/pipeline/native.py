"""python-pdal objects of our stages, to be joined with PDAL's by ``|``.

``pdal.Reader.las("in.laz") | ps.Filter.hag_minima() | pdal.Writer.las("out.laz")``
"""

from __future__ import annotations

from typing import Any

from ..stages import registry
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
        kind = registry.get(f"{self._family}.{name}")

        def make(filename: str | None = None, *, merge: Any = True, **options: Any):
            if not isinstance(merge, bool):  # filters.accuracy has an option of this name
                options["merge"], merge = merge, True
            if filename is not None:
                options["filename"] = filename
            # Points of several readers must see each other; of one reader merging costs nothing.
            wired = {"inputs": options.pop("inputs")} if merge and "inputs" in options else {}
            lowered = lower_stage({"type": kind.type, **options})
            runtime.remember_stdout()
            said = ", ".join(f"{key}={value!r}" for key, value in options.items())
            made = pdal_env.python_object(lowered.plain, f"{kind.type}({said})")
            made.made_from = lowered.stage  # or it would be forgotten, and options parsed again
            return pdal_env.python_object({"type": "filters.merge", **wired}) | made if merge else made

        make.__name__ = name
        make.__doc__ = (
            f"{kind.summary}.\n\nOptions: {', '.join(o.name for o in kind.all_options())}; tag, inputs.\n"
            "merge=False keeps point views apart (after filters.splitter, say)."
        )
        return make

    def __dir__(self):
        prefix = self._family + "."
        return [name[len(prefix) :] for name in registry.stages() if name.startswith(prefix)]


#: ``Filter.hag_minima(...)``, ``Filter.multiscalefeatures(...)``, ``Filter.modelclassifier(...)``, ...
Filter = _Family("filters")
#: ``Writer.classifiermodel(filename, ...)``
Writer = _Family("writers")
