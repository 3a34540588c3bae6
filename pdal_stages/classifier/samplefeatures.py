"""Features of the samples: fitted to the training clouds, computed cloud by cloud, limited to their percentiles."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.progress import Progress
from ..base.threads import map_blocks
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.fitting import fit_clouds
from ..features.names import SHAPES
from ..features.samples import SAMPLES, smallest_hashes
from .clouds import TrainingCloud
from .dimensions import gather, with_returns
from .featureforest import Features
from .sampling import Samples
from .surroundings import Looks, Seen, work_on
from .trainoptions import TrainingOptions

#: Dimensions that the papers count among the geometric features.
CUT = ("HeightAboveGround", "Z")
#: In the counts: samples whose neighbors lie farther away than the memory allowed to look.
SHORT = "short_of_neighbors"
_HISTOGRAMS = tuple(f"{metric}_" for metric in SHAPES)


def must_fit(columns: int, n: int) -> None:
    """An error where this machine cannot hold the matrix of all samples."""
    needed = n * columns * 4
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return  # a system that does not tell
    if needed > 0.8 * there:
        raise OptionError(
            f"{n:,} samples of {columns} features do not fit in this machine's memory",
            found=f"{needed / 2**30:.1f} GiB needed, {there / 2**30:.1f} GiB there",
            cure="Lower 'count', or use fewer neighborhoods or features",
        )


def fitted(
    clouds: Sequence[TrainingCloud], samples: Samples, plan: FeaturePlan, options: TrainingOptions
) -> tuple[ShapeBins | None, float | None]:
    """Shape thresholds and the threshold of copt, fitted to the clouds that have samples; see :func:`fit_clouds`."""
    if not (plan.shapes or plan.copt):
        return None, None
    used = {clouds[number].whole for number in np.unique(samples.cloud).tolist()}
    views = [cloud for cloud in clouds if cloud.whole in used]
    if len(views) == len(used):
        return fit_clouds([one.xyz for one in views], plan, seed=options.seed, threads=options.threads)
    threshold = _threshold_of_parts(views, plan, options.threads) if plan.copt else None
    if not plan.shapes:
        return None, threshold
    each = [smallest_hashes(one.xyz, options.seed) for one in views]
    of_whole: dict[object, list[npt.NDArray[np.uint64]]] = {}
    for one, (hashes, _) in zip(views, each, strict=True):
        of_whole.setdefault(one.whole, []).append(hashes)
    least = np.sort(np.concatenate([np.sort(np.concatenate(h))[:SAMPLES] for h in of_whole.values()]))
    last = least[min(SAMPLES, len(least)) - 1]
    values: dict[str, list[npt.NDArray[Any]]] = {}

    def compute(_: Any, seen: Seen, again: bool) -> bool:
        narrow = np.zeros(len(seen.rows), bool)
        if plan.unbounded and not seen.whole:
            narrow, _ = Looks(plan).too_narrow(seen, options.threads)
        if not narrow.all():
            engine = FeatureEngine(
                seen.xyz, plan, copt_threshold=threshold, seed=options.seed, threads=options.threads
            )
            for token, some in engine.shape_values(seen.rows[~narrow]).items():
                values.setdefault(token, []).append(some)
        return bool(narrow.any())  # which come again

    for one, (hashes, rows) in zip(views, each, strict=True):
        rows = np.sort(rows[hashes <= last])
        if len(rows):
            work_on(one, rows, Looks(plan), compute, options.threads)
    return ShapeBins.fit({token: np.concatenate(parts) for token, parts in values.items()}), threshold


def _threshold_of_parts(parts: Sequence[TrainingCloud], plan: FeaturePlan, threads: int | None) -> float:
    """The threshold of copt, of the curvatures of all points of clouds in parts, which are held at once."""
    from ..features.ropt import curvature_threshold  # numba is loaded here, not when the package is

    count = sum(map(len, parts))
    if not all(one.holds_numbers(count) for one in parts):
        raise OptionError(
            "the threshold of copt is fitted to the curvatures of all points at once [H17], and these do not fit in the "
            "memory that was given",
            found=f"{count:,} points",
            cure="Give more memory, or choose other neighborhoods",
        )
    each = []
    for one in parts:
        seen = one.seen(np.arange(len(one)), plan.halo_m)
        each.append(FeatureEngine(seen.xyz, plan, threads=threads).curvatures(seen.rows))
    return curvature_threshold(np.concatenate(each))


def sample_features(
    clouds: Sequence[TrainingCloud],
    samples: Samples,
    features: Features,
    options: TrainingOptions,
    progress: bool,
) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
    """The (samples, features) float32 matrix, filled cloud by cloud, and what was counted."""
    names, own = features.plan.names, features.plan.dimensions
    values = np.empty((len(samples), len(names)), np.float32)
    counts: dict[str, Any] = {}
    with Progress(len(samples), "features of the samples", enabled=progress) as bar:
        for number, cloud in enumerate(clouds):
            at, rows = samples.of_cloud(number)
            if not len(at):
                continue

            def compute(
                places: npt.NDArray[np.int64],
                seen: Seen,
                again: bool,
                at: npt.NDArray[np.int64] = at,
                name: str = cloud.name,
            ) -> bool:
                engine = features.engine(seen.xyz, options.threads)
                there = with_returns(own, seen.xyz, seen.dimensions, options.threads)
                fed, counted = gather(own, there, len(seen.xyz), seen.rows, name)
                for key, n in counted.items():
                    counts[key] = counts.get(key, 0) + (0 if again else n)
                for part, block in engine.blocks(
                    queries=seen.rows,
                    dimensions=fed,
                    threads=options.threads,
                    memory_mb=options.memory_mb,
                    progress=None if again else bar,
                ):
                    values[at[places[np.searchsorted(seen.rows, part)]]] = (
                        block  # `part` are rows of the cloud
                    )
                return bool(engine.report.beyond_halo)

            if short := work_on(cloud, rows, Looks(features.plan), compute, options.threads):
                counts[SHORT] = counts.get(SHORT, 0) + short
    if not np.isfinite(values).all():
        column = int(np.argmin(np.isfinite(values).all(axis=0)))
        raise DimensionError(f"the feature {names[column]} is not finite for some samples")
    return values, counts


def percentiles(
    values: npt.NDArray[np.float32], plan: FeaturePlan, options: TrainingOptions
) -> tuple[list[float], list[float]]:
    """1st and 99th percentile of each geometric feature, the values limited to them if so wanted.

    [B16 3.3] scales features to [0, 1] between the two and cuts off what is beyond. Splits of a tree do not
    change under scaling, so only the cut is done, on the training values: no threshold can then lie beyond
    the percentiles, and a value beyond goes the way its limit would. Inference needs neither. Histograms of shape
    distributions and the points' other dimensions are not cut; for them it is the smallest and largest value.
    """
    names, computed = plan.names, len(plan.names) - len(plan.dimensions)
    low = [0.0] * len(names)
    high = [1.0] * len(names)

    def one(j: int) -> None:
        column = values[:, j]
        if names[j] not in CUT if j >= computed else names[j].startswith(_HISTOGRAMS):
            low[j], high[j] = float(column.min()), float(column.max())
            return
        first, last = np.percentile(column, [1.0, 99.0]).astype(np.float32)
        if np.abs(column).min() == 0.0 and first >= 0.0 and column.min() >= 0.0:
            first = np.float32(0.0)
        low[j], high[j] = float(first), float(last)
        if options.scale:
            np.clip(column, first, last, out=column)

    for _ in map_blocks(one, range(len(names)), options.threads):
        pass
    return low, high
