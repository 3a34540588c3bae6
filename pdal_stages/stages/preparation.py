"""The stages before a classifier that made what it reads: kept in the model file, run by `classify`, compared elsewhere.

A model file may come from anybody, and `classify` runs what it names. So a preparation holds only stages that declare
themselves fit for it (:attr:`Stage.in_models`, and :data:`carried.OF_PDAL`), with options that have a rule; anything else is
refused when the file is loaded, and not stored by training.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..base.errors import ModelError, StageError
from . import carried, registry

#: PDAL's stages that heights come from; of ours, :meth:`Stage.creates` says what they make.
OF_PDAL = (
    "filters.smrf",
    "filters.pmf",
    "filters.csf",
    "filters.hag_nn",
    "filters.hag_delaunay",
    "filters.hag_dem",
)

#: Options that say where in a pipeline a stage stands, how it is run, or in what units the points at hand are; not what
#: it makes; and decks, which whoever applies a model looks for or not.
_ASIDE = (
    "decks",
    "tag",
    "inputs",
    "user_data",
    "log",
    "threads",
    "horizontal_unit",
    "vertical_unit",
)
#: Most stages of a preparation.
_MOST = 8
#: What to do about a file that asks for more.
_CURE = "Training writes no such file: ask where it comes from"


def entry(stage: Mapping[str, Any]) -> dict[str, Any]:
    """A stage as a preparation holds it."""
    return {key: value for key, value in stage.items() if key not in _ASIDE}


def as_json(preparation: Iterable[Mapping[str, Any]]) -> str:
    """The stages as they are written in a pipeline."""
    return ", ".join(json.dumps(dict(stage)) for stage in preparation)


def same(one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]]) -> bool:
    """Whether two preparations are the same stages with the same options."""
    return json.dumps(_spelled(one), sort_keys=True) == json.dumps(_spelled(other), sort_keys=True)


def _spelled(stages: Sequence[Mapping[str, Any]]) -> list[Any]:
    """In one spelling, where a model could carry them."""
    try:
        return check(stages)
    except ModelError:
        return list(stages)


def check(preparation: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A preparation that a model may carry, in one spelling.

    Raises
    ------
    ModelError
        For a stage or an option that a model cannot carry, or a value out of its bounds; it names the stage.
    """
    if len(preparation) > _MOST:
        raise ModelError(f"a preparation has at most {_MOST} stages", found=len(preparation))
    try:
        made = [_checked(stage) for stage in preparation]
        for number, stage in enumerate(made):
            before = [one["type"] for one in made[:number]]
            if stage["type"] in carried.NEEDS_GROUND and carried.MAKES_GROUND not in before:
                raise ModelError(
                    f"a model cannot carry {stage['type']} without {carried.MAKES_GROUND} before it"
                )
        return made
    except ModelError as error:
        error.cure = _CURE
        raise


def _checked(stage: Mapping[str, Any]) -> dict[str, Any]:
    kind = str(stage["type"])
    ours = registry.stages().get(kind)
    rules = carried.OF_PDAL.get(kind) if ours is None else ours.in_models
    if rules is None:
        raise ModelError(f"a model cannot carry the stage {kind[:80]!r}")
    out: dict[str, Any] = {"type": kind}
    for name, value in stage.items():
        if name == "type":
            continue
        if name not in rules:
            raise ModelError(f"a model cannot carry option {name[:80]!r} of {kind}")
        try:
            out[name] = rules[name](value)
        except ValueError as error:
            raise ModelError(
                f"a model cannot carry this '{name}' of {kind}; it must be {error}",
                found=json.dumps(value, default=str)[:80],
            ) from None
    if ours is not None:  # what the options say together
        try:
            ours({name: value for name, value in out.items() if name != "type"})
        except StageError as error:
            raise ModelError("a model cannot carry this stage", found=error) from None
    return out
