"""The stages before a classifier that made what it reads: kept in the model file, run by `classify`, compared elsewhere."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

#: PDAL's stages that heights come from; of ours, :meth:`Stage.creates` says what they make.
OF_PDAL = (
    "filters.smrf",
    "filters.pmf",
    "filters.csf",
    "filters.hag_nn",
    "filters.hag_delaunay",
    "filters.hag_dem",
)

#: Options that say where in a pipeline a stage stands, or how it is run, not what it makes.
_ASIDE = ("tag", "inputs", "user_data", "log", "threads", "where_merge")


def entry(stage: Mapping[str, Any]) -> dict[str, Any]:
    """A stage as a preparation holds it."""
    return {key: value for key, value in stage.items() if key not in _ASIDE}


def as_json(preparation: Iterable[Mapping[str, Any]]) -> str:
    """The stages as they are written in a pipeline."""
    return ", ".join(json.dumps(dict(stage)) for stage in preparation)


def same(one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]]) -> bool:
    """Whether two preparations are the same stages with the same options."""
    return json.dumps(list(one), sort_keys=True) == json.dumps(list(other), sort_keys=True)
