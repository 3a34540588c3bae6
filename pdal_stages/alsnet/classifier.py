"""alsNet as a classifier of a model file: made from arrays, applied to whole clouds."""

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
from .batches import Circles, halo_m
from .configuration import Configuration, parse_configuration
from .network import Folded, Weights, check
from .sampling_and_grouping import Pyramid, build, scramble

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
        """Made from what a model file says of a pass, everything checked."""
        names, parameters = entry["feature_names"], entry["parameters"]
        n_features, n_classes = len(names), len(codes)
        wanted, entries = (
            {"configuration", "spacing", "inputs", "weights"},
            parameters.get("inputs"),
        )
        listed = isinstance(entries, list) and all(isinstance(one, Mapping) for one in entries)
        if set(parameters) != wanted or not listed:
            raise ModelError(
                "the network's parameters are not right", found=sorted(map(str, parameters))[:6]
            )
        configuration = parse_configuration(parameters["configuration"])
        spacing = checks.number("the network's spacing", parameters["spacing"], 1e-3, 1e6)
        if (
            [one.get("name") for one in entries] != names
            or names != entry["dimensions"]
            or entry["context"]
        ):
            raise ModelError(
                "the network's inputs are not the model's dimensions", found=repr(names)[:80]
            )
        mean = tuple(
            checks.number("an input's mean", one.get("mean"), -1e12, 1e12) for one in entries
        )
        scale = tuple(
            checks.number("an input's scale", one.get("scale"), 1e-12, 1e12) for one in entries
        )
        needed = configuration.memory_mb(n_features)
        if needed > MOST_MB:
            raise ModelError(
                "a batch of the network would need too much memory", found=f"{needed:,.0f} MB"
            )
        check(arrays, configuration, n_features, n_classes)
        return cls(dict(arrays), configuration, tuple(names), mean, scale, spacing, n_classes)

    def arrays(self) -> Weights:
        """What the file stores."""
        return dict(self.weights)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays; nothing is fitted but the weights."""
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
        """The inputs."""
        return [Column(name, name, "dimension", "(dimension)") for name in self.inputs]

    @property
    def plan(self) -> InputPlan:
        """Its inputs; X, Y and Z are taken from the batch's center, and batches are cut by area."""
        return InputPlan(self.inputs, self.inputs, halo_m(self.spacing))

    @cached_property
    def folded(self) -> Folded:
        """The network, ready to apply."""
        return Folded(self.weights, self.configuration)

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
            mean, variance, counts = self._means(request, values)
            request.report.figures.update(counts)
            rows = np.arange(len(request.xyz)) if request.rows is None else request.rows
            yield Block(rows, mean, variance)

    def _apply_on(self, device: str) -> Callable[[Pyramid], npt.NDArray[np.float64]]:
        """Return what gives a batch's probabilities: NumPy, or PyTorch where a GPU is asked for."""
        if device == "cpu":
            return self.folded
        from .torch_network import applied_on, chosen_device

        if chosen_device(device) == "cpu":
            return self.folded
        return applied_on(
            "cuda", self.weights, self.configuration, len(self.inputs), self.n_classes
        )

    def _means(
        self, request: PredictRequest, dimensions: Mapping[str, npt.ArrayLike]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], dict[str, Any]]:
        """Return the mean probabilities over the batches, their variance, and counts.

        The variance (n,) of a class's probability over the batches, mean over the classes, marks
        errors [WM19 5].
        """
        from threadpoolctl import threadpool_limits

        rows, progress = request.rows, request.progress
        xyz = request.xyz
        columns = scaled(xyz, dimensions, self.inputs, self.mean, self.scale)
        circles = Circles(xyz, self.configuration.points, self.spacing, columns)
        numbers = circles.needed(rows)
        m = request.count
        place = np.full(len(xyz), -1)
        place[slice(None) if rows is None else rows] = np.arange(m)
        total, squares = np.zeros((m, self.n_classes)), np.zeros(m)
        count = np.zeros(m, np.int64)
        each = self.configuration.memory_mb(len(self.inputs))
        side_by_side = max(1, min(resolve_threads(request.threads), int(request.memory_mb / each)))
        apply = self._apply_on(request.device)  # once, before there are threads

        def one(number: int):
            members = circles.members(number)
            order, pyramid = make_pyramid(
                xyz, columns, members, circles.centers[number], self.inputs, self.configuration
            )
            return members[order], apply(pyramid)

        seen = 0
        # BLAS on one thread: a batch's result then does not depend on how many are computed side by
        # side.
        with threadpool_limits(1):
            for members, p in map_blocks(one, numbers.tolist(), side_by_side, ahead=1):
                at = place[members]
                mine = at >= 0
                at, p = at[mine], p[mine]
                new = int(np.count_nonzero(count[at] == 0))
                total[at] += p
                squares[at] += (p * p).sum(axis=1)
                count[at] += 1
                seen += new
                if progress is not None:
                    progress.update(new)
        if not count.all():
            raise StageError(
                "a point is in no batch; this is a bug", found=int(np.count_nonzero(count == 0))
            )
        counted = {
            "batches": len(numbers),
            "batches_per_point": {"mean": round(float(count.mean()), 2), "least": int(count.min())},
        }
        mean = total / count[:, None]
        variance = (squares / count - (mean * mean).sum(axis=1)) / self.n_classes
        return mean, np.maximum(variance, 0.0), counted


def scaled(
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    inputs: Sequence[str],
    mean: Sequence[float],
    scale: Sequence[float],
) -> npt.NDArray[np.float32]:
    """(n, inputs) float32: (value - mean) / scale of each dimension, 0 where X, Y and Z come
    later."""
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
    change: Any = None,
) -> tuple[npt.NDArray[np.int64], Pyramid]:
    """A batch's pyramid, and the order of its points among `members`.

    Parameters
    ----------
    members : (k,) int64
        Rows of the cloud in the canonical order.
    center : (2,) float64
        Coordinates are taken from it, heights from the batch's first percentile: near its ground,
        whatever few strays lie below.
    change : function, optional
        Augmentation: from coordinates (k, 3) to (coordinates, rows kept).
    """
    z = xyz[members, 2]
    low = float(np.partition(z, len(z) // 100)[len(z) // 100])
    local = xyz[members] - np.array([center[0], center[1], low])
    kept = None
    if change is not None:
        local, kept = change(local)
    order = scramble(local)
    local = np.ascontiguousarray(local[order])
    if kept is not None:
        order = kept[order]
    values = columns[members[order]]
    for k, name in enumerate(inputs):
        if name in ("X", "Y", "Z"):
            values[:, k] = local[:, "XYZ".index(name)] / METERS
    return order, build(local, values, configuration)
