"""Network configurations and training options as data: in model files and options.

A configuration lists the levels of set abstraction [WM19; Qi et al. 2017, PointNet++]: how many
centers are sampled, the radius of the ball around each, how many points are taken from it, the
widths of the shared perceptron that describes the ball, and the widths of the one that carries
features back up to the level above.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from typing import Any

from ..base import checks
from ..base.checks import Settings, setting
from ..base.errors import OptionError, suggest

#: A configuration's largest number of layers, each an array; a model file may hold 95 arrays.
MAX_LAYERS = 60


def _widths(what: str, value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= 8:
        raise OptionError(f"{what} must be a list of 1 to 8 widths", found=repr(value)[:60])
    return tuple(checks.whole(what, width, 1, 4096) for width in value)


@dataclass(frozen=True)
class Level(Settings):
    """One level of set abstraction and the feature propagation back from it."""

    centers: int = setting(MISSING, "integer", "Points kept by farthest point sampling", 1, 10**7)
    radius: float = setting(
        MISSING, "number", "Radius of the ball around each center, meters", 1e-3, 1e4
    )
    samples: int = setting(MISSING, "integer", "Points taken from a ball", 1, 1024)
    mlp: tuple[int, ...] = setting(
        MISSING, "numbers", "Layer widths before max pooling", check=_widths
    )
    up: tuple[int, ...] = setting(
        MISSING, "numbers", "Layer widths after interpolation", check=_widths
    )


@dataclass(frozen=True)
class Configuration(Settings):
    """A whole network, but for the number of inputs and classes."""

    name: str
    points: int = setting(
        MISSING, "integer", "Points of a batch: the nearest around a grid point", 16, 10**7
    )
    levels: tuple[Level, ...] = ()
    head: tuple[int, ...] = setting((128,), "numbers", "Layer widths before dropout", check=_widths)
    dropout: float = setting(
        0.5, "number", "Share of the head's outputs left out in training", 0.0, 0.95
    )

    def __post_init__(self) -> None:
        """Check what cannot be declared."""
        super().__post_init__()
        if not isinstance(self.name, str) or not 1 <= len(self.name) <= 60:
            raise OptionError("a configuration's name must be text", found=repr(self.name)[:60])
        if not 1 <= len(self.levels) <= 8:
            raise OptionError("a network must have 1 to 8 levels", found=len(self.levels))
        if (layers := len(self.shapes(1, 1))) > MAX_LAYERS:
            raise OptionError(f"a network may have {MAX_LAYERS} layers", found=layers)

    def _linear(self, inputs: int) -> Iterator[tuple[str, int, int, int, int]]:
        """Yield name, rows, inputs, outputs and depth below of every layer but the last.

        They come in the order of the computation.
        """
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
        """Return the shape of each array by its name, in the order of the computation.

        A layer with batch normalization is (out, in + 4): the weights, then per output the scale,
        shift, running mean and running variance. The last, ``scores``, is (classes, in + 1):
        weights, then bias.
        """
        out = {name: (after, before + 4) for name, _, before, after, _ in self._linear(inputs)}
        return {**out, "scores": (classes, self.head[-1] + 1)}

    def memory_mb(self, inputs: int) -> float:
        """Return the megabytes that one batch takes at most where the network is applied.

        Counted from the sizes of its arrays.
        """
        most = max(
            rows * (before + 2 * after + 3 * below)
            for _, rows, before, after, below in self._linear(inputs)
        )
        centers, balls = self.points, 0.0
        for level in self.levels:
            centers = min(level.centers, centers)
            balls += centers * level.samples * 8.0
        return (4.0 * most + self.points * 200.0 + balls) / 2**20

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; :func:`parse_configuration` reads it."""
        return json.loads(json.dumps(asdict(self)))  # lists for tuples


def parse_configuration(
    source: str | Mapping[str, Any] | Configuration, points: int | None = None
) -> Configuration:
    """Return a configuration by its name or from data; OptionError for others.

    `points` of a batch replace its own.

    A mapping has ``points``, ``levels`` (each ``centers``, ``radius``, ``samples``, ``mlp``,
    ``up``) and optionally ``name``, ``head``, ``dropout``.
    """
    if isinstance(source, str):
        if source not in CONFIGURATIONS:
            raise OptionError(
                "the network configuration is not known",
                found=repr(source)[:60],
                cure=f"{suggest(source, CONFIGURATIONS)}Choose one of {', '.join(CONFIGURATIONS)}",
            )
        configuration = CONFIGURATIONS[source]
    elif isinstance(source, Configuration):
        configuration = source
    elif isinstance(source, Mapping):
        configuration = _from_mapping(source)
    else:
        raise OptionError("a configuration must be a name or a mapping", found=repr(source)[:60])
    return configuration if points is None else replace(configuration, points=points)


def _from_mapping(source: Mapping[str, Any]) -> Configuration:
    _only(source, Configuration, "a network configuration", ("points", "levels"))
    if not isinstance(source["levels"], list | tuple):
        raise OptionError("'levels' must be a list", found=repr(source["levels"])[:60])
    levels = []
    for level in source["levels"][:9]:
        _only(level, Level, "a level", [each.name for each in fields(Level)])
        levels.append(Level(**level))
    return Configuration(**{"name": "own", **source, "levels": tuple(levels)})


def _only(source: Any, kind: type, what: str, needed: Sequence[str] = ()) -> None:
    """Raise an OptionError for what is not a mapping of a dataclass's fields."""
    if not isinstance(source, Mapping):
        raise OptionError(f"{what} must be a mapping", found=repr(source)[:60])
    known = [each.name for each in fields(kind)]
    for name in source:
        if name not in known:
            raise OptionError(
                f"{what} has no '{str(name)[:40]}'",
                cure=f"{suggest(str(name), known)}It may have: {', '.join(known)}",
            )
    for name in needed:
        if name not in source:
            raise OptionError(f"{what} needs '{name}'")


#: The named ones. ``alsnet4`` and ``alsnet3`` are those of [WM19]'s program; the others are ours,
#: for CPUs.
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
        (
            "tiny", 2048, (32,), (
                (256, 1.5, 8, (16, 16, 32), (32, 32)),
                (64, 4.0, 8, (32, 32, 64), (32, 32)),
            ),
        ),
    )
}  # fmt: skip


def _file(what: str, value: Any) -> str:
    if not isinstance(value, str):
        raise OptionError(f"{what} must be a file name", found=repr(value))
    return value


@dataclass(frozen=True)
class NetworkOptions(Settings):
    """Options of training a network; docs/alsnet.md says more of each."""

    configuration: Any = "small"  #: the name of one of :data:`CONFIGURATIONS`, or one of your own
    points: int | None = None  #: of a batch, instead of the configuration's
    spacing: float | None = setting(
        None, "number", "Spacing of batches, m; default: four a point", 0.01, 1e5
    )
    coordinates: str = setting(
        "Z", "string", "Coordinates used as inputs", choices=("", "Z", "XYZ")
    )
    epochs: int = setting(
        60, "integer", "Maximum number of epochs; each sees every chosen batch", 1, 100_000
    )
    batches_per_step: int = setting(2, "integer", "Batches per optimizer step", 1, 1024)
    learning_rate: float = setting(
        0.002, "number", "Initial learning rate; falls to 1 % of it", 1e-8, 10.0
    )
    #: 1 (none) [WM19], 1 / sqrt(share) or 1 / share (balanced)
    class_weights: str = setting(
        "sqrt", "string", "Class weights in the loss", choices=("none", "sqrt", "balanced")
    )
    #: batches above it are nearly all of one class and not trained on [WM19: 20 %]; 100: all are
    histogram_threshold: float = setting(
        20.0, "number", "Maximum spread of class shares, %", 0.0, 100.0
    )
    augment: bool = setting(
        True, "boolean", "Rotate, shift, jitter and thin each batch, anew in each epoch"
    )
    validation: float = setting(
        0.2, "number", "Share of ground held out to choose the epoch", 0.0, 0.5
    )
    block_size: float = setting(25.0, "number", "Side of the blocks held out, meters", 0.1, 1e6)
    patience: int = setting(
        20, "integer", "Maximum epochs without a better mean F1; 0: no limit", 0, 100_000
    )
    checkpoint: str | None = setting(
        None, "filename", "Written each epoch; resumed from", check=_file
    )
    #: classes it shares keep their weights, others start afresh
    start_from: str | None = setting(None, "filename", "Model file to start from", check=_file)
    device: str = setting("auto", "string", "Device to train on", choices=("auto", "cpu", "cuda"))

    def __post_init__(self) -> None:
        """Check all options, and parse the configuration."""
        super().__post_init__()
        object.__setattr__(
            self, "configuration", parse_configuration(self.configuration, self.points)
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkOptions:
        """Return options by name; OptionError for an unknown name."""
        _only(values, cls, "'alsnet'")
        return cls(**values)
