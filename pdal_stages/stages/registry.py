"""Every stage by its type name; a stage's module is imported when it is asked for."""

from __future__ import annotations

import importlib
from collections import UserDict
from collections.abc import Mapping

from ..base.errors import PipelineError, suggest
from .base import Stage

#: Types of stages and the modules that hold them.
_MODULES = {
    **{f"filters.{name}": name for name in (
        "accuracy", "bridges", "consistency", "detachednoise", "hag_minima", "hag_morphological", "modelclassifier",
        "multiscalefeatures", "objects", "polygons", "wires",
    )},
    "writers.classifiermodel": "classifiermodel",
    "writers.objects": "objectswriter",
}  # fmt: skip


class _Stages(UserDict):
    def __getitem__(self, name: str) -> type[Stage]:
        module = importlib.import_module(f"{__package__}.{self.data[name]}")
        return next(
            v for v in vars(module).values() if isinstance(v, type) and getattr(v, "type", "") == name
        )


_stages = _Stages(_MODULES)


def stages() -> Mapping[str, type[Stage]]:
    """All stages, by type name, in alphabetical order."""
    return _stages


def get(type_name: str) -> type[Stage]:
    """The stage of a type name; an error names the nearest one."""
    if type_name not in _MODULES:
        raise PipelineError(
            f"there is no stage '{type_name}' in pdal_stages",
            cure=f"{suggest(type_name, _MODULES)}Stages: {', '.join(_MODULES)}",
        )
    return stages()[type_name]
