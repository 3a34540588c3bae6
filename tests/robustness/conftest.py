"""Fixtures of the matrix."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))
import robustness_kit as kit


@pytest.fixture()
def cell(tmp_path, capfd):
    """Return a function ``cell(group, case) -> Cell``."""

    def make(group: str, case: str) -> kit.Cell:
        return kit.Cell(group, case, tmp_path, capfd)

    return make


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """A folder for files that several cells read."""
    return tmp_path_factory.mktemp("shared")


def scene(n: int = 600, seed: int = 1, size: float = 30.0) -> dict[str, np.ndarray]:
    """Ground with a block on it, in coordinates of a national grid."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, n)).round(2)
    block = (x > size / 2) & (y > size / 2)
    z = np.where(block, 5.0, 0.0) + rng.normal(0, 0.02, n).round(2)
    return {
        "X": x + 500_000,
        "Y": y + 5_400_000,
        "Z": z + 100,
        "Classification": np.where(block, 6, 2).astype(np.uint8),
    }


@pytest.fixture(scope="session")
def cloud(shared, write_las) -> Path:
    """A small good cloud."""
    return write_las(shared / "cloud.las", scene(), point_format=3)


@pytest.fixture(scope="session")
def model(shared, cloud) -> Path:
    """A small good model: ground and building, with HeightAboveGround."""
    import pdal_stages as ps

    path = shared / "small.model"
    ps.run_pipeline(
        [
            str(cloud),
            {"type": "filters.hag_minima"},
            {
                "type": "writers.classifiermodel",
                "filename": str(path),
                "neighborhoods": "c1,s2,k10",
                "feature_set": "covariance,geometric",
                "count": 100,
                "trees": 5,
            },
        ]
    )
    return path
