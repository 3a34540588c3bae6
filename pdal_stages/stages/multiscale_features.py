"""``filters.multiscalefeatures``: features of many neighborhoods as dimensions [B16, W18, H17]."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.checks import strict_json
from ..base.dimensions import Dimension
from ..base.errors import OptionError
from ..base.files import JSON, Output, write_whole
from ..base.progress import Progress
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.plan import DEFAULT_FEATURES, DEFAULT_NEIGHBORHOODS
from ..features.registry import ALGORITHM_VERSION, BY_NAME, features_of
from .base import Stage, StageContext
from .options import Selection, ignore_option, option
from .points import Points

#: Bytes a LAS extra-dimension name may have.
_NAME_BYTES = 32


class MultiscaleFeatures(Stage):
    """Compute features of the neighborhoods of each point."""

    type = "filters.multiscalefeatures"
    summary = "Covariance, geometric and shape-distribution features of many neighborhoods"
    source = "[B16] sections 3.1-3.2, [W18] section 3.2, [H17] equations 1-3"
    algorithm_version = ALGORITHM_VERSION
    where_chooses = True
    where_help = "Features are computed for the points inside; all points are neighbors"
    neighborhoods: list = option(
        "list",
        DEFAULT_NEIGHBORHOODS,
        "Neighborhoods: tokens (c2 cylinder, s1 sphere, k50 nearest, kopt, ropt, rdim, copt) or a "
        "preset (blomley2016, weinmann2018, he2017)",
    )
    feature_set: list = option(
        "list",
        DEFAULT_FEATURES,
        "Groups (covariance, geometric, shapes, surfaces, all) or single features (Linearity, A3, "
        "...)",
    )
    seed: int = option(
        "integer", 0, "Seed for the random draws of the shape distributions", 0, 2**31 - 1
    )
    bins: str | None = option(
        "filename",
        None,
        "JSON file with the thresholds of shape histograms and curvature: read if it exists, "
        "otherwise fitted to these points and written, so that other clouds can use the same ones",
    )
    ignore: Selection = ignore_option("Points left out, even as neighbors: they get no features")
    memory_mb: int = option(
        *("integer", 512, "Memory for blocks of points, in addition to the cloud itself", 16),
        unit="MB",
    )

    @cached_property
    def plan(self) -> FeaturePlan:
        """The parsed neighborhoods and features."""
        return FeaturePlan.parse(self.neighborhoods, feature_set=self.feature_set)

    @cached_property
    def columns(self) -> list[str]:
        """Features to write: the point's own dimensions are there already."""
        return [name for name in self.plan.names if name not in self.plan.dimensions]

    def check(self) -> None:
        """Refuse options that contradict each other."""
        plan, (bins, threshold) = self.plan, _read_bins(self.bins)
        if self.bins and Path(self.bins).exists():
            if (plan.shapes and bins is None) or (plan.copt and threshold is None):
                raise _not_thresholds(self.bins, "none of what these features need")
            for part in plan.layout:
                if part.shapes and bins is not None:
                    bins.thresholds(part.neighborhood.token)  # refused where there are none
        elif plan.shapes or (plan.copt and threshold is None):
            self.instead_of_tiles = (
                'Thresholds are fitted to the points: give "bins": "thresholds.json", and run the '
                "pipeline once without --tile on one typical file, which writes it"
            )
        for name in self.columns:
            if len(name.encode()) > _NAME_BYTES:
                raise OptionError(
                    f"the dimension name '{name}' is longer than the {_NAME_BYTES} bytes that LAS "
                    "allows",
                    cure="Use shorter neighborhood tokens",
                )

    def outputs(self) -> list[Output]:
        """Return the files that are written."""
        if self.bins is None or Path(self.bins).exists():
            return []
        return [Output(self.bins, "bins", JSON)]

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written, lengths in meters."""
        named = features_of(self.plan.neighborhoods)
        features = [BY_NAME[named[name][1]] for name in self.columns]
        return [
            Dimension(name, "float", feature.unit, feature.definition)
            for name, feature in zip(self.columns, features, strict=True)
        ]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return self.plan.halo_m

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Compute features, block by block."""
        plan, names = self.plan, self.columns
        bins, threshold = _read_bins(self.bins)
        ignored = points.ignored(self.ignore)
        there = np.flatnonzero(~ignored)  # rows of the points that are seen
        xyz = points.xyz[there] if ignored.any() else points.xyz
        queries = None if points.mask is None else np.flatnonzero(points.mask[there])
        total = len(there) if queries is None else len(queries)
        inputs = {name: points.dimension(name)[there] for name in plan.dimensions}
        engine = FeatureEngine(
            xyz, plan, bins=bins, copt_threshold=threshold, seed=self.seed, threads=self.threads
        )
        if queries is not None:
            inputs = {name: values[queries] for name, values in inputs.items()}
        columns = [plan.names.index(name) for name in names]
        out = {name: np.array(points.arrays[name]) for name in self.creates()}
        with Progress(total, self.type) as progress:
            run = engine.run(queries, dimensions=inputs, memory_mb=self.memory_mb)
            for block in run.computed():
                progress.update(len(block.rows))
                rows = there[block.rows]
                for name, column in zip(names, columns, strict=True):
                    out[name][rows] = block.values[:, column]
        for output in self.outputs() if len(engine) else ():
            _write_bins(output.path, engine.fit())
        figures = points.report.figures
        figures |= {"neighborhoods": len(plan.neighborhoods), "features": len(names)}
        if plan.copt:
            figures["copt_threshold"] = engine.copt_threshold
        figures |= engine.report.figures
        points.report.merge(engine.report)
        return out


def _read_bins(path: str | None) -> tuple[ShapeBins | None, float | None]:
    """Read the thresholds of histograms and of curvature; None where the file has none."""
    if path is None or not Path(path).exists():
        return None, None
    try:
        content = strict_json(Path(path).read_bytes())
        bins, threshold = content["bins"], content["copt_threshold"]
        bins = None if bins is None else ShapeBins.from_dict(bins)
        return bins, None if threshold is None else float(threshold)
    except (OSError, ValueError, AttributeError, TypeError, KeyError, RecursionError) as error:
        raise _not_thresholds(path, str(error)) from None


def _not_thresholds(path: str, fault: str) -> OptionError:
    """Return the error on a file that does not hold what is needed."""
    return OptionError(
        f"option 'bins': '{path}' does not hold the thresholds that this stage writes",
        found=fault,
        cure="Delete it to have it written again, or name another file",
    )


def _write_bins(path: str, engine: FeatureEngine) -> None:
    """Write the thresholds that an engine fitted."""
    content = {
        "format": "pdal_stages thresholds 1",
        "bins": engine.bins.to_dict() if engine.bins is not None else None,
        "copt_threshold": engine.copt_threshold,
    }
    write_whole(path, json.dumps(content, indent=1).encode())
