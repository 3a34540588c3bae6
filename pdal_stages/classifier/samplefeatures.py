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
from ..features import FeaturePlan, ShapeBins
from ..features.fitting import fit_clouds
from ..features.names import SHAPES
from .clouds import TrainingCloud
from .dimensions import gather, with_returns
from .featureforest import Features
from .sampling import Samples
from .trainoptions import TrainingOptions

#: Dimensions that the papers count among the geometric features.
CUT = ("HeightAboveGround", "Z")
#: In the counts: samples of tiles whose nearest neighbors lie beyond the halo of their features.
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
    used = [clouds[number].xyz for number in np.unique(samples.cloud).tolist()]
    return fit_clouds(used, plan, seed=options.seed, threads=options.threads)


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

            engine = features.engine(cloud.xyz, options.threads)
            there = with_returns(own, cloud.xyz, cloud.dimensions, options.threads)
            fed, counted = gather(own, there, len(cloud), rows, cloud.name)
            for key, n in counted.items():
                counts[key] = counts.get(key, 0) + n
            for part, block in engine.blocks(
                queries=rows,
                dimensions=fed,
                threads=options.threads,
                memory_mb=options.memory_mb,
                progress=bar,
            ):
                values[at[np.searchsorted(rows, part)]] = block
            if cloud.own is not None and engine.report.beyond_halo:
                counts[SHORT] = counts.get(SHORT, 0) + max(engine.report.beyond_halo.values())
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
