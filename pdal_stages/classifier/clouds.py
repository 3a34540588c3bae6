"""Labelled clouds to train on, and the classes their labels make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..base.asprs import UNINFORMATIVE
from ..base.errors import OptionError
from .classes import ClassMap, as_labels
from .trainoptions import TrainingOptions


@dataclass(frozen=True, eq=False)
class TrainingCloud:
    """A labelled cloud.

    Attributes
    ----------
    xyz : (n, 3) float64
        Coordinates in metres.
    labels : (n,) int
    dimensions : mapping
        Name to (n,) values, as the options' `dimensions` need.
    name : str
        For messages and the model file; a path is cut to its last part.
    survey : str, optional
        The flight it belongs to; by default it is one of its own.
    mask : (n,) bool, optional
        Points samples may be drawn from; all points serve as neighbors.
    """

    xyz: npt.NDArray[np.float64]
    labels: npt.ArrayLike
    dimensions: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    name: str = "cloud"
    mask: npt.ArrayLike | None = None
    survey: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", np.asarray(self.xyz, dtype=np.float64))


def class_positions(
    clouds: Sequence[TrainingCloud], options: TrainingOptions
) -> tuple[ClassMap, list[npt.NDArray[np.int16]]]:
    """The classes, and for each cloud the place of each point's class in them, -1 where it is not used."""
    usable = []
    found: dict[int, int] = {}
    for cloud in clouds:
        labels = as_labels(cloud.labels, cloud.name)
        if len(labels) != len(cloud.xyz):
            raise OptionError(
                "labels and points differ in number",
                where=cloud.name,
                found=f"{len(labels)} and {len(cloud.xyz)}",
            )
        mask = None
        if cloud.mask is not None:
            mask = np.asarray(cloud.mask)
            if mask.shape != labels.shape or mask.dtype != np.bool_:
                raise OptionError("the mask must be one true or false per point", where=cloud.name)
        number = np.bincount(labels if mask is None else labels[mask])
        for label in np.flatnonzero(number).tolist():
            found[label] = found.get(label, 0) + int(number[label])
        usable.append((labels, mask))
    listing = ", ".join(f"{label}: {n:,}" for label, n in sorted(found.items())[:20]) or "no points"
    classes = ClassMap.parse(options.classes, found)
    if options.strategy == "binary" and options.target is not None:
        classes = classes.binary(options.target, options.background)
    for code, name, members in zip(classes.codes, classes.names, classes.labels, strict=True):
        if not any(found.get(label) for label in members):
            raise OptionError(
                f"class {code} ({name}) has no samples",
                found=f"none of label {' or '.join(map(str, members))}; labels {listing}",
                cure="Leave the class out of 'classes', or give clouds that have it",
            )
    if len(classes.codes) < 2:
        raise OptionError(
            "a classifier needs at least two classes",
            found=f"labels {listing}",
            cure=f"Labels {', '.join(map(str, UNINFORMATIVE))} are left out unless 'classes' names them",
        )
    positions = []
    for labels, mask in usable:
        position = classes.index(labels)
        if mask is not None:
            position[~mask] = -1
        positions.append(position)
    return classes, positions
