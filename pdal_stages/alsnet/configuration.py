"""Network configurations and options of training, as data: what a model file stores and an option names.

A configuration lists the levels of set abstraction [WM19; Qi et al. 2017, PointNet++]: how many centers are
sampled, the radius of the ball around each, how many points are taken from it, the widths of the shared
perceptron that describes the ball, and the widths of the one that carries features back up to the level above.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ..base import checks
from ..base.errors import OptionError, suggest

#: A configuration's largest number of shared layers: a model file holds 63 arrays.
MAX_LAYERS = 60


@dataclass(frozen=True)
class Level:
    """One level of set abstraction and the feature propagation back from it."""

    centers: int  #: points kept, by farthest point sampling; all where there are fewer
    radius: float  #: of the ball around each center, meters
    samples: int  #: points taken from a ball
    #: widths of the shared perceptron over a ball's points; the maximum over the points follows
    mlp: tuple[int, ...]
    up: tuple[int, ...]  #: widths of the shared perceptron after interpolation to the level above

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "centers", checks.whole("'centers'", self.centers, 1, 10**7))
        set_(self, "radius", checks.number("'radius'", self.radius, 1e-3, 1e4))
        set_(self, "samples", checks.whole("'samples'", self.samples, 1, 1024))
        set_(self, "mlp", _widths("mlp", self.mlp))
        set_(self, "up", _widths("up", self.up))


@dataclass(frozen=True)
class Configuration:
    """A whole network, but for the number of inputs and classes."""

    name: str
    points: int  #: of a batch: the nearest around a grid point
    levels: tuple[Level, ...]
    #: widths after the last propagation; dropout follows, then one linear layer to the classes
    head: tuple[int, ...] = (128,)
    dropout: float = 0.5  #: share of the head's outputs left out in training

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        if not isinstance(self.name, str) or not 1 <= len(self.name) <= 60:
            raise OptionError("a configuration's name must be text", found=repr(self.name)[:60])
        set_(self, "points", checks.whole("'points'", self.points, 16, 10**7))
        if not 1 <= len(self.levels) <= 8:
            raise OptionError("a network must have 1 to 8 levels", found=len(self.levels))
        set_(self, "head", _widths("head", self.head))
        set_(self, "dropout", checks.number("'dropout'", self.dropout, 0.0, 0.95))
        if (layers := len(self.shapes(1, 1))) > MAX_LAYERS:
            raise OptionError(f"a network may have {MAX_LAYERS} layers", found=layers)

    def _linear(self, inputs: int) -> Iterator[tuple[str, int, int, int, int]]:
        """Of every layer but the last, in the order of the computation: name, rows, inputs, outputs, depth below."""
        width, rows = [inputs], [self.points]
        for number, level in enumerate(self.levels, 1):
            rows.append(min(level.centers, rows[-1]))
            before = width[-1] + 3  # the offset from the ball's center
            for step, after in enumerate(level.mlp, 1):
                yield f"sa{number}_{step}", rows[-1] * level.samples, before, after, 0
                before = after
            width.append(before)
        below = width[-1]
        for number in range(len(self.levels), 0, -1):
            before = below + width[number - 1]
            for step, after in enumerate(self.levels[number - 1].up, 1):
                yield f"fp{number}_{step}", rows[number - 1], before, after, below
                before = after
            below = before
        for step, after in enumerate(self.head, 1):
            yield f"head_{step}", rows[0], below, after, 0
            below = after

    def shapes(self, inputs: int, classes: int) -> dict[str, tuple[int, int]]:
        """Array name to shape, in the order of the computation.

        A layer with batch normalization is (out, in + 4): the weights, then per output the scale, shift, running
        mean and running variance. The last, ``scores``, is (classes, in + 1): weights, then bias.
        """
        out = {name: (after, before + 4) for name, _, before, after, _ in self._linear(inputs)}
        return {**out, "scores": (classes, self.head[-1] + 1)}

    def memory_mb(self, inputs: int) -> float:
        """Megabytes one batch takes at most where the network is applied, counted from the sizes of its arrays."""
        most = max(
            rows * (before + 2 * after + 3 * below) for _, rows, before, after, below in self._linear(inputs)
        )
        centers, balls = self.points, 0.0
        for level in self.levels:
            centers = min(level.centers, centers)
            balls += centers * level.samples * 8.0
        return (4.0 * most + self.points * 200.0 + balls) / 2**20

    def to_dict(self) -> dict[str, Any]:
        """Plain data; :func:`parse_configuration` reads it."""
        return json.loads(json.dumps(asdict(self)))  # lists for tuples


def parse_configuration(
    given: str | Mapping[str, Any] | Configuration, points: int | None = None
) -> Configuration:
    """A configuration from its name or from data, or an OptionError; `points` of a batch instead of its own.

    A mapping has ``points``, ``levels`` (each ``centers``, ``radius``, ``samples``, ``mlp``, ``up``) and optionally
    ``name``, ``head``, ``dropout``.
    """
    if isinstance(given, str):
        if given not in CONFIGURATIONS:
            raise OptionError(
                "the network configuration is not known",
                found=repr(given)[:60],
                cure=f"{suggest(given, CONFIGURATIONS)}Choose one of {', '.join(CONFIGURATIONS)}",
            )
        made = CONFIGURATIONS[given]
    elif isinstance(given, Configuration):
        made = given
    elif isinstance(given, Mapping):
        made = _from_mapping(given)
    else:
        raise OptionError("a network configuration must be a name or a mapping", found=repr(given)[:60])
    return made if points is None else replace(made, points=points)


def _from_mapping(given: Mapping[str, Any]) -> Configuration:
    known = {field.name for field in fields(Configuration)}
    _only(given, known, {"points", "levels"}, "a network configuration")
    if not isinstance(given["levels"], list | tuple):
        raise OptionError("'levels' must be a list", found=repr(given["levels"])[:60])
    levels = []
    keys = {field.name for field in fields(Level)}
    for level in given["levels"][:9]:
        if not isinstance(level, Mapping):
            raise OptionError("a level must be a mapping", found=repr(level)[:60])
        _only(level, keys, keys, "a level")
        levels.append(Level(**level))
    return Configuration(**{"name": "own", **given, "levels": tuple(levels)})


def _only(given: Mapping[str, Any], known: set[str], needed: set[str], what: str) -> None:
    odd = [str(key) for key in given if key not in known]
    if odd:
        raise OptionError(f"{what} has no '{odd[0][:40]}'", cure=suggest(odd[0], known) or None)
    lost = sorted(needed - set(given))
    if lost:
        raise OptionError(f"{what} needs '{lost[0]}'")


def _widths(name: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= 8:
        raise OptionError(f"'{name}' must be a list of 1 to 8 widths", found=repr(value)[:60])
    return tuple(checks.whole(f"'{name}'", width, 1, 4096) for width in value)


#: The named ones. ``alsnet4`` and ``alsnet3`` are those of [WM19]'s program; the others are ours, for CPUs.
CONFIGURATIONS = {
    name: Configuration(name, points, tuple(Level(*row) for row in levels), head)
    for name, points, head, levels in (
        (
            "alsnet4", 200_000, (128,), (
                (8192, 1.0, 16, (64, 128, 128), (128, 64)),
                (4096, 2.0, 16, (128, 256, 256), (256, 256)),
                (2048, 5.0, 16, (128, 256, 256), (256, 256)),
                (512, 15.0, 32, (128, 512, 256), (256, 256)),
            ),
        ),
        (
            "alsnet3", 200_000, (128,), (
                (16384, 1.0, 32, (128, 128, 128), (128, 128)),
                (8192, 5.0, 64, (128, 128, 256), (256, 256)),
                (4096, 15.0, 64, (128, 128, 256), (256, 256)),
            ),
        ),
        (
            "small", 16_384, (64,), (
                (2048, 1.0, 16, (32, 32, 64), (64, 64)),
                (512, 2.5, 16, (64, 64, 128), (128, 64)),
                (128, 6.0, 16, (128, 128, 256), (128, 128)),
            ),
        ),
        ("tiny", 2048, (32,), ((256, 1.5, 8, (16, 16, 32), (32, 32)), (64, 4.0, 8, (32, 32, 64), (32, 32)))),
    )
}  # fmt: skip


@dataclass(frozen=True)
class NetworkOptions:
    """How a network is trained; docs/alsnet.md says more of each."""

    configuration: Any = "small"  #: the name of one of :data:`CONFIGURATIONS`, or one of your own
    points: int | None = None  #: of a batch, instead of the configuration's
    spacing: float | None = None  #: of the batches' grid in meters; None: for four batches a point
    coordinates: str = "Z"  #: of X, Y and Z from the batch's center, which are inputs: "Z", "XYZ" or ""
    epochs: int = 60  #: at most; each sees every chosen batch once
    batches_per_step: int = 2  #: batches whose gradients make one step
    learning_rate: float = 0.002  #: at the start; it falls to 1 % of that along a cosine
    #: weight of a class in the loss: 1 / sqrt(share), 1 ("none") [WM19], or 1 / share ("balanced")
    class_weights: str = "sqrt"
    #: batches whose class shares have a standard deviation of this or more (per cent) are not trained on: they hold next
    #: to nothing but one class [WM19: 20 %]; 100: all are used
    histogram_threshold: float = 20.0
    rotate: bool = True  #: turn each batch about its center by a random angle
    shift: float = 0.5  #: move batch centers by up to this share of the spacing, anew in each epoch
    jitter: float = 0.01  #: standard deviation of noise on coordinates, meters; cut at three times that
    thin: float = 0.4  #: most points a batch may lose; the share is drawn anew for each
    #: share of the ground held out, in whole blocks, to choose the best epoch; 0: none
    validation: float = 0.2
    block_size: float = 25.0  #: side of those blocks, meters
    #: epochs without a better mean F1 on the held out blocks after which training ends; 0: never
    patience: int = 20
    #: file written after every epoch; where it exists, training goes on from it
    checkpoint: str | None = None
    #: model file whose weights training starts from; classes it shares keep theirs, others start afresh
    start_from: str | None = None
    device: str = "auto"  #: or "cpu", "cuda"

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
        checks.one_of("'class_weights'", self.class_weights, ("none", "sqrt", "balanced"))
        checks.one_of("'device'", self.device, ("auto", "cpu", "cuda"))
        checks.one_of("'coordinates'", self.coordinates, ("", "Z", "XYZ"))
        for name in ("checkpoint", "start_from"):
            if getattr(self, name) is not None and not isinstance(getattr(self, name), str):
                raise OptionError(f"'{name}' must be a file name", found=repr(getattr(self, name)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkOptions:
        """Options by name; an unknown name is an error."""
        if not isinstance(values, Mapping):
            raise OptionError("'alsnet' must be a mapping of options", found=repr(values)[:60])
        known = [f.name for f in fields(cls)]
        for name in values:
            if name not in known:
                raise OptionError(
                    f"unknown alsNet option '{name}'",
                    cure=f"{suggest(str(name), known)}Options: {', '.join(known)}",
                )
        return cls(**values)
