"""What features need of all training clouds together: one threshold of copt, one set of shape thresholds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .bins import SAMPLES, ShapeBins, smallest_hashes
from .engine import FeatureEngine
from .plan import FeaturePlan


def fit_clouds(
    clouds: Sequence[npt.ArrayLike], plan: FeaturePlan, *, seed: int = 0, threads: int | None = None
) -> tuple[ShapeBins | None, float | None]:
    """Shape thresholds and the threshold of copt, fitted to several clouds as if to one.

    Curvatures of all points of all clouds are parted together [H17 eq. 3], and the 500 sample neighborhoods
    [B16 3.2.2] are those round the points with the smallest hashes of all. A neighborhood lies within its own cloud. Of
    one cloud the result is :meth:`FeatureEngine.fit`'s; the order of the clouds (n, 3), in meters, does not matter. None
    where the plan has no shapes, or no copt.
    """
    if not (plan.shapes or plan.copt):
        return None, None
    if len(clouds) == 1:
        engine = FeatureEngine(clouds[0], plan, seed=seed, threads=threads).fit()
        return engine.bins, engine.copt_threshold
    threshold = None
    if plan.copt:
        from .adaptive import curvature_threshold  # numba is loaded here, not when the package is

        each = [FeatureEngine(cloud, plan, threads=threads).curvatures() for cloud in clouds]
        threshold = curvature_threshold(np.concatenate(each))
    if not plan.shapes:
        return None, threshold
    values: dict[str, list[np.ndarray]] = {}
    for cloud, rows in zip(clouds, _samples(clouds, seed), strict=True):
        if len(rows):
            engine = FeatureEngine(cloud, plan, copt_threshold=threshold, seed=seed, threads=threads)
            for token, some in engine.shape_values(rows).items():
                values.setdefault(token, []).append(some)
            del engine  # one index at a time
    return ShapeBins.fit({token: np.concatenate(parts) for token, parts in values.items()}), threshold


def _samples(clouds: Sequence[npt.ArrayLike], seed: int) -> list[np.ndarray]:
    """Rows of each cloud that are among the points with the smallest hashes; a thinned copy's points tie, and all stay."""
    each = [smallest_hashes(np.asarray(cloud), seed) for cloud in clouds]
    hashes = np.sort(np.concatenate([found for found, _ in each]))
    last = hashes[min(SAMPLES, len(hashes)) - 1]
    return [rows[found <= last] for found, rows in each]
