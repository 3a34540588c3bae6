"""alsNet as a classifier of a model file: made from arrays, applied to whole clouds [WM19]."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.errors import ModelError, StageError
from ..base.threads import map_blocks, resolve_threads
from ..classifier.input_dimensions import add_return_features, take_dimensions
from ..classifier.interface import ArrayRule, Block, Column, InputPlan, PredictRequest
from .batches import Batches, halo_m
from .configuration import Configuration, parse_configuration
from .network import NumpyNetwork, Weights, check_weights
from .sampling_and_grouping import Pyramid, build_pyramid, random_order
from .training_batches import augment

#: A network whose batch would need more megabytes is not loaded; the published ones need a few
#: thousand.
MOST_MB = 32_768
#: Meters that become 1 where X, Y or Z is an input.
METERS = 10.0


@dataclass(frozen=True, eq=False)
class AlsNet:
    """A trained network."""

    weights: Weights
    configuration: Configuration
    inputs: tuple[str, ...]  #: their names
    mean: tuple[float, ...]  #: an input is (value - mean) / scale
    scale: tuple[float, ...]
    spacing: float  #: of the batches' grid, meters
    n_classes: int

    name: ClassVar[str] = "alsnet"
    features: ClassVar[None] = None
    context: ClassVar[None] = None
    rules: ClassVar[Mapping[str, ArrayRule]] = {
        "sa*": ArrayRule(("<f4",), 2),
        "fp*": ArrayRule(("<f4",), 2),
        "head_*": ArrayRule(("<f4",), 2),
        "scores": ArrayRule(("<f4",), 2),
    }

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> AlsNet:
        """Return the network that a pass of a manifest describes; ModelError for contradictions."""
        names, parameters = entry["feature_names"], entry["parameters"]
        n_features, n_classes = len(names), len(codes)
        inputs = parameters.get("inputs")
        listed = isinstance(inputs, list) and all(isinstance(each, Mapping) for each in inputs)
        if set(parameters) != {"configuration", "spacing", "inputs", "weights"} or not listed:
            raise ModelError(
                "the network's parameters are not right", found=sorted(map(str, parameters))[:6]
            )
        configuration = parse_configuration(parameters["configuration"])
        spacing = checks.number("the network's spacing", parameters["spacing"], 1e-3, 1e6)
        input_names = [each.get("name") for each in inputs]
        if input_names != names or names != entry["dimensions"] or entry["context"]:
            raise ModelError(
                "the network's inputs are not the model's dimensions", found=repr(names)[:80]
            )
        means = [each.get("mean") for each in inputs]
        scales = [each.get("scale") for each in inputs]
        mean = tuple(checks.number("an input's mean", value, -1e12, 1e12) for value in means)
        scale = tuple(checks.number("an input's scale", value, 1e-12, 1e12) for value in scales)
        needed = configuration.memory_mb(n_features)
        if needed > MOST_MB:
            raise ModelError(
                "a batch of the network would need too much memory", found=f"{needed:,.0f} MB"
            )
        check_weights(arrays, configuration, n_features, n_classes)
        return cls(dict(arrays), configuration, tuple(names), mean, scale, spacing, n_classes)

    def arrays(self) -> Weights:
        """Return the weights, which a model file stores."""
        return dict(self.weights)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """Return what a manifest says of it beside its arrays."""
        return {
            "parameters": {
                "configuration": self.configuration.to_dict(),
                "spacing": self.spacing,
                "inputs": [
                    {"name": name, "mean": mean, "scale": scale}
                    for name, mean, scale in zip(self.inputs, self.mean, self.scale, strict=True)
                ],
                "weights": int(sum(array.size for array in self.weights.values())),
            },
            "neighborhoods": [],
            "feature_names": list(self.inputs),
            "dimensions": list(self.inputs),
            "context": [],
            "shape_bins": None,
            "copt_threshold": None,
            "feature_seed": 0,
        }

    def columns(self, codes: Sequence[int]) -> list[Column]:
        """Return the inputs."""
        return [Column(name, name, "dimension", "(dimension)") for name in self.inputs]

    @property
    def plan(self) -> InputPlan:
        """Its inputs; X, Y and Z are taken from the batch's center, and batches are cut by area."""
        return InputPlan(self.inputs, self.inputs, halo_m(self.spacing))

    @cached_property
    def network(self) -> NumpyNetwork:
        """The network, ready to apply."""
        return NumpyNetwork(self.weights, self.configuration)

    def predict(self, request: PredictRequest) -> Iterator[Block]:
        """Yield the mean probabilities over all batches a point is in [WM19 3], in one block.

        Batches are computed side by side, as many as fit into the memory, at least one.
        """
        values = take_dimensions(
            self.inputs,
            add_return_features(self.inputs, request.xyz, request.dimensions, request.threads),
            len(request.xyz),
        )
        if request.count:
            averages = self._average(request, values)
            request.report.figures["batches_per_point"] = averages.batches_per_point()
            mean, variance = averages.mean_and_variance()
            rows = np.arange(len(request.xyz)) if request.rows is None else request.rows
            yield Block(rows, mean, variance)

    def _apply_on(self, device: str) -> Callable[[Pyramid], npt.NDArray[np.float64]]:
        """Return the function that applies the network to a batch.

        It runs in NumPy, or in PyTorch where a GPU is asked for.
        """
        if device == "cpu":
            return self.network
        from .torch_network import apply_on_device, resolve_device

        if resolve_device(device) == "cpu":
            return self.network
        return apply_on_device(
            "cuda", self.weights, self.configuration, len(self.inputs), self.n_classes
        )

    def _average(
        self, request: PredictRequest, dimensions: Mapping[str, npt.ArrayLike]
    ) -> _Averages:
        """Return the averages over all batches that hold a wanted point."""
        from threadpoolctl import threadpool_limits

        rows, xyz = request.rows, request.xyz
        columns = normalize_inputs(xyz, dimensions, self.inputs, self.mean, self.scale)
        batches = Batches(xyz, self.configuration.points, self.spacing, columns)
        averages = _Averages(len(xyz), rows, self.n_classes)
        each_mb = self.configuration.memory_mb(len(self.inputs))
        fitting = int(request.memory_mb / each_mb)
        side_by_side = max(1, min(resolve_threads(request.threads), fitting))
        apply = self._apply_on(request.device)  # once, before there are threads

        def classify(number: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
            members, center = batches.members(number), batches.centers[number]
            order, pyramid = make_pyramid(
                xyz, columns, members, center, self.inputs, self.configuration
            )
            return members[order], apply(pyramid)

        numbers = batches.holding(rows).tolist()
        # With BLAS on one thread a result does not depend on how many are computed side by side.
        with threadpool_limits(1):
            for members, p in map_blocks(classify, numbers, side_by_side, ahead=1):
                new = averages.add(members, p)
                if request.progress is not None:
                    request.progress.update(new)
        request.report.figures["batches"] = len(numbers)
        return averages


class _Averages:
    """Sums of probabilities over the batches that each of m wanted points is in."""

    def __init__(self, n: int, rows: npt.NDArray[np.int64] | None, n_classes: int) -> None:
        m = n if rows is None else len(rows)
        self._place = np.full(n, -1)
        self._place[slice(None) if rows is None else rows] = np.arange(m)
        self._sum, self._squares = np.zeros((m, n_classes)), np.zeros(m)
        self._count = np.zeros(m, np.int64)

    def add(self, members: npt.NDArray[np.int64], p: npt.NDArray[np.float64]) -> int:
        """Add the probabilities (k, classes) of a batch; return how many points are new."""
        place = self._place[members]
        wanted = place >= 0
        place, p = place[wanted], p[wanted]
        new = int(np.count_nonzero(self._count[place] == 0))
        self._sum[place] += p
        self._squares[place] += (p * p).sum(axis=1)
        self._count[place] += 1
        return new

    def batches_per_point(self) -> dict[str, float]:
        """Return the mean and the least number of batches that a point is in."""
        if not self._count.all():
            outside = int(np.count_nonzero(self._count == 0))
            raise StageError("a point is in no batch; this is a bug", found=outside)
        return {"mean": round(float(self._count.mean()), 2), "least": int(self._count.min())}

    def mean_and_variance(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return mean probabilities (m, classes), and the variance (m,).

        The variance of a class's probability over the batches, mean over the classes, marks errors
        [WM19 5].
        """
        mean = self._sum / self._count[:, None]
        squares = (mean * mean).sum(axis=1)
        variance = (self._squares / self._count - squares) / mean.shape[1]
        return mean, np.maximum(variance, 0.0)


def normalize_inputs(
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    inputs: Sequence[str],
    mean: Sequence[float],
    scale: Sequence[float],
) -> npt.NDArray[np.float32]:
    """Return the inputs (n, inputs) float32: (value - mean) / scale of each dimension.

    X, Y and Z are 0; they follow from the batch.
    """
    out = np.zeros((len(xyz), len(inputs)), np.float32)
    for k, name in enumerate(inputs):
        if name not in ("X", "Y", "Z"):
            out[:, k] = (np.asarray(dimensions[name], dtype=np.float64) - mean[k]) / scale[k]
    return out


def make_pyramid(
    xyz: npt.NDArray[np.float64],
    columns: npt.NDArray[np.float32],
    members: npt.NDArray[np.int64],
    center: npt.NDArray[np.float64],
    inputs: Sequence[str],
    configuration: Configuration,
    augmentation: np.random.Generator | None = None,
) -> tuple[npt.NDArray[np.int64], Pyramid]:
    """Return the order of a batch's points among `members`, and its pyramid.

    Parameters
    ----------
    members : (k,) int64
        Rows of the cloud in the canonical order.
    center : (2,) float64
        Coordinates are taken from it, heights from the batch's first percentile: near its ground,
        whatever few strays lie below.
    augmentation : Generator, optional
        Rotates, shakes and thins the batch.
    """
    z = xyz[members, 2]
    low = float(np.partition(z, len(z) // 100)[len(z) // 100])
    local = xyz[members] - np.array([center[0], center[1], low])
    kept = None
    if augmentation is not None:
        local, kept = augment(local, augmentation)
    order = random_order(local)
    local = np.ascontiguousarray(local[order])
    if kept is not None:
        order = kept[order]
    values = columns[members[order]]
    for k, name in enumerate(inputs):
        if name in ("X", "Y", "Z"):
            values[:, k] = local[:, "XYZ".index(name)] / METERS
    return order, build_pyramid(local, values, configuration)
