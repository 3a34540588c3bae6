"""``filters.detachednoise``: mark points and small clusters detached from everything as noise."""

from __future__ import annotations

from numpy.typing import NDArray

from ..base.asprs import NOISE
from ..base.messages import Count
from ..terrain.noise import REACH, judge_noise
from .base import ClassStage, StageContext
from .options import option
from .points import Points, class_counts


class DetachedNoise(ClassStage):
    """Find points that nothing holds, below the ground and in the air."""

    type = "filters.detachednoise"
    summary = "Mark points and small clusters detached from everything as low and high noise"
    algorithm_version = 5
    low = Count("marked as low noise")
    high = Count("marked as high noise")
    reads_around = frozenset()  # classes alone, by `ignore`
    cluster: int = option(
        "integer",
        30,
        "Maximum number of points of a noise cluster; in clouds of more than 15 points/m2 as many "
        "as lie on 2 m2",
        *(1, 1_000_000),
    )
    gap: float = option(
        "number",
        1.85,
        "Distance of noise from everything else at 10 points/m2; it grows with the cube root of "
        "the area per point, from 1 to 6 m",
        *(0, 1000),
        exclusive=True,
        unit="m",
    )
    depth: float = option(
        "number",
        1.0,
        "Minimum depth of low noise below the ground",
        *(0, 1000),
        exclusive=True,
        unit="m",
    )

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return REACH

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return set(NOISE)

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Mark noise."""
        ignored = points.ignored(self.ignore)
        sizes = {name: self.options[name] for name in ("cluster", "gap", "depth")}
        mask = ~ignored if ignored.any() else None
        noise, states = judge_noise(*points.axes, mask=mask, threads=self.threads, **sizes)
        if context.observer is not None:
            context.observer.see_noise(states)
        if points.mask is not None:
            noise[~points.mask] = 0
        codes = points.class_codes.copy()
        codes[noise != 0] = noise[noise != 0]
        for code, count in zip(NOISE, (self.low, self.high), strict=True):
            points.tally(count, noise == code)
        if noise.any():
            points.report.figures["classes"] = class_counts(codes[noise != 0])
        return {"Classification": points.with_codes(codes)}
