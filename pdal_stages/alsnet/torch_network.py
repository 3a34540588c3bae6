"""The network in PyTorch, for training it and applying it on a GPU."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DependencyError, optional_import
from .batches import Pyramid, Step
from .configuration import Configuration
from .network import EPSILON, Weights, forward

# OpenMP's threads spin while they wait, a third of all CPU time beside threads that prepare
# batches; on a busy machine training took many times as long. Read when PyTorch loads its OpenMP.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
torch: Any = optional_import("torch", "deep", "training an alsNet, or applying one on a GPU")
nn: Any = torch.nn

#: Share of a batch's statistics in the running ones (PyTorch's default is 0.1; not tuned).
MOMENTUM = 0.05


class Network(nn.Module):
    """The layers of a configuration by the names of their arrays: linear, normalized, ReLU."""

    def __init__(self, configuration: Configuration, inputs: int, classes: int) -> None:
        super().__init__()
        self.configuration = configuration
        self.layers, shapes = nn.ModuleDict(), configuration.shapes(inputs, classes)
        for name, (after, columns) in shapes.items():
            if name == "scores":
                self.layers[name] = nn.Linear(columns - 1, after)
                continue
            linear = nn.Linear(columns - 4, after, bias=False)
            norm = nn.BatchNorm1d(after, eps=EPSILON, momentum=MOMENTUM)
            self.layers[name] = nn.Sequential(linear, norm, nn.ReLU())
        self.dropout = nn.Dropout(configuration.dropout)

    def forward(self, pyramid: Pyramid):
        """Return scores before the softmax, (n, classes), of a pyramid of tensors."""
        below = forward(
            self.configuration,
            pyramid,
            lambda name, values: self.layers[name](values),
            lambda values, rows: values.index_select(0, rows),
            lambda parts: torch.cat(parts, dim=1),
            lambda values: values.amax(dim=1),
        )
        return self.layers["scores"](self.dropout(below))

    def _parts(self):
        """Yield the name of every array and the tensors side by side in it."""
        for name, layer in self.layers.items():
            if name == "scores":
                yield name, (layer.weight, layer.bias[:, None])
            else:
                linear, norm, _ = layer
                more = (norm.weight, norm.bias, norm.running_mean, norm.running_var)
                yield name, (linear.weight, *(part[:, None] for part in more))

    def load(self, weights: Mapping[str, npt.NDArray[np.float32]]) -> Network:
        """Take over checked arrays; return itself."""
        with torch.no_grad():
            for name, parts in self._parts():
                array = torch.from_numpy(np.array(weights[name], dtype=np.float32))
                for part, values in zip(
                    parts, array.split([p.shape[1] for p in parts], dim=1), strict=True
                ):
                    part.copy_(values)
        return self

    def dump(self) -> Weights:
        """Return the weights as arrays, in the order of ``Configuration.shapes``."""
        return {
            name: torch.cat(parts, dim=1).detach().cpu().numpy() for name, parts in self._parts()
        }


def apply_on_device(
    device: str, weights: Weights, configuration: Configuration, inputs: int, classes: int
) -> Callable[[Pyramid], npt.NDArray[np.float64]]:
    """Return a function that gives class probabilities (n, classes) of a batch on a device.

    They equal those of ``network.NumpyNetwork`` up to rounding.
    """
    network = Network(configuration, inputs, classes).load(weights).to(device).eval()

    def probabilities(pyramid: Pyramid) -> npt.NDArray[np.float64]:
        with torch.no_grad():
            scores = network(tensors(pyramid, device))
            return torch.softmax(scores.double(), dim=1).cpu().numpy()

    return probabilities


def resolve_device(device: str) -> str:
    """Return ``cuda`` or ``cpu`` for a device option; DependencyError for a missing cuda."""
    cuda = torch.cuda.is_available()
    if device == "cuda" and not cuda:
        raise DependencyError(
            "'device' is cuda, but PyTorch sees no CUDA device",
            cure="Install a CUDA build of PyTorch and the driver, or use device auto",
        )
    return "cuda" if cuda and device != "cpu" else "cpu"


def tensors(pyramid: Pyramid, device: str = "cpu") -> Pyramid:
    """Return the pyramid with tensors for arrays."""

    def move(array):
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    steps = (
        Step(*(move(getattr(s, name)) for name in ("groups", "offsets", "nearest", "weights")))
        for s in pyramid.steps
    )
    return Pyramid(move(pyramid.inputs), tuple(steps))
