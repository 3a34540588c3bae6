"""The network: PointNet++ as [WM19] uses it, its weights, and NumPy that applies it.

Training and a GPU need PyTorch: :mod:`.torch_network`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from .batches import Pyramid
from .configuration import Configuration

Weights = dict[str, npt.NDArray[np.float32]]

#: Added to the variance in batch normalization.
EPSILON = 1e-5


def initial_weights(configuration: Configuration, inputs: int, classes: int, seed: int) -> Weights:
    """Return untrained weights: He et al. 2015 for linear layers, identity for normalizations."""
    random = np.random.default_rng([seed, 0xA15])
    out: Weights = {}
    for name, (rows, columns) in configuration.shapes(inputs, classes).items():
        array = np.zeros((rows, columns), np.float32)
        width = columns - (1 if name == "scores" else 4)
        gain = 1.0 if name == "scores" else 2.0
        array[:, :width] = random.normal(0.0, math.sqrt(gain / width), (rows, width))
        if name != "scores":
            array[:, width] = 1.0  # scale
            array[:, width + 3] = 1.0  # running variance
        out[name] = array
    return out


def check_weights(
    weights: Mapping[str, npt.NDArray], configuration: Configuration, inputs: int, classes: int
) -> None:
    """Raise a ModelError for arrays that do not fit a configuration.

    That is where one is missing, unknown, of another shape, not finite, or a negative variance.
    """
    shapes = configuration.shapes(inputs, classes)
    if odd := sorted(set(weights) ^ set(shapes)):
        raise ModelError("the arrays are not those of its configuration", found=repr(odd[0])[:60])
    for name, shape in shapes.items():
        array = weights[name]
        if array.shape != shape:
            raise ModelError(f"the array '{name}' must be {shape}", found=f"shape {array.shape}")
        if not np.isfinite(array).all() or (name != "scores" and array[:, -1].min() < 0.0):
            raise ModelError(f"the array '{name}' must be finite, with variances of 0 or more")


def forward(
    configuration: Configuration,
    pyramid: Any,
    layer: Callable,
    take: Callable,
    join: Callable,
    highest: Callable,
) -> Any:
    """Return what enters the last layer, (n, width) [WM19 2.6; Qi et al. 2017b].

    Set abstraction samples, groups and describes points level by level; feature propagation
    interpolates back.

    `pyramid` holds arrays of NumPy or tensors of PyTorch; the functions are those of the one or the
    other: a named layer, rows by number, columns side by side, the maximum over the middle axis.
    """

    def shared(prefix: str, values: Any, widths: tuple[int, ...]) -> Any:
        for step in range(1, len(widths) + 1):
            values = layer(f"{prefix}_{step}", values)
        return values

    levels, features = configuration.levels, [pyramid.inputs]
    for number, (level, step) in enumerate(zip(levels, pyramid.steps, strict=True), 1):
        m, samples = step.groups.shape
        rows = join([step.offsets.reshape(-1, 3), take(features[-1], step.groups.reshape(-1))])
        described = shared(f"sa{number}", rows, level.mlp)
        features.append(highest(described.reshape(m, samples, -1)))
    below = features[-1]
    for number in range(len(levels), 0, -1):
        step = pyramid.steps[number - 1]
        carried = sum(
            take(below, step.nearest[:, k]) * step.weights[:, k : k + 1] for k in range(3)
        )
        below = shared(f"fp{number}", join([carried, features[number - 1]]), levels[number - 1].up)
    return shared("head", below, configuration.head)


class NumpyNetwork:
    """A network to apply with NumPy; its weights are those that :func:`check_weights` accepts.

    Batch normalization is folded into the linear layers.
    """

    def __init__(
        self, weights: Mapping[str, npt.NDArray[np.float32]], configuration: Configuration
    ) -> None:
        self.configuration = configuration
        self._layers: dict[str, tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]] = {}
        for name, array in weights.items():
            if name == "scores":
                self._layers[name] = (np.ascontiguousarray(array[:, :-1].T), array[:, -1].copy())
                continue
            scale, shift, mean, variance = array[:, -4:].astype(np.float64).T
            factor = scale / np.sqrt(variance + EPSILON)
            matrix = (array[:, :-4] * factor[:, None]).astype(np.float32)
            self._layers[name] = (
                np.ascontiguousarray(matrix.T),
                (shift - mean * factor).astype(np.float32),
            )

    def _layer(self, name: str, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        matrix, bias = self._layers[name]
        values = values @ matrix
        values += bias
        return np.maximum(values, 0.0, out=values)

    def __call__(self, pyramid: Pyramid) -> npt.NDArray[np.float64]:
        """Return the class probabilities of a batch's points, (n, classes) float64."""
        with np.errstate(all="ignore"):  # scores that are not finite are an error in the end
            below = forward(
                self.configuration,
                pyramid,
                self._layer,
                lambda values, rows: values[rows],
                lambda parts: np.concatenate(parts, axis=1),
                lambda values: values.max(axis=1),
            )
            matrix, bias = self._layers["scores"]
            scores = (below @ matrix + bias).astype(np.float64)
            scores -= scores.max(axis=1, keepdims=True)
            np.exp(scores, out=scores)
            scores /= scores.sum(axis=1, keepdims=True)
        if not np.isfinite(scores).all():
            raise ModelError(
                "the network gave probabilities that are not numbers",
                cure="Its weights or the points' dimensions are out of all proportion; train the "
                "model again",
            )
        return scores
