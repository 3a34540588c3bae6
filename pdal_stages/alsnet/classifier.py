"""alsNet as a classifier of a model file: made from arrays, applied to whole clouds [WM19]."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.json_types import JsonObject
from ..base.threads import map_blocks, resolve_threads
from ..classifier.input_dimensions import add_surroundings, take_dimensions
from ..classifier.interface import ArrayRule, Block, InputPlan, PredictRequest
from .batches import Batches, Pyramid, augment, build_pyramid, halo_m, random_order
from .configuration import REACH, Configuration, parse_configuration
from .network import NumpyNetwork, Weights, check_weights

#: A network whose batch would need more megabytes is not loaded; the published ones need a few
#: thousand.
MOST_MB = 32_768
#: Meters that become 1 where X, Y or Z is an input (not tuned). Model files do not hold it, so
#: another number makes networks wrong that were trained before.
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
    reach: float = REACH  #: farthest point of a batch, spacings

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
        cls, entry: JsonObject, arrays: Mapping[str, npt.NDArray], codes: Sequence[int]
    ) -> AlsNet:
        """Return the network that a pass of a manifest describes; ModelError for contradictions."""
        names, parameters = entry["feature_names"], entry["parameters"]
        n_features, n_classes = len(names), len(codes)
        configuration, inputs = (
            parse_configuration(parameters["configuration"]),
            parameters["inputs"],
        )
        if [each["name"] for each in inputs] != names or names != entry["dimensions"]:
            raise ModelError("inputs and dimensions of the network differ", found=repr(names)[:80])
        mean, scale = (tuple(float(each[key]) for each in inputs) for key in ("mean", "scale"))
        needed = configuration.memory_mb(n_features)
        if needed > MOST_MB:
            raise ModelError("a batch would need too much memory", found=f"{needed:,.0f} MB")
        check_weights(arrays, configuration, n_features, n_classes)
        spacing, reach = float(parameters["spacing"]), float(parameters.get("reach", REACH))
        return cls(
            dict(arrays), configuration, tuple(names), mean, scale, spacing, n_classes, reach
        )

    def arrays(self) -> Weights:
        """Return the weights, which a model file stores."""
        return dict(self.weights)

    def to_file(self, codes: Sequence[int]) -> JsonObject:
        """Return what a manifest says of it beside its arrays."""
        return {
            "parameters": {
                "configuration": self.configuration.to_dict(),
                "spacing": self.spacing,
                "reach": self.reach,
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

    @property
    def plan(self) -> InputPlan:
        """Its inputs; X, Y and Z are taken from the batch's center, and batches are cut by area."""
        return InputPlan(self.inputs, self.inputs, halo_m(self.spacing, self.reach))

    @cached_property
    def network(self) -> NumpyNetwork:
        """The network, ready to apply."""
        return NumpyNetwork(self.weights, self.configuration)

    def predict(self, request: PredictRequest) -> Iterator[Block]:
        """Yield the mean probabilities over all batches a point is in [WM19 3], in one block.

        The variance of a class's probability over the batches, mean over the classes, marks errors
        [WM19 5].
        """
        known = add_surroundings(self.inputs, request.xyz, request.dimensions, request.threads)
        values = take_dimensions(self.inputs, known, len(request.xyz))
        if not request.count:
            return
        n, m = len(request.xyz), request.count
        rows = np.arange(n) if request.rows is None else request.rows
        place = np.full(n, -1)
        place[rows] = np.arange(m)
        total, squares = np.zeros((m, self.n_classes)), np.zeros(m)
        count = np.zeros(m, np.int64)
        for members, p in self._apply(request, values):
            at, p = place[members], p[place[members] >= 0]
            at = at[at >= 0]
            if request.progress is not None:
                request.progress.update(int(np.count_nonzero(count[at] == 0)))
            total[at] += p
            squares[at] += (p * p).sum(axis=1)
            count[at] += 1
        batches = {"mean": round(float(count.mean()), 2), "least": int(count.min())}
        request.report.figures["batches_per_point"] = batches
        mean = total / count[:, None]
        variance = (squares / count - (mean * mean).sum(axis=1)) / self.n_classes
        yield Block(rows, mean, np.maximum(variance, 0.0))

    def batches(
        self, xyz: npt.NDArray[np.float64]
    ) -> Iterator[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]]:
        """Yield the center (2,) and the rows (k,) of each batch of points (n, 3), in meters."""
        batches = Batches(xyz, self.configuration.points, self.spacing, reach=self.reach)
        for number, center in enumerate(batches.centers):
            yield center, batches.members(number)

    def _apply_on(self, device: str) -> Callable[[Pyramid], npt.NDArray[np.float64]]:
        """Return the function that applies the network to a batch, with NumPy or PyTorch."""
        if device == "cpu":
            return self.network
        from .torch_network import apply_on_device, resolve_device

        if resolve_device(device) == "cpu":
            return self.network
        return apply_on_device(
            "cuda", self.weights, self.configuration, len(self.inputs), self.n_classes
        )

    def _apply(
        self, request: PredictRequest, dimensions: Mapping[str, npt.ArrayLike]
    ) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
        """Yield the rows (k,) and probabilities (k, classes) of batches that hold wanted points.

        Batches are computed side by side, as many as fit into the memory, at least one.
        """
        from threadpoolctl import threadpool_limits

        xyz = request.xyz
        columns = normalize_inputs(xyz, dimensions, self.inputs, self.mean, self.scale)
        batches = Batches(xyz, self.configuration.points, self.spacing, columns, self.reach)
        fitting = int(request.memory_mb / self.configuration.memory_mb(len(self.inputs)))
        side_by_side = max(1, min(resolve_threads(request.threads), fitting))
        apply = self._apply_on(request.device)  # once, before there are threads

        def classify(number: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
            members, center = batches.members(number), batches.centers[number]
            order, pyramid = make_pyramid(
                xyz, columns, members, center, self.inputs, self.configuration
            )
            return members[order], apply(pyramid)

        numbers = batches.holding(request.rows).tolist()
        request.report.figures["batches"] = len(numbers)
        # With BLAS on one thread a result does not depend on how many are computed side by side.
        with threadpool_limits(1):
            yield from map_blocks(classify, numbers, side_by_side, ahead=1)


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
