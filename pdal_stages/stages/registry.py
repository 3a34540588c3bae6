"""Every stage by its type name: the modules of this package are the register."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from ..base.errors import PipelineError, suggest
from .base import Stage


@cache
def stages() -> dict[str, type[Stage]]:
    """All stages, by type name, in alphabetical order."""
    package = __name__.rpartition(".")[0]
    path = importlib.import_module(package).__path__
    found: dict[str, type[Stage]] = {}
    for info in pkgutil.iter_modules(path):
        module = importlib.import_module(f"{package}.{info.name}")
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, Stage) and value is not Stage:
                found[value.type] = value
    return dict(sorted(found.items()))


def get(type_name: str) -> type[Stage]:
    """The stage of a type name; an error names the nearest one."""
    try:
        return stages()[type_name]
    except KeyError:
        raise PipelineError(
            f"there is no stage '{type_name}' in pdal_stages",
            cure=f"{suggest(type_name, stages())}Stages: {', '.join(stages())}",
        ) from None
