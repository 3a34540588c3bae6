"""Training a model, whatever its algorithm."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.errors import OptionError
from .algorithms import trainer
from .clouds import TrainingCloud
from .model import Model
from .trainoptions import TrainingOptions


def train(
    clouds: Sequence[TrainingCloud], options: TrainingOptions | None = None, progress: bool = True
) -> Model:
    """Train a model.

    Parameters
    ----------
    clouds : sequence of TrainingCloud
        One per file or view. Features see only their own cloud.
    options : TrainingOptions
    progress : bool
        Whether to show progress on stderr.

    Raises
    ------
    OptionError, DimensionError
    """
    options = options or TrainingOptions()
    clouds = [clouds] if isinstance(clouds, TrainingCloud) else list(clouds)
    if not clouds:
        raise OptionError("no training cloud was given")
    return trainer(options.algorithm).train(clouds, options, progress)
