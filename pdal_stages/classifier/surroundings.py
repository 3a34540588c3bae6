"""What the features of some points of a cloud can depend on: all of the cloud, or of a large one the ground around them.

A part of a large cloud is worked on with surroundings as wide as its features reach. That of a number of nearest neighbors
no width bounds: where points turn out to have theirs farther away, these points are worked on again, with wider ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ..features import FeatureEngine, FeaturePlan
from .algorithms import InputPlan
from .context import Context, around

#: Density counts as float32: distances that follow from it are taken so much longer.
_ROUNDED = 1.0001
#: Surroundings become wider by at least so much of the halo, so that there is an end.
_STEP = 0.25


class Seen(NamedTuple):
    """Points of a cloud, some of which features are wanted of."""

    xyz: npt.NDArray[np.float64]  #: (n, 3) meters
    dimensions: Mapping[str, npt.ArrayLike]  #: name to (n,) values
    rows: npt.NDArray[np.int64]  #: (m,) those that are wanted, ascending
    #: min x, min y, max x, max y of the ground of which all points are here; infinite where there are no others
    box: tuple[float, float, float, float] = (-math.inf, -math.inf, math.inf, math.inf)

    @property
    def whole(self) -> bool:
        """Whether there are no other points."""
        return not any(map(math.isfinite, self.box))


class Looking(Protocol):
    """What looks at surroundings: a :class:`FeaturePlan`, the plan of a model."""

    @property
    def halo_m(self) -> float: ...
    @property
    def most_neighbors(self) -> int: ...
    @property
    def second_neighbors(self) -> int: ...


def wider(one: Looking, other: Looking) -> Looking:
    """As far as either looks."""
    return InputPlan(
        (),
        (),
        max(one.halo_m, other.halo_m),
        max(one.most_neighbors, other.most_neighbors),
        max(one.second_neighbors, other.second_neighbors),
    )


@dataclass(frozen=True)
class Looks:
    """How far one looks: features, and contexts one after the other, each of which asks for the features of more points."""

    plan: Looking
    contexts: Sequence[Context] = ()

    @property
    def halo_m(self) -> float:
        """Meters of surroundings to begin with."""
        return self.plan.halo_m + sum(context.reach for context in self.contexts)

    def too_narrow(self, seen: Seen, threads: int | None) -> tuple[npt.NDArray[np.bool_], float]:
        """(m,) of which wanted points neighbors may lie farther away than all points are seen, and how far beyond."""
        asked: Any = seen.rows
        for context in reversed(self.contexts):
            asked = around(seen.xyz, asked, context)
        asked = np.arange(len(seen.xyz)) if asked is None else asked
        most = self.plan.most_neighbors
        if len(seen.xyz) <= most:  # at least as wide again
            return np.ones(len(seen.rows), bool), max(np.ptp(seen.xyz[:, :2], axis=0).max(), self.halo_m)
        away = _farthest_of(seen.xyz, asked, most, threads)
        if self.plan.second_neighbors:
            # A neighbor's own lie at most as far from it as it is from here and back, and once more.
            away *= 3.0
        x, y = seen.xyz[asked, 0], seen.xyz[asked, 1]
        x0, y0, x1, y1 = seen.box
        inward = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
        far: Any = asked[away > inward]
        if not len(far):
            return np.zeros(len(seen.rows), bool), 0.0
        for context in self.contexts:  # who asked for these: being near each other is mutual
            far = around(seen.xyz, far, context)
        mine = np.ones(len(seen.rows), bool) if far is None else np.isin(seen.rows, far)
        return mine, max(float((away - inward).max()), _STEP * self.halo_m)


def _farthest_of(
    xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64], most: int, threads: int | None
) -> npt.NDArray[np.float64]:
    """(m,) meters from points to the last of their `most` nearest neighbors, or a little more."""
    engine = FeatureEngine(xyz, FeaturePlan.parse(f"k{most}", "Density", ()), threads=threads)
    density = engine.table(rows).values[:, 0].astype(np.float64)
    return np.cbrt((most + 1) / (density * (4.0 / 3.0 * math.pi))) * _ROUNDED


def work_on(
    cloud: Any,
    rows: npt.NDArray[np.int64],
    looks: Looks,
    compute: Callable[[npt.NDArray[np.int64], Seen, bool], bool],
    threads: int | None = None,
) -> int:
    """Compute something of some points of a cloud (see ``TrainingCloud.seen``), as wide around them as it takes.

    Parameters
    ----------
    cloud : TrainingCloud or another that can be :meth:`seen`
    rows : (m,) int64
        Ascending.
    looks : Looks
    compute : function
        ``compute(places, seen, again)``: where in `rows` the points are that are seen, and whether they were before. Tells
        whether neighbors of any lay beyond ``looks.halo_m``.

    Returns
    -------
    int
        Points whose neighbors lie farther away than the memory allows to look.
    """
    places, reach, again = np.arange(len(rows)), looks.halo_m, False
    while True:
        seen = cloud.seen(rows[places], reach)
        if not compute(places, seen, again) or seen.whole:
            return 0
        narrow, more = looks.too_narrow(seen, threads)
        if not narrow.any():
            return 0
        places, reach, again = places[narrow], reach + more, True
        if not cloud.can_be_seen(rows[places], reach):
            return len(places)
