"""Preprocessing of a model: the stages before the classifier that created what it reads.

A model file holds them, `classify` runs them, and pipelines are compared with them. As a model file
may come from anybody, only listed stages and options are allowed (:attr:`Stage.in_models`,
:data:`PDAL_OPTIONS`): numbers within bounds, classes, conditions, never a path. Others are refused
when a file is loaded, and training does not store them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ..base.dimensions import opening_width
from ..base.errors import ModelError, StageError
from ..base.json_types import JsonObject, StageJson
from ..base.las import number_type
from ..base.selections import split_selection
from .base import WHOLE_CLOUD
from .options import Option
from .registry import PDAL_OWN, stage_type, stage_types

#: The preprocessing of the dimensions that a model is trained on by default.
PREPARATION: tuple[StageJson, ...] = (
    {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]},
)
#: The stage that finds ground, or takes what is given.
GROUND_FILTER = "filters.hag_morphological"
#: PDAL's stages that classify ground, from which others of PDAL measure heights.
GROUND_OF_PDAL = ("filters.smrf", "filters.pmf", "filters.csf")
#: PDAL's stages that create HeightAboveGround; for ours, :meth:`Stage.creates` tells.
HEIGHTS_OF_PDAL = ("filters.hag_nn", "filters.hag_delaunay", "filters.hag_dem")
#: PDAL's stages that measure from points of class 2; PDAL before 2.9 crashes where there are none.
NEEDS_GROUND = ("filters.hag_nn", "filters.hag_delaunay")


def _numbers(**bounds: tuple[float, float]) -> tuple[Option, ...]:
    return tuple(Option("number", None, "", *ends, name=name) for name, ends in bounds.items())


_WIDE = 0, 1000
_OF_NEIGHBORS = (
    Option("integer", None, "", 1, 1000, name="count"),
    Option("boolean", None, "", name="allow_extrapolation"),
)
#: PDAL's stages that a model may carry, and their options. They read no file, move no point and
#: leave none out; each writes `Classification` or `HeightAboveGround` alone. The bounds let all
#: sensible values pass, but not grids and searches that would take a machine's memory or days.
PDAL_OPTIONS: Mapping[str, tuple[Option, ...]] = {
    "filters.smrf": (
        *_numbers(cell=(0.2, 100), window=(1, 1000), cut=_WIDE),
        *_numbers(scalar=_WIDE, slope=_WIDE, threshold=_WIDE),
        Option("selection", None, "", name="ignore"),
    ),
    "filters.hag_nn": (*_OF_NEIGHBORS, *_numbers(max_distance=(0, 1e6))),
    "filters.hag_delaunay": _OF_NEIGHBORS,
}
#: Options on a stage's place in a pipeline, on how it is run and on the units of the points at
#: hand; they do not change what it computes.
_NOT_STORED = (*PDAL_OWN, "threads", "horizontal_unit", "vertical_unit", "keep_rasters")
#: Most characters of preprocessing as JSON; more is an attack on the reader's time.
_MAX_CHARACTERS = 2000


def entry(stage: StageJson) -> JsonObject:
    """Return a stage as preprocessing holds it."""
    return {key: value for key, value in stage.items() if key not in _NOT_STORED}


def as_json(preparation: Iterable[StageJson]) -> str:
    """Return the stages as they are written in a pipeline."""
    return ", ".join(json.dumps(dict(stage), default=str) for stage in preparation)


def same(first: Sequence[StageJson], second: Sequence[StageJson]) -> bool:
    """Return whether two lists are the same stages with the same options."""
    return _normalize(first) == _normalize(second)


def _normalize(stages: Sequence[StageJson]) -> list[StageJson]:
    """Return the stages in one spelling where a model could carry them, else as they are."""
    try:
        return check(stages)
    except ModelError:
        return list(stages)


def algorithm_versions(preparation: Iterable[StageJson]) -> dict[str, int]:
    """Return type -> version of the algorithm in this release; PDAL's stages have none."""
    types = [str(stage["type"]) for stage in preparation]
    return {kind: stage_type(kind).algorithm_version for kind in types if kind in stage_types()}


def check(preparation: Sequence[StageJson]) -> list[StageJson]:
    """Return the preprocessing in one spelling, if a model may carry it.

    Raises
    ------
    ModelError
        For a stage or an option that a model cannot carry, or a value out of its bounds; it names
        the stage.
    """
    try:
        if len(as_json(preparation)) > _MAX_CHARACTERS:
            raise ModelError(
                f"a model cannot carry preprocessing of more than {_MAX_CHARACTERS} characters"
            )
        return [_check_stage(stage) for stage in preparation]
    except ModelError as error:
        error.cure = "Training writes no such file: ask where it comes from"
        raise


def _check_stage(stage: StageJson) -> StageJson:
    """Return a stage in one spelling, if a model may carry it."""
    kind = str(stage["type"])
    ours = stage_types().get(kind)
    allowed: Iterable[Option] = PDAL_OPTIONS.get(kind, ())
    if ours is not None:
        allowed = [option for option in ours.all_options() if option.name in ours.in_models]
    options = {option.name: option for option in allowed}
    if not options:
        raise ModelError(f"a model cannot carry the stage {kind[:80]!r}")
    values = {name: value for name, value in stage.items() if name != "type"}
    if unknown := [name for name in values if name not in options]:
        raise ModelError(f"a model cannot carry option {unknown[0][:80]!r} of {kind}")
    try:
        values = {name: _value(options[name], value) for name, value in values.items()}
        if ours is not None:
            ours(values)
    except StageError as error:
        raise ModelError(f"a model cannot carry this {kind}", found=str(error)[:200]) from None
    return {"type": kind, **values}


def _value(option: Option, value: object) -> object:
    """Return an option's value in the spelling of JSON."""
    parsed = option.parse(value)
    if option.kind == "selection":
        items = split_selection(value)
        return [str(item).strip() for item in (items if isinstance(items, list) else [items])]
    if option.kind == "numbers":
        return [_number(number) for number in parsed]
    return _number(parsed) if option.kind == "number" else parsed


def _number(value: float) -> int | float:
    """Return a whole number as int: 5.0 and 5 are spelled alike."""
    return int(value) if value == int(value) else value


def with_given_ground(preparation: Iterable[StageJson]) -> list[StageJson]:
    """Return preprocessing in which class 2 is the ground, and Ground tells what is near it."""
    options = {"ground": True, "given_ground": True}
    return [
        {**stage, **(options if stage["type"] == GROUND_FILTER else {})} for stage in preparation
    ]


def preparation_of(names: Iterable[str]) -> list[StageJson]:
    """Return the stage that creates these dimensions, as far as they are heights."""
    wanted = list(names)
    openings = [_number(width) for width in map(opening_width, wanted) if width is not None]
    if not openings and "Ground" not in wanted:
        return [{"type": "filters.hag_minima"}] if "HeightAboveGround" in wanted else []
    stage: StageJson = {"type": "filters.hag_morphological"}
    if "Ground" in wanted:
        stage["ground"] = True
    return [{**stage, "openings": sorted(openings)}] if openings else [stage]


def made_of_coordinates(
    preparation: Sequence[StageJson],
    xyz: npt.NDArray[np.float64],
    usable: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
    classes: npt.NDArray[np.uint8] | None = None,
) -> dict[str, npt.NDArray]:
    """Compute the dimensions that a model reads from coordinates, without PDAL.

    Parameters
    ----------
    preparation : sequence of mapping
        The model's preprocessing.
    xyz : (n, 3) array of float
        Coordinates in meters.
    usable : (n,) array of bool, optional
        Points that may form the ground; the others only receive heights.
    threads : int, optional
        Threads to use; by default every available core.
    classes : (n,) array of uint8, optional
        Class codes, needed where class 2 is the ground.

    Returns
    -------
    dict
        Dimension -> (n,) array; empty where preprocessing is not exactly one stage of ours.
    """
    options = dict(preparation[0]) if len(preparation) == 1 else {}
    kind = options.pop("type", "")
    if "where" in options or kind not in stage_types():
        return {}
    stage = stage_type(kind)({**options, "ignore": "withheld", "threads": threads or 0})
    if stage.reads() and classes is None:
        return {}
    empty = {name: np.zeros(len(xyz), number_type(kind)) for name, kind in stage.creates().items()}
    withheld = np.zeros(len(xyz), np.uint8) if usable is None else (~usable).view(np.uint8)
    columns = {**dict(zip("XYZ", xyz.T, strict=True)), "Withheld": withheld, **empty}
    if classes is not None:
        columns["Classification"] = classes
    results = stage.run(stage.points(columns), WHOLE_CLOUD)
    return {name: values.astype(empty[name].dtype, copy=False) for name, values in results.items()}
