"""Training a model, whatever its algorithm."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.json_types import StageJson
from ..features.point_grid import check_xyz
from .input_dimensions import DEFAULT_DIMENSIONS, OPTIONAL_DIMENSIONS, required_dimensions
from .interface import preprocessing, trainer_of
from .model import Model
from .training_clouds import TrainingCloud, prepared, spooled
from .training_options import TrainingOptions


def train(
    clouds: TrainingCloud | Iterable[TrainingCloud] | npt.ArrayLike,
    labels: npt.ArrayLike | TrainingOptions | None = None,
    options: TrainingOptions | None = None,
    *,
    dimensions: Mapping[str, npt.ArrayLike] | None = None,
    progress: bool = True,
) -> Model:
    """Train a model: ``train(xyz, labels)``, or ``train(clouds, options)``.

    Parameters
    ----------
    clouds : (n, 3) array, TrainingCloud, or iterable of TrainingCloud
        Coordinates in meters of points that have `labels`; or one cloud per file or view. Features
        see only their own cloud. Of anything but a list or tuple one cloud at a time is in memory;
        all are kept in files while training lasts.
    labels : (n,) int, optional
        Class codes, with coordinates; the options may stand here otherwise.
    options : TrainingOptions
    dimensions : mapping, optional
        With coordinates: name to (n,) values, as the options' `dimensions` need. Without, heights
        are made of the coordinates as ``filters.hag_morphological`` makes them, and the model knows
        how.
    progress : bool
        Whether to show progress on stderr.
    """
    if isinstance(labels, TrainingOptions):
        options, labels = labels, None
    options = options or TrainingOptions()
    preparation: list[StageJson] = []
    sources: Any = [clouds] if isinstance(clouds, TrainingCloud) else clouds
    if labels is not None:
        cloud = TrainingCloud(check_xyz(clouds), labels, dimensions or {})
        if dimensions is None:
            if tuple(options.dimensions) == DEFAULT_DIMENSIONS:
                supported = trainer_of(options.algorithm).optional_inputs
                more = (name for name in OPTIONAL_DIMENSIONS if name in supported)
                options = replace(options, dimensions=(*DEFAULT_DIMENSIONS, *more))
            stages = preprocessing()
            preparation = stages.preparation_of(required_dimensions(options.inputs))
            usable = ~np.isin(cloud.codes, options.ignore)
            computed = stages.made_of_coordinates(preparation, cloud.xyz, usable, options.threads)
            cloud = replace(cloud, dimensions=computed)
        sources = [cloud]
    with tempfile.TemporaryDirectory(prefix="pdal-stages-") as temporary:
        usable_clouds = _usable_clouds(sources, options, Path(temporary))
        model = trainer_of(options.algorithm).train(usable_clouds, options, progress)
    if options.base is None:
        model.record_preprocessing(preparation)
    return model


def _usable_clouds(
    sources: Iterable[TrainingCloud], options: TrainingOptions, folder: Path
) -> list[TrainingCloud]:
    """Return the clouds without ignored points; those of an iterator are kept in files."""
    clouds: Iterable[TrainingCloud] = prepared(sources, options)
    if not isinstance(sources, list | tuple):
        clouds = spooled(clouds, folder)
    if usable := [cloud for cloud in clouds if len(cloud)]:
        return usable
    labels = " and ".join(map(str, options.ignore)) or "none"
    raise OptionError(
        "there are no points to train on",
        cure="Give some. Left out are points that are withheld or that 'ignore' names otherwise, "
        f"and those of its labels ({labels}) unless 'classes' names them",
    )
