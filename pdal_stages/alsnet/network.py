"""The network in PyTorch, for training it and for applying it on a CUDA device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import optional_import
from .configuration import Configuration
from .pyramid import Pyramid
from .weights import EPSILON, Weights

torch: Any = optional_import("torch", "deep", "training an alsNet")
nn: Any = torch.nn

#: Share of a batch's statistics in the running ones.
MOMENTUM = 0.05


class Shared(nn.Module):
    """A perceptron applied to every row alike: linear, batch normalization, ReLU, as often as it has widths."""

    def __init__(self, before: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.linear = nn.ModuleList()
        self.norm = nn.ModuleList()
        for after in widths:
            self.linear.append(nn.Linear(before, after, bias=False))
            self.norm.append(nn.BatchNorm1d(after, eps=EPSILON, momentum=MOMENTUM))
            before = after

    def forward(self, values):
        for linear, norm in zip(self.linear, self.norm, strict=True):
            values = torch.relu(norm(linear(values)))
        return values


class Network(nn.Module):
    """PointNet++ with the levels of a configuration [WM19; Qi et al. 2017]."""

    def __init__(self, configuration: Configuration, inputs: int, classes: int) -> None:
        super().__init__()
        self.configuration = configuration
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        width = [inputs]
        for level in configuration.levels:
            self.down.append(Shared(width[-1] + 3, level.mlp))
            width.append(level.mlp[-1])
        below = width[-1]
        ups = []
        for number in range(len(configuration.levels) - 1, -1, -1):
            up = configuration.levels[number].up
            ups.append(Shared(below + width[number], up))
            below = up[-1]
        self.up.extend(reversed(ups))
        self.head = Shared(below, configuration.head)
        self.dropout = nn.Dropout(configuration.dropout)
        self.scores = nn.Linear(configuration.head[-1], classes)

    def forward(self, inputs, steps):
        """Scores before the softmax, (n, classes)."""
        features = [inputs]
        for shared, (groups, offsets, _, _) in zip(self.down, steps, strict=True):
            m, samples = groups.shape
            gathered = features[-1].index_select(0, groups.reshape(-1))
            rows = torch.cat([offsets.reshape(m * samples, 3), gathered], dim=1)
            features.append(shared(rows).reshape(m, samples, -1).amax(dim=1))
        below = features[-1]
        for number in range(len(steps) - 1, -1, -1):
            _, _, near, weights = steps[number]
            carried = sum(below.index_select(0, near[:, k]) * weights[:, k : k + 1] for k in range(3))
            below = self.up[number](torch.cat([carried, features[number]], dim=1))
        return self.scores(self.dropout(self.head(below)))

    # ---- weights -------------------------------------------------------------------------------------------

    def _layers(self):
        """(array name, linear, normalization) of every layer but the last."""
        for number, shared in enumerate(self.down, 1):
            for step, pair in enumerate(zip(shared.linear, shared.norm, strict=True), 1):
                yield f"sa{number}_{step}", *pair
        for number, shared in enumerate(self.up, 1):
            for step, pair in enumerate(zip(shared.linear, shared.norm, strict=True), 1):
                yield f"fp{number}_{step}", *pair
        for step, pair in enumerate(zip(self.head.linear, self.head.norm, strict=True), 1):
            yield f"head_{step}", *pair

    def load(self, weights: Mapping[str, npt.NDArray[np.float32]]) -> Network:
        """Take over checked arrays."""
        with torch.no_grad():
            for name, linear, norm in self._layers():
                array = torch.from_numpy(np.array(weights[name], dtype=np.float32))
                linear.weight.copy_(array[:, :-4])
                for k, part in enumerate((norm.weight, norm.bias, norm.running_mean, norm.running_var)):
                    part.copy_(array[:, k - 4])
            array = torch.from_numpy(np.array(weights["scores"], dtype=np.float32))
            self.scores.weight.copy_(array[:, :-1])
            self.scores.bias.copy_(array[:, -1])
        return self

    def dump(self) -> Weights:
        """The weights as arrays, in the order of ``Configuration.shapes``."""
        out = {}
        for name, linear, norm in self._layers():
            parts = (norm.weight, norm.bias, norm.running_mean, norm.running_var)
            out[name] = _numpy(torch.cat([linear.weight, torch.stack(list(parts), dim=1)], dim=1))
        out["scores"] = _numpy(torch.cat([self.scores.weight, self.scores.bias[:, None]], dim=1))
        inputs, classes = out["sa1_1"].shape[1] - 7, len(out["scores"])
        return {name: out[name] for name in self.configuration.shapes(inputs, classes)}


def tensors(pyramid: Pyramid, device: str = "cpu") -> tuple[Any, list[tuple[Any, ...]]]:
    """A pyramid as the arguments of :class:`Network`."""

    def move(array):
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    return move(pyramid.inputs), [
        (move(s.groups), move(s.offsets), move(s.near), move(s.weights)) for s in pyramid.steps
    ]


class Applied:
    """A network applied with PyTorch; the same call as ``weights.Folded``."""

    def __init__(
        self,
        weights: Mapping[str, npt.NDArray[np.float32]],
        configuration: Configuration,
        device: str = "cpu",
    ) -> None:
        inputs, classes = weights["sa1_1"].shape[1] - 7, len(weights["scores"])
        self.device = device
        self.network = Network(configuration, inputs, classes).load(weights).to(device).eval()

    def __call__(self, pyramid: Pyramid) -> npt.NDArray[np.float64]:
        """Class probabilities, (n, classes) float64."""
        with torch.no_grad():
            scores = self.network(*tensors(pyramid, self.device)).double()
            return torch.softmax(scores, dim=1).cpu().numpy()


def _numpy(tensor) -> npt.NDArray[np.float32]:
    return tensor.detach().cpu().numpy().astype(np.float32)
