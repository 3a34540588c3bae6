"""From labeled clouds to a model with a network in it: how ``alsnet`` is trained."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..base import kinds
from ..base.errors import OptionError
from ..base.outputs import Output
from ..base.version import __version__
from ..classifier.clouds import TrainingCloud, densities, label_classes
from ..classifier.dimensions import gather, with_returns
from ..classifier.model import Model
from ..classifier.trainoptions import TrainingOptions
from ..features.index import check_xyz
from .epochs import LabeledCloud, train_network
from .networkoptions import NetworkOptions

optional_inputs: dict[str, tuple[str, ...]] = {}
reports_training = True


def outputs(options: TrainingOptions) -> list[Output]:
    """The checkpoint, if one is wanted."""
    path = options.alsnet.checkpoint
    return [Output(path, "checkpoint", kinds.CHECKPOINT)] if path else []


def own_options(given: Any) -> NetworkOptions:
    """The options of the network."""
    if isinstance(given, NetworkOptions):
        return given
    if given is not None and not isinstance(given, Mapping):
        raise OptionError("'alsnet' must be a mapping of options", found=repr(given)[:60])
    return NetworkOptions.from_dict(given or {})


def inputs(options: TrainingOptions) -> tuple[str, ...]:
    """The network's inputs: coordinates from the batch's center, then dimensions; OptionError where there are none."""
    names = tuple(dict.fromkeys([*options.alsnet.coordinates, *options.dimensions]))
    if not names:
        raise OptionError(
            "a network needs at least one input", cure="Name a dimension, or set 'coordinates' to Z or XYZ"
        )
    return names


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """See :func:`pdal_stages.classifier.train`. A batch sees only its own cloud."""
    from .network import torch  # before any work: says what to install where it is missing

    started = time.perf_counter()
    names = inputs(options)
    checked = [check_xyz(np.asarray(cloud.xyz), cloud.name) for cloud in clouds]
    known = label_classes(clouds, options)
    classes, positions = known.classes, [position for _, position in known]
    labeled: list[LabeledCloud] = []
    counts: dict[str, int] = {}
    for cloud, xyz, position in zip(clouds, checked, positions, strict=True):
        values, counted = gather(
            names, with_returns(names, xyz, cloud.dimensions, options.threads), len(xyz), where=cloud.name
        )
        for name, number in counted.items():
            counts[name] = counts.get(name, 0) + number
        labeled.append(LabeledCloud(xyz, position, values))
    trained = train_network(
        labeled,
        names,
        classes,
        options.alsnet,
        seed=options.seed,
        threads=options.threads,
        progress=progress,
    )
    used = [np.bincount(p[p >= 0], minlength=len(classes.codes)) for p in positions]
    count = np.sum(used, axis=0)
    low, high = zip(*(_range(name, labeled) for name in names), strict=True)
    info: dict[str, Any] = {
        **known.described(
            options, ({"available": int(m), "samples": int(m), "duplicates": 0} for m in count)
        ),
        "training": {
            "clouds": [{"name": os.path.basename(c.name), "points": len(c.xyz)} for c in clouds],
            "count": int(count.sum()),
            "seed": options.seed,
            "samples": int(count.sum()),
            **({"contradicted": dict(known.left_out)} if known.left_out else {}),
            **trained.notes,
            **{name: number for name, number in counts.items() if number},
        },
        "densities": densities(clouds),
        "voxel": options.voxel,
        "accuracy": {"cross_validation": None},
        "passes": [
            {
                "percentiles": {"low": list(low), "high": list(high), "limited": False},
                "importances": None,
                "out_of_bag": None,
            }
        ],
        "created_by": {
            "pdal_stages": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": str(torch.__version__),
        },
    }
    seconds = {**trained.seconds, "whole": round(time.perf_counter() - started, 3)}
    return Model((trained.net,), list(zip(classes.codes, classes.names, strict=True)), info, seconds)


def _range(name: str, clouds: Sequence[LabeledCloud]) -> tuple[float, float]:
    """Smallest and largest value of an input; 0 and 0 for coordinates, which depend on the batch."""
    if name in ("X", "Y", "Z"):
        return 0.0, 0.0
    parts = [np.asarray(cloud.dimensions[name], np.float64) for cloud in clouds if len(cloud.xyz)]
    return min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)
