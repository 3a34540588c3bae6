"""Network configurations and training options as data: in model files and options.

A configuration lists the levels of set abstraction [WM19; Qi et al. 2017, PointNet++]: how many
centers are sampled, the radius of the ball around each, how many points are taken from it, the
widths of the shared perceptron that describes the ball, and the widths of the one that carries
features back up to the level above. The named ones are in networks.json: ``alsnet4`` and
``alsnet3`` are those of [WM19]'s program, the others are ours, for CPUs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from importlib import resources
from typing import Any

from ..base import checks
from ..base.errors import OptionError
from ..base.json_types import JsonObject
from ..base.options import Settings, setting

#: Farthest point a batch takes by default, in spacings. A batch of full size in even density has
#: 1.13, in the corner of a cloud 2.26.
REACH = 1.5
_FILE = json.loads(resources.files(__package__).joinpath("networks.json").read_text("utf-8"))


@dataclass(frozen=True)
class Level:
    """One level of set abstraction and the feature propagation back from it.

    What each value means is in the schema of networks.json.
    """

    centers: int
    radius: float
    samples: int
    mlp: tuple[int, ...]
    up: tuple[int, ...]


@dataclass(frozen=True)
class Configuration:
    """A whole network, but for the number of inputs and classes."""

    name: str
    points: int
    levels: tuple[Level, ...]
    head: tuple[int, ...] = (128,)
    dropout: float = 0.5

    def _linear(self, inputs: int) -> Iterator[tuple[str, int, int, int, int]]:
        """Yield name, rows, inputs, outputs and depth below of all but the last layer, in order."""
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
        """Return the megabytes of the arrays that one batch takes at most in prediction."""
        most = max(
            rows * (before + 2 * after + 3 * below)
            for _, rows, before, after, below in self._linear(inputs)
        )
        centers, balls = self.points, 0.0
        for level in self.levels:
            centers = min(level.centers, centers)
            balls += centers * level.samples * 8.0
        return (4.0 * most + self.points * 200.0 + balls) / 2**20

    def to_dict(self) -> JsonObject:
        """Return plain data; :func:`parse_configuration` reads it."""
        return json.loads(json.dumps(asdict(self)))  # lists for tuples


def parse_configuration(source: Any) -> Configuration:
    """Return a configuration by its name or from data; OptionError for others.

    A mapping has ``points``, ``levels`` (each ``centers``, ``radius``, ``samples``, ``mlp``,
    ``up``) and optionally ``name``, ``head``, ``dropout``.
    """
    if isinstance(source, Configuration):
        return source
    if isinstance(source, str):
        checks.one_of("'configuration'", source, _FILE["networks"])
        source = {"name": source, **_FILE["networks"][source]}
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import best_match

    if error := best_match(Draft202012Validator(_FILE["schema"]).iter_errors(source)):
        where = "".join(f"[{part!r}]" for part in error.path)
        raise OptionError(f"the network's configuration{where}: {error.message[:200]}")
    levels = [
        Level(**{**level, "mlp": tuple(level["mlp"]), "up": tuple(level["up"])})
        for level in source["levels"]
    ]
    head = tuple(source.get("head", Configuration.head))
    return Configuration(**{"name": "own", **source, "levels": tuple(levels), "head": head})


@dataclass(frozen=True)
class NetworkOptions(Settings):
    """Options of training a network; docs/alsnet.md says more of each."""

    configuration: Any = "small"  #: a name of networks.json, or one of your own
    spacing: float | None = setting(
        None, "number", "Spacing of batches, m; default: four a point", 0.01, 1e5
    )
    #: batches are the nearest points up to here; 4 holds a full one in a corner of an even cloud
    reach: float = setting(
        REACH, "number", "Farthest point of a batch, in spacings of the grid", 1.0, 20.0
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
    #: classes it shares keep their weights, others start afresh
    start_from: str | None = setting(None, "filename", "Model file to start from")
    device: str = setting("auto", "string", "Device to train on", choices=("auto", "cpu", "cuda"))

    def __post_init__(self) -> None:
        """Check all options, and parse the configuration."""
        super().__post_init__()
        object.__setattr__(self, "configuration", parse_configuration(self.configuration))

    @classmethod
    def from_dict(cls, values: JsonObject) -> NetworkOptions:
        """Return options by name; OptionError for an unknown name."""
        if not isinstance(values, Mapping):
            raise OptionError("'alsnet' must be a mapping of options", found=repr(values)[:60])
        for name in values:
            checks.one_of("an option in 'alsnet'", name, [each.name for each in fields(cls)])
        return cls(**values)
