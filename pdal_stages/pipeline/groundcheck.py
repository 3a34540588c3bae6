"""Before PDAL's heights: is there ground? Without, ``filters.hag_nn`` and ``filters.hag_delaunay`` of old PDAL crash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..stages import carried
from . import pdal as pdal_env
from .callbacks import Callbacks
from .runtime import place

_CURE = (
    "Find ground before, with filters.smrf or filters.csf; where these find none, change their options, or take "
    "filters.hag_morphological, which reads no classes"
)


class GroundChecks(Callbacks):
    """Filters that end a run with an error where PDAL would end the process."""

    failure: StageError | None = None

    def put_before(self, stages: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """The stages, with a check before each that crashes without ground."""
        if not pdal_env.crashes_without_ground():
            return list(stages)
        out: list[dict[str, Any]] = []
        for stage in stages:
            if stage.get("type") in carried.NEEDS_GROUND:
                named = place(stage["type"], stage.get("tag"))
                wiring = {"inputs": stage["inputs"]} if "inputs" in stage else {}
                check = self.filter(partial(self._check, named), **wiring)
                check["tag"] = check["module"]
                stage = {**stage, "inputs": [check["tag"]]}
                out.append(check)
            out.append(stage)
        return out

    def _check(
        self, named: str, module: dict[str, Any], ins: Mapping[str, Any], outs: dict[str, Any]
    ) -> None:
        codes = ins.get("Classification")
        # As PDAL counts: flags inside the class make another class of it. No points at all do no harm.
        if codes is None or not len(codes) or (np.asarray(codes) == 2).any():
            return
        self.failure = StageError(
            "no ground was found: none of the points is of class 2",
            where=named,
            found=f"{len(codes)} points of class {', '.join(map(str, np.unique(codes)[:10].tolist()))}",
            cure=_CURE,
        )
        raise self.failure
