"""Heights that a model reads, as stages write them, and made of coordinates alone as those stages make them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..terrain import filtered_ground, hag_minima
from . import preparation as asked_for

#: The stage that makes the dimensions a model is trained on by default.
PREPARATION = ({"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]},)
#: Its options by the arguments of the function.
_MORPHOLOGICAL = ("cell", "slope", "window", "threshold", "scalar")


def checked(preparation: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """See :func:`.preparation.check`."""
    return asked_for.check(preparation)


def made_of_coordinates(
    preparation: Sequence[Mapping[str, Any]],
    xyz: npt.NDArray[np.float64],
    usable: npt.NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """The dimensions that a preparation's only stage makes; none where it is not one of ours.

    Parameters
    ----------
    preparation : sequence of mapping
        As model files have it.
    xyz : (n, 3) float64
        Meters.
    usable : (n,) bool, optional
        Points that may form the ground; the others only receive heights.
    threads : int, optional
    """
    if len(preparation) != 1 or "where" in preparation[0]:
        return {}
    (stage,) = preparation
    if stage["type"] == "filters.hag_minima":
        sizes = {name: stage[name] for name in ("cell", "resolution") if name in stage}
        return {"HeightAboveGround": hag_minima(xyz, mask=usable, **sizes).astype(np.float32)}
    if stage["type"] != "filters.hag_morphological":
        return {}
    made = filtered_ground(
        xyz,
        mask=usable,
        openings=[float(size) for size in stage.get("openings", ())],
        slope_too=bool(stage.get("terrain_slope", False)),
        threads=threads,
        **{name: stage[name] for name in _MORPHOLOGICAL if name in stage},
    )
    return {name: v if name == "Ground" else v.astype(np.float32) for name, v in made.items()}


def preparation_of(names: Iterable[str]) -> list[dict[str, Any]]:
    """The stage that makes these dimensions, as far as they are heights."""
    wanted = list(names)
    openings = [int(name.rpartition("_")[2]) for name in wanted if name.startswith("HeightAboveOpening_")]
    if not openings and "Ground" not in wanted:
        return [{"type": "filters.hag_minima"}] if "HeightAboveGround" in wanted else []
    stage: dict[str, Any] = {"type": "filters.hag_morphological"}
    if "Ground" in wanted:
        stage["ground"] = True
    return [{**stage, "openings": sorted(openings)}] if openings else [stage]
