"""The stages before a classifier that made what it reads: kept in the model file, run by
`classify`, compared elsewhere.

A model file may come from anybody. So a preparation holds only stages and options that are listed
(:attr:`Stage.in_models`, :data:`PDAL_OPTIONS`): numbers in bounds, classes, conditions, never a
path. Else it is refused when the file is loaded, and not stored by training.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError, StageError
from ..base.las import number_type
from .context import WHOLE_CLOUD
from .options import Option, split_list
from .registry import stage_type, stage_types

#: The stage that makes the dimensions a model is trained on by default.
PREPARATION: tuple[dict[str, Any], ...] = (
    {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]},
)
#: The stage that finds ground, or takes what is given.
GROUND_FILTER = "filters.hag_morphological"
#: PDAL's stages that heights come from; of ours, :meth:`Stage.creates` says what they make.
OF_PDAL = (
    "filters.smrf",
    "filters.pmf",
    "filters.csf",
    "filters.hag_nn",
    "filters.hag_delaunay",
    "filters.hag_dem",
)
#: Those that measure from points of class 2, and what must stand before them: PDAL 2.2 crashes
#: where there are none.
NEEDS_GROUND, MAKES_GROUND = ("filters.hag_nn", "filters.hag_delaunay"), "filters.smrf"
_COUNT = Option("integer", None, "", 1, 1000, name="count")
_EXTRAPOLATION = Option("boolean", None, "", name="allow_extrapolation")
#: PDAL's stages that a model may carry, and their options. They read no file, move no point and
#: leave none out; each writes `Classification` or `HeightAboveGround` alone.
PDAL_OPTIONS: Mapping[str, tuple[Option, ...]] = {
    "filters.smrf": (
        Option("number", None, "", 0.2, 100, name="cell"),
        *(
            Option("number", None, "", 0, 1000, name=name)
            for name in ("cut", "scalar", "slope", "threshold")
        ),
        Option("number", None, "", 1, 1000, name="window"),
        Option("selection", None, "", name="ignore"),
    ),
    "filters.hag_nn": (
        _COUNT,
        Option("number", None, "", 0, 1e6, name="max_distance"),
        _EXTRAPOLATION,
    ),
    "filters.hag_delaunay": (_COUNT, _EXTRAPOLATION),
}
#: Options that say where in a pipeline a stage stands, how it is run, or in what units the points
#: at hand are; not what it makes.
_ASIDE = (
    "tag",
    "inputs",
    "user_data",
    "log",
    "threads",
    "horizontal_unit",
    "vertical_unit",
)
#: How the names of heights above openings begin; the width follows.
_OPENING = "HeightAboveOpening_"
#: Most stages of a preparation, and characters of one as JSON.
_MOST, _LONGEST = 8, 1000


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


def algorithm_versions(preparation: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return type -> version of the algorithm in this release, for stages of ours; PDAL's have
    none.
    """
    types = [str(stage["type"]) for stage in preparation]
    return {kind: stage_type(kind).algorithm_version for kind in types if kind in stage_types()}


def check(preparation: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A preparation that a model may carry, in one spelling.

    Raises
    ------
    ModelError
        For a stage or an option that a model cannot carry, or a value out of its bounds; it names
        the stage.
    """
    try:
        if len(preparation) > _MOST:
            raise ModelError(f"a preparation has at most {_MOST} stages", found=len(preparation))
        made = [_checked(stage) for stage in preparation]
        for number, stage in enumerate(made):
            before = [one["type"] for one in made[:number]]
            if stage["type"] in NEEDS_GROUND and MAKES_GROUND not in before:
                raise ModelError(
                    f"a model cannot carry {stage['type']} without {MAKES_GROUND} before it"
                )
        return made
    except ModelError as error:
        error.cure = "Training writes no such file: ask where it comes from"
        raise


def _checked(stage: Mapping[str, Any]) -> dict[str, Any]:
    kind = str(stage["type"])
    ours = stage_types().get(kind)
    options = {one.name: one for one in PDAL_OPTIONS.get(kind, ())}
    if ours is not None:
        options = {one.name: one for one in ours.all_options() if one.name in ours.in_models}
    if not options:
        raise ModelError(f"a model cannot carry the stage {kind[:80]!r}")
    given = {name: value for name, value in stage.items() if name != "type"}
    if unknown := [name for name in given if name not in options]:
        raise ModelError(f"a model cannot carry option {unknown[0][:80]!r} of {kind}")
    if len(json.dumps(given, default=str)) > _LONGEST:
        raise ModelError(
            f"a model cannot carry options of more than {_LONGEST} characters", found=kind
        )
    try:
        made = {name: _value(options[name], value) for name, value in given.items()}
        if ours is not None:
            ours(made)
    except StageError as error:
        raise ModelError(f"a model cannot carry this {kind}", found=str(error)[:200]) from None
    return {"type": kind, **made}


def _value(option: Option, value: Any) -> Any:
    """An option's value in the spelling of JSON."""
    parsed = option.parse(value)
    if option.kind == "selection":
        items = (
            split_list(value)
            if isinstance(value, str)
            else value
            if isinstance(value, list)
            else [value]
        )
        return [str(one).strip() for one in items]
    if option.kind == "numbers":
        return [_number(one) for one in parsed]
    return _number(parsed) if option.kind == "number" else parsed


def _number(value: float) -> int | float:
    return int(value) if value == int(value) else value


def with_given_ground(preparation: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a preparation in which ground is given, and Ground says which points are near it."""
    given = {"ground": True, "given_ground": True}
    return [{**one, **given} if one["type"] == GROUND_FILTER else dict(one) for one in preparation]


def preparation_of(names: Iterable[str]) -> list[dict[str, Any]]:
    """The stage that makes these dimensions, as far as they are heights."""
    wanted = list(names)
    widths = [
        name.removeprefix(_OPENING).replace("_", ".")
        for name in wanted
        if name.startswith(_OPENING)
    ]
    openings = [_number(float(width)) for width in widths if re.fullmatch(r"\d+(\.\d+)?", width)]
    if not openings and "Ground" not in wanted:
        return [{"type": "filters.hag_minima"}] if "HeightAboveGround" in wanted else []
    stage: dict[str, Any] = {"type": "filters.hag_morphological"}
    if "Ground" in wanted:
        stage["ground"] = True
    return [{**stage, "openings": sorted(openings)}] if openings else [stage]


def made_of_coordinates(
    preparation: Sequence[Mapping[str, Any]],
    xyz: npt.NDArray[np.float64],
    usable: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
    classes: npt.NDArray[np.uint8] | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """The dimensions that a preparation's only stage makes of coordinates in meters; none where it
    is not one of ours.

    `usable` (n,) are points that may form the ground; the others only receive heights. `classes`
    (n,) are needed where ground is given.
    """
    if (
        len(preparation) != 1
        or "where" in preparation[0]
        or preparation[0]["type"] not in stage_types()
    ):
        return {}
    options = {name: value for name, value in preparation[0].items() if name != "type"}
    stage = stage_type(preparation[0]["type"])(
        {**options, "ignore": "withheld", "threads": threads or 0}
    )
    if stage.reads() and classes is None:
        return {}
    there = {name: np.zeros(len(xyz), number_type(kind)) for name, kind in stage.creates().items()}
    withheld = np.zeros(len(xyz), np.uint8) if usable is None else (~usable).view(np.uint8)
    columns = {**dict(zip("XYZ", xyz.T, strict=True)), "Withheld": withheld, **there}
    if classes is not None:
        columns["Classification"] = classes
    made = stage.run(stage.points(columns), WHOLE_CLOUD)
    return {name: values.astype(there[name].dtype, copy=False) for name, values in made.items()}
