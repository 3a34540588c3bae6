"""Training clouds that need not fit in memory together: made one at a time, kept on disk, mapped when looked at."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError
from .clouds import TrainingCloud


def spooled(clouds: Iterable[TrainingCloud], folder: Path) -> list[TrainingCloud]:
    """The clouds with their arrays in files of `folder`, one cloud in memory at a time.

    Raises
    ------
    StageError
        The files cannot be written.
    """
    return [_mapped(one, folder, number) for number, one in enumerate(clouds)]


def _mapped(cloud: TrainingCloud, folder: Path, number: int) -> TrainingCloud:
    def kept(name: str, array: npt.ArrayLike | None) -> Any:
        if array is None:
            return None
        path = folder / f"{number}.{name}.npy"
        try:
            np.save(path, np.asarray(array), allow_pickle=False)
            return np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise StageError(
                "training clouds cannot be kept in a temporary folder",
                found=f"{folder}: {error.strerror or error}",
                cure="Set TMPDIR to a folder with more room",
            ) from error

    return TrainingCloud(
        kept("xyz", cloud.xyz),
        kept("labels", cloud.labels),
        {name: kept(f"d{place}", cloud.dimensions[name]) for place, name in enumerate(cloud.dimensions)},
        cloud.name,
        kept("mask", cloud.mask),
        cloud.survey,
        cloud.copy,
    )
