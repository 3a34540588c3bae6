"""Labeled clouds of the experiments, read from LAS or LAZ."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pdal_stages.terrain.minima import hag_minima


@dataclass(frozen=True, eq=False)
class Cloud:
    """A labeled cloud: (n, 3) coordinates in meters, (n,) class codes, and the points' own
    dimensions."""

    name: str
    xyz: np.ndarray
    labels: np.ndarray
    dimensions: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.labels)

    def only(self, mask: np.ndarray) -> Cloud:
        """The points of a mask, as a cloud of their own."""
        return Cloud(
            self.name,
            np.ascontiguousarray(self.xyz[mask]),
            self.labels[mask],
            {k: v[mask] for k, v in self.dimensions.items()},
        )


def read_cloud(paths: Iterable[Path], name: str) -> Cloud:
    """LAS or LAZ files as one cloud."""
    import laspy

    tiles = [laspy.read(path) for path in paths]
    if not tiles:
        sys.exit(f"no clouds for {name}: name their folder with --data")
    xyz = np.concatenate([np.column_stack([t.x, t.y, t.z]) for t in tiles])
    return Cloud(name, xyz, np.concatenate([np.asarray(t.classification) for t in tiles]))


def with_height(cloud: Cloud) -> Cloud:
    """The cloud with HeightAboveGround [W18 3.2]."""
    heights = hag_minima(*cloud.xyz.T)
    height = heights[0] if isinstance(heights, tuple) else heights
    return Cloud(
        cloud.name, cloud.xyz, cloud.labels, {**cloud.dimensions, "HeightAboveGround": height}
    )
