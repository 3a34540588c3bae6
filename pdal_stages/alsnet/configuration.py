"""Network configurations as data: what a model file stores and an option names.

A configuration lists the levels of set abstraction [WM19; Qi et al. 2017, PointNet++]: how many centers are
sampled, the radius of the ball around each, how many points are taken from it, the widths of the shared
perceptron that describes the ball, and the widths of the one that carries features back up to the level above.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
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
        if self.layers > MAX_LAYERS:
            raise OptionError(f"a network may have {MAX_LAYERS} layers", found=self.layers)

    @property
    def layers(self) -> int:
        """Number of linear layers."""
        return sum(len(level.mlp) + len(level.up) for level in self.levels) + len(self.head) + 1

    def shapes(self, inputs: int, classes: int) -> dict[str, tuple[int, int]]:
        """Array name to shape, in the order of the computation.

        A layer with batch normalization is (out, in + 4): the weights, then per output the scale, shift, running
        mean and running variance. The last, ``scores``, is (classes, in + 1): weights, then bias.
        """
        out: dict[str, tuple[int, int]] = {}
        width = [inputs]
        for number, level in enumerate(self.levels, 1):
            before = width[-1] + 3  # the offset from the ball's center
            for step, after in enumerate(level.mlp, 1):
                out[f"sa{number}_{step}"] = (after, before + 4)
                before = after
            width.append(before)
        below = width[-1]
        for number in range(len(self.levels), 0, -1):
            before = below + width[number - 1]
            for step, after in enumerate(self.levels[number - 1].up, 1):
                out[f"fp{number}_{step}"] = (after, before + 4)
                before = after
            below = before
        for step, after in enumerate(self.head, 1):
            out[f"head_{step}"] = (after, below + 4)
            below = after
        out["scores"] = (classes, below + 1)
        return out

    def memory_mb(self, inputs: int, training: bool = False) -> float:
        """Megabytes one batch takes at most, beside the cloud; in training every layer's output is kept.

        Counted from the sizes of the arrays; measured figures are in the documentation.
        """
        most = kept = 0.0
        rows_above, width = self.points, [inputs]
        count = [self.points]
        for level in self.levels:
            rows = min(level.centers, rows_above) * level.samples
            before = width[-1] + 3
            for after in level.mlp:
                most = max(most, rows * (before + 2 * after))
                kept += rows * after * 3.0
                before = after
            width.append(before)
            rows_above = min(level.centers, rows_above)
            count.append(rows_above)
        below = width[-1]
        for number in range(len(self.levels), 0, -1):
            rows, before = count[number - 1], below + width[number - 1]
            for after in self.levels[number - 1].up:
                most = max(most, rows * (before + 2 * after + 3 * below))
                kept += rows * (after * 3.0 + before)
                before = after
            below = before
        for after in self.head:
            most = max(most, count[0] * (below + 2 * after))
            kept += count[0] * after * 3.0
            below = after
        geometry = self.points * 200.0 + sum(
            c * level.samples * 8.0 for c, level in zip(count[1:], self.levels, strict=True)
        )
        return (4.0 * (kept if training else most) + geometry) / 2**20

    def to_dict(self) -> dict[str, Any]:
        """Plain data; :func:`parse_configuration` reads it."""
        return json.loads(json.dumps(asdict(self)))  # lists for tuples


def parse_configuration(
    given: str | Mapping[str, Any] | Configuration, points: int | None = None
) -> Configuration:
    """A configuration from its name or from data.

    Parameters
    ----------
    given : str, mapping or Configuration
        A name of :data:`CONFIGURATIONS`, or a mapping with ``points``, ``levels`` (each ``centers``, ``radius``,
        ``samples``, ``mlp``, ``up``) and optionally ``name``, ``head``, ``dropout``.
    points : int, optional
        Points of a batch, instead of the configuration's own.

    Raises
    ------
    OptionError
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


def _levels(*rows) -> tuple[Level, ...]:
    return tuple(Level(*row) for row in rows)


#: The named ones. ``alsnet4`` and ``alsnet3`` are those of [WM19]'s program; the others are ours, for CPUs.
CONFIGURATIONS = {
    one.name: one
    for one in (
        Configuration(
            "alsnet4",
            200_000,
            _levels(
                (8192, 1.0, 16, (64, 128, 128), (128, 64)),
                (4096, 2.0, 16, (128, 256, 256), (256, 256)),
                (2048, 5.0, 16, (128, 256, 256), (256, 256)),
                (512, 15.0, 32, (128, 512, 256), (256, 256)),
            ),
        ),
        Configuration(
            "alsnet3",
            200_000,
            _levels(
                (16384, 1.0, 32, (128, 128, 128), (128, 128)),
                (8192, 5.0, 64, (128, 128, 256), (256, 256)),
                (4096, 15.0, 64, (128, 128, 256), (256, 256)),
            ),
        ),
        Configuration(
            "small",
            16_384,
            _levels(
                (2048, 1.0, 16, (32, 32, 64), (64, 64)),
                (512, 2.5, 16, (64, 64, 128), (128, 64)),
                (128, 6.0, 16, (128, 128, 256), (128, 128)),
            ),
            head=(64,),
        ),
        Configuration(
            "tiny",
            2048,
            _levels((256, 1.5, 8, (16, 16, 32), (32, 32)), (64, 4.0, 8, (32, 32, 64), (32, 32))),
            head=(32,),
        ),
    )
}
