"""Fixtures of the tests of what goes wrong."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))
import robustness_kit as kit


@pytest.fixture()
def command(tmp_path, capfd) -> kit.Command:
    return kit.Command(tmp_path, capfd)


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """A folder for files that several tests read."""
    return tmp_path_factory.mktemp("shared")


@pytest.fixture(scope="session")
def cloud(shared, write_las) -> Path:
    """A small good cloud."""
    return write_las(shared / "cloud.las", kit.scene(), point_format=3)


@pytest.fixture(scope="session")
def model(shared, cloud) -> Path:
    """A small good model: ground and building, with HeightAboveGround."""
    import pdal_stages as ps

    path = shared / "small.model"
    write = {"type": "writers.classifiermodel", "filename": str(path), "neighborhoods": "c1,s2,k10", "count": 100,
             "feature_set": "covariance,geometric", "trees": 5}  # fmt: skip
    ps.run_pipeline([str(cloud), kit.HAG, write])
    return path
