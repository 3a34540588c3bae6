"""Find stages by type name: in modules of this folder, and in packages with an entry point.

A module of this folder that defines a stage holds a line ``type = "filters.NAME"`` in the body of
its class; no list names it anywhere else. Other packages declare the entry point
``pdal_stages.stages``: type name -> ``module:Class``.
"""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path

from ..base.errors import PipelineError, StageError, suggest
from ..base.json_types import StageJson
from .base import Stage

#: The group of entry points in which other packages declare their stages.
ENTRY_POINTS = "pdal_stages.stages"
#: Options of every PDAL stage, which PDAL handles itself.
PDAL_OWN = ("tag", "inputs", "user_data", "log")
#: Type name of a stage of earlier releases -> what to do without it.
_REMOVED = {
    "filters.wires": "Leave the stage out: filters.modelclassifier gives wires class 14, with the "
    "model 'standard' or one that was trained on wires",
}
_TYPE_LINE = re.compile(r'^    type = "((?:filters|writers)\.\w+)"$', re.MULTILINE)


class _Registry(Mapping[str, type[Stage]]):
    """Return stage classes by type name; a module is imported when its stage is asked for."""

    @functools.cached_property
    def _modules(self) -> dict[str, str]:
        """Return type name -> module of this folder, read as text: importing all takes long."""
        return {
            name: path.stem
            for path in sorted(Path(__file__).parent.glob("*.py"))
            for name in _TYPE_LINE.findall(path.read_text(encoding="utf-8"))
        }

    @functools.cached_property
    def _entry_points(self) -> dict[str, metadata.EntryPoint]:
        """Return type name -> entry point of another package; ours cannot be replaced."""
        return {
            entry.name: entry
            for entry in metadata.entry_points(group=ENTRY_POINTS)
            if entry.name not in self._modules
        }

    def __getitem__(self, name: str) -> type[Stage]:
        """Import a stage."""
        if name in self._modules:
            module = importlib.import_module(f"{__package__}.{self._modules[name]}")
            return next(v for v in vars(module).values() if getattr(v, "type", None) == name)
        return _load(self._entry_points[name])

    def __contains__(self, name: object) -> bool:
        """Return whether there is a stage of this name, without importing it."""
        return name in self._modules or name in self._entry_points

    def __iter__(self) -> Iterator[str]:
        """Yield the names in alphabetical order."""
        return iter(sorted([*self._modules, *self._entry_points]))

    def __len__(self) -> int:
        """Return the number of stages."""
        return len(self._modules) + len(self._entry_points)


_STAGES = _Registry()


def _load(entry: metadata.EntryPoint) -> type[Stage]:
    """Import the stage of another package."""
    package = entry.dist.name if entry.dist else entry.value
    try:
        stage = entry.load()
        fits = isinstance(stage, type) and issubclass(stage, Stage) and stage.type == entry.name
        fault = "" if fits else f"{entry.value} is not a Stage of type '{entry.name}'"
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
    if fault:
        raise StageError(
            f"the stage '{entry.name}' of the package {package} cannot be loaded",
            found=fault,
            cure=f"Update or uninstall {package}",
        )
    return stage


def stage_types() -> Mapping[str, type[Stage]]:
    """Return all stages by type name, in alphabetical order."""
    return _STAGES


def refuse_removed(name: str, where: str | None = None) -> None:
    """Raise a PipelineError for a stage that earlier releases had."""
    if name in _REMOVED:
        raise PipelineError(
            f"the stage '{name}' is no longer in pdal_stages", where=where, cure=_REMOVED[name]
        )


def stage_type(name: str) -> type[Stage]:
    """Return the stage of a type name; an error names the nearest one."""
    if name not in _STAGES:
        refuse_removed(name)
        raise PipelineError(
            f"there is no stage '{name}' in pdal_stages",
            cure=f"{suggest(name, _STAGES)}Stages: {', '.join(_STAGES)}",
        )
    return _STAGES[name]


def describe_count(name: str) -> str:
    """Return the words of a count of a stage, from ``type.name``."""
    kind, _, count = name.rpartition(".")
    return stage_type(kind).counts()[count].words


def place(type_name: str, tag: str | None) -> str:
    """Return how errors name a stage: its type, and its tag where it has one."""
    return f"{type_name} (tag '{tag}')" if tag else type_name


def stage_from(stage: StageJson) -> Stage:
    """Make a stage of ours from its object in a pipeline."""
    options = {name: value for name, value in stage.items() if name not in ("type", *PDAL_OWN)}
    return stage_type(stage["type"])(options, place(stage["type"], stage.get("tag")))
