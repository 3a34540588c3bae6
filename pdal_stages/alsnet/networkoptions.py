"""Options of training a network, checked before any work is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ..base import checks
from ..base.errors import OptionError, suggest
from .configuration import parse_configuration

CLASS_WEIGHTS = ("none", "sqrt", "balanced")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class NetworkOptions:
    """How a network is trained.

    Attributes
    ----------
    configuration : str or mapping
        A named configuration (``small``, ``tiny``, ``alsnet4``, ``alsnet3``) or one of your own.
    points : int or None
        Points of a batch, instead of the configuration's.
    spacing : float or None
        Of the batches' grid in meters. None: from the clouds' density, for four batches a point.
    coordinates : str
        Which of X, Y and Z, from the batch's center, are inputs: ``"Z"``, ``"XYZ"`` or ``""``. Offsets within a
        ball are inputs always.
    epochs : int
        At most; each sees every chosen batch once.
    batches_per_step : int
        Batches whose gradients make one step.
    learning_rate : float
        At the start; it falls to 1 % of that along a cosine.
    class_weights : {"sqrt", "none", "balanced"}
        Weight of a class in the loss: 1 / sqrt(share), 1 [WM19], or 1 / share.
    histogram_threshold : float
        Batches whose class shares have a standard deviation of this or more (per cent) are not trained on:
        they hold next to nothing but one class [WM19: 20 %]. 100: all are used.
    rotate : bool
        Turn each batch about its center by a random angle.
    shift : float
        Move batch centers by up to this share of the spacing, anew in each epoch.
    jitter : float
        Standard deviation of noise on coordinates, meters; cut at three times that.
    thin : float
        Most points a batch may lose; the share is drawn anew for each.
    validation : float
        Share of the ground held out, in whole blocks, to choose the best epoch; 0: none.
    block_size : float
        Side of those blocks, meters.
    patience : int
        Epochs without a better mean F1 on the held out blocks after which training ends; 0: never.
    checkpoint : str or None
        File written after every epoch; where it exists, training goes on from it.
    start_from : str or None
        Model file whose weights training starts from. Classes it shares keep theirs, others start afresh.
    device : {"auto", "cpu", "cuda"}
    """

    configuration: Any = "small"
    points: int | None = None
    spacing: float | None = None
    coordinates: str = "Z"
    epochs: int = 60
    batches_per_step: int = 2
    learning_rate: float = 0.002
    class_weights: str = "sqrt"
    histogram_threshold: float = 20.0
    rotate: bool = True
    shift: float = 0.5
    jitter: float = 0.01
    thin: float = 0.4
    validation: float = 0.2
    block_size: float = 25.0
    patience: int = 20
    checkpoint: str | None = None
    start_from: str | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "configuration", parse_configuration(self.configuration, self.points))
        set_(self, "epochs", checks.whole("'epochs'", self.epochs, 1, 100_000))
        set_(self, "batches_per_step", checks.whole("'batches_per_step'", self.batches_per_step, 1, 1024))
        set_(self, "patience", checks.whole("'patience'", self.patience, 0, 100_000))
        limits = {
            "learning_rate": (1e-8, 10.0), "histogram_threshold": (0.0, 100.0), "shift": (0.0, 0.5),
            "jitter": (0.0, 10.0), "thin": (0.0, 0.95), "validation": (0.0, 0.5), "block_size": (0.1, 1e6),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            set_(self, name, checks.number(f"'{name}'", getattr(self, name), low, high))
        if self.spacing is not None:
            set_(self, "spacing", checks.number("'spacing'", self.spacing, 0.01, 1e5))
        checks.flag("'rotate'", self.rotate)
        checks.one_of("'class_weights'", self.class_weights, CLASS_WEIGHTS)
        checks.one_of("'device'", self.device, DEVICES)
        checks.one_of("'coordinates'", self.coordinates, ("", "Z", "XYZ"))
        for name in ("checkpoint", "start_from"):
            if getattr(self, name) is not None and not isinstance(getattr(self, name), str):
                raise OptionError(f"'{name}' must be a file name", found=repr(getattr(self, name)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkOptions:
        """Options by name; an unknown name is an error."""
        known = [f.name for f in fields(cls)]
        for name in values:
            if name not in known:
                raise OptionError(
                    f"unknown alsNet option '{name}'",
                    cure=f"{suggest(str(name), known)}Options: {', '.join(known)}",
                )
        return cls(**values)
