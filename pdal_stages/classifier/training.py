"""Training a model, whatever its algorithm."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

from ..base.errors import OptionError
from .algorithms import trainer
from .clouds import Source, TrainingCloud, prepared
from .model import Model
from .spool import spooled
from .trainoptions import TrainingOptions


def train(
    clouds: TrainingCloud | Iterable[Source], options: TrainingOptions | None = None, progress: bool = True
) -> Model:
    """Train a model.

    Parameters
    ----------
    clouds : iterable of TrainingCloud, or of functions that make one
        One per file or view. Features see only their own cloud. Where functions are given, or anything but a list or
        tuple, one cloud at a time is in memory; all are kept in a temporary folder while training lasts.
    options : TrainingOptions
    progress : bool
        Whether to show progress on stderr.

    Raises
    ------
    OptionError, DimensionError
    """
    options = options or TrainingOptions()
    sources: Iterable[Source] = [clouds] if isinstance(clouds, TrainingCloud) else clouds
    with tempfile.TemporaryDirectory(prefix="pdal-stages-") as folder:
        at_hand = isinstance(sources, list | tuple) and not any(callable(one) for one in sources)
        each = prepared(sources, options)
        made = list(each) if at_hand else spooled(each, Path(folder))
        if not made:
            raise OptionError("no training cloud was given")
        return trainer(options.algorithm).train(made, options, progress)
