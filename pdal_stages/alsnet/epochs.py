"""Training a network: epochs of chosen batches, scored on ground held out, resumable at any epoch."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DependencyError, ModelError, OptionError
from ..base.hashing import coordinate_hash
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from ..classifier import crossval
from ..classifier.classes import ClassMap
from ..classifier.model import Model, load_model
from . import checkpoint, schedule
from .algorithm import AlsNet, make_pyramid, scaled
from .augment import Augmentation
from .circles import Circles, density, spacing_for
from .networkoptions import NetworkOptions
from .pyramid import stack
from .weights import Weights, check, fresh

#: What Adam keeps of each parameter.
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


@dataclass(frozen=True, eq=False)
class LabeledCloud:
    """A cloud to train on."""

    xyz: npt.NDArray[np.float64]  #: (n, 3) meters
    position: npt.NDArray[Any]  #: (n,) place of each point's class; -1 is not trained on, but is a neighbor
    dimensions: dict[str, npt.NDArray[Any]]  #: name to (n,) values of the inputs that are dimensions


@dataclass(eq=False)
class Trained:
    """What training gives."""

    net: AlsNet
    notes: dict[str, Any]  #: for the manifest: batches, epochs, curve, validation
    seconds: dict[str, float] = field(default_factory=dict)  #: where the time went


def train_network(
    clouds: Sequence[LabeledCloud],
    inputs: Sequence[str],
    classes: ClassMap,
    options: NetworkOptions,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: bool = True,
) -> Trained:
    """Train a network; `inputs` are X, Y, Z or dimensions, `threads` for PyTorch and for batches prepared ahead.

    Raises
    ------
    OptionError, ModelError, DependencyError
    """
    from .network import torch  # says what to install where it is missing

    session = _Session(clouds, tuple(inputs), classes, options, seed, resolve_threads(threads))
    before = torch.get_num_threads()
    devices = [torch.cuda.current_device()] if session.device == "cuda" else []
    try:
        torch.set_num_threads(session.threads)
        with torch.random.fork_rng(devices=devices):
            return session.run(progress)
    finally:
        torch.set_num_threads(before)


class _Session:
    """One training: its data, the network, the optimizer, what has been reached."""

    def __init__(
        self, clouds, inputs, classes: ClassMap, options: NetworkOptions, seed: int, threads: int
    ) -> None:
        from .network import Network, torch

        self.torch, self.clouds, self.inputs, self.options = torch, clouds, inputs, options
        self.classes, self.seed, self.threads = classes, seed, threads
        self.n_classes = len(classes.codes)
        self.device = _device(options.device, torch)
        self.seconds = {"batches": 0.0, "steps": 0.0, "validation": 0.0}
        source = None if options.start_from is None else _source(options, inputs)
        self.mean: tuple[float, ...]
        self.scale: tuple[float, ...]
        if source is None:
            self.mean, self.scale = _statistics(clouds, inputs)
        else:
            self.mean, self.scale = source.algorithm.mean, source.algorithm.scale
        self.spacing = options.spacing or spacing_for(
            options.configuration.points, density([c.xyz for c in clouds])
        )
        self.columns = [scaled(c.xyz, c.dimensions, inputs, self.mean, self.scale) for c in clouds]
        self.circles = [
            Circles(c.xyz, options.configuration.points, self.spacing, columns)
            for c, columns in zip(clouds, self.columns, strict=True)
        ]
        positions = [np.asarray(c.position) for c in clouds]
        held = schedule.hold_out([c.xyz for c in clouds], positions, options.validation, options.block_size)
        self.train_labels = [
            np.where(h, -1, p).astype(np.int64) for p, h in zip(positions, held, strict=True)
        ]
        self.held_labels = [np.where(h, p, -1).astype(np.int64) for p, h in zip(positions, held, strict=True)]
        used = np.concatenate([p[p >= 0] for p in self.train_labels])
        self.count = np.bincount(used, minlength=self.n_classes)
        if not self.count.all():
            k = int(np.argmin(self.count))
            raise OptionError(
                f"class {classes.codes[k]} ({classes.names[k]}) has no points outside the ground held out",
                cure="Make block_size smaller, set validation to 0, or give more training data",
            )
        self.choice = schedule.choose(
            self.circles, self.train_labels, self.n_classes, options.histogram_threshold
        )
        self.held_batches = [
            (k, number)
            for k, (one, label) in enumerate(zip(self.circles, self.held_labels, strict=True))
            for number in schedule.covering(one, label >= 0)
        ]
        start = fresh(options.configuration, len(inputs), self.n_classes, seed)
        if source is not None:
            start = _transfer(source, start, classes)
        self.network = Network(options.configuration, len(inputs), self.n_classes).load(start).to(self.device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=options.learning_rate)
        self.weight = torch.tensor(
            schedule.class_weights(self.count, options.class_weights), dtype=torch.float32, device=self.device
        )
        self.curve: list[dict[str, Any]] = []
        self.best: Weights = self.network.dump()
        self.best_epoch = 0

    # ---- the whole -----------------------------------------------------------------------------------------

    def run(self, progress: bool) -> Trained:
        """All epochs, or those that are left."""
        options = self.options
        if options.checkpoint and os.path.exists(options.checkpoint):
            self._resume(options.checkpoint)
        left = max(options.epochs - len(self.curve), 0)
        total = left * (len(self.choice.batches) + len(self.held_batches))
        with Progress(total, "training alsNet", "batches", enabled=progress) as bar:
            while len(self.curve) < options.epochs and not self._patience_is_over():
                epoch = len(self.curve)
                loss = self._epoch(epoch, bar)
                row: dict[str, Any] = {"epoch": epoch + 1, "loss": loss}
                if self.held_batches:
                    row |= self._validate(bar)
                self.curve.append(row)
                if not self.held_batches or self._score(row) > self._score(self._best_row()):
                    self.best, self.best_epoch = self.network.dump(), epoch + 1
                bar.label = f"training alsNet, epoch {epoch + 1}, loss {loss:.3f}" + (
                    f", held out mean F1 {100 * self._score(row):.1f} %" if self.held_batches else ""
                )
                if options.checkpoint:
                    self._save(options.checkpoint)
        check(self.best, options.configuration, len(self.inputs), self.n_classes)
        net = AlsNet(
            self.best, options.configuration, self.inputs, self.mean, self.scale, self.spacing, self.n_classes
        )
        return Trained(net, self._notes(), {name: round(value, 3) for name, value in self.seconds.items()})

    def _score(self, row: dict[str, Any] | None) -> float:
        return -1.0 if row is None else float(row["mean_f1"] or 0.0)

    def _best_row(self) -> dict[str, Any] | None:
        return self.curve[self.best_epoch - 1] if self.best_epoch else None

    def _patience_is_over(self) -> bool:
        patience = self.options.patience
        return bool(patience and self.held_batches and len(self.curve) - self.best_epoch >= patience)

    # ---- an epoch ------------------------------------------------------------------------------------------

    def _epoch(self, epoch: int, bar: Progress) -> float:
        """Train on every chosen batch once; the mean loss."""
        torch, options = self.torch, self.options
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self.choice.batches))
        size = options.batches_per_step
        steps = [order[k : k + size].tolist() for k in range(0, len(order), size)]
        torch.manual_seed(int(np.random.default_rng([self.seed, epoch, 1]).integers(2**62)))
        phase = min(epoch / options.epochs, 1.0)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * phase)))
        self.network.train()
        total, weight = 0.0, 0
        started = time.perf_counter()

        def prepare(numbers: list[int]):
            made = [self._augmented(*self.choice.batches[k], epoch) for k in numbers]
            return stack([pyramid for pyramid, _ in made]), np.concatenate([labels for _, labels in made])

        for numbers, (pyramid, labels) in zip(steps, map_blocks(prepare, steps, self.threads), strict=True):
            now = time.perf_counter()
            self.seconds["batches"] += now - started
            known = int(np.count_nonzero(labels >= 0))
            if known and len(labels) > 1:
                total += self._step(pyramid, labels) * known
                weight += known
            bar.update(len(numbers))
            started = time.perf_counter()
            self.seconds["steps"] += started - now
        return total / weight if weight else 0.0

    def _augmented(self, cloud: int, number: int, epoch: int):
        """(pyramid, labels) of a batch, changed as the options say."""
        change = Augmentation(self.options, np.random.default_rng([self.seed, epoch, 2, cloud, number]))
        circles = self.circles[cloud]
        center = circles.centers[number] + change.shift(self.spacing)
        members = circles.around(float(center[0]), float(center[1]))
        if not len(members):  # moved off the cloud's edge
            center, members = circles.centers[number], circles.members(number)
        order, pyramid = self._pyramid(cloud, members, center, change)
        return pyramid, self.train_labels[cloud][members[order]]

    def _pyramid(self, cloud: int, members, center, change: Any = None):
        xyz, columns, configuration = self.clouds[cloud].xyz, self.columns[cloud], self.options.configuration
        return make_pyramid(xyz, columns, members, center, self.inputs, configuration, change)

    def _step(self, pyramid, labels: npt.NDArray[np.int64]) -> float:
        from .network import tensors

        torch = self.torch
        scores = self.network(*tensors(pyramid, self.device))
        target = torch.from_numpy(labels).to(self.device)
        loss = torch.nn.functional.cross_entropy(scores, target, weight=self.weight, ignore_index=-1)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ModelError(
                "training diverged: the loss is not a number any more",
                found=f"epoch {len(self.curve) + 1}",
                cure="Lower learning_rate",
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        return value

    def _validate(self, bar: Progress) -> dict[str, Any]:
        """Scores on the ground held out."""
        from .network import tensors

        torch, started = self.torch, time.perf_counter()
        self.network.eval()
        sums = [np.zeros((len(c.xyz), self.n_classes), np.float32) for c in self.clouds]

        def prepare(batch):
            cloud, number = batch
            members = self.circles[cloud].members(number)
            order, pyramid = self._pyramid(cloud, members, self.circles[cloud].centers[number])
            return cloud, members[order], pyramid

        with torch.no_grad():
            for cloud, rows, pyramid in map_blocks(prepare, self.held_batches, self.threads):
                scores = self.network(*tensors(pyramid, self.device))
                sums[cloud][rows] += torch.softmax(scores, dim=1).cpu().numpy()
                bar.update(1)
        matrix = np.zeros((self.n_classes, self.n_classes), np.int64)
        for p, label in zip(sums, self.held_labels, strict=True):
            rows = np.flatnonzero(label >= 0)
            np.add.at(matrix, (label[rows], p[rows].argmax(axis=1)), 1)
        self.seconds["validation"] += time.perf_counter() - started
        return crossval.figures(matrix, self.classes.codes)

    # ---- checkpoint ----------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        options = asdict(self.options)
        for free in ("epochs", "patience", "device", "checkpoint"):
            options.pop(free)
        if options["start_from"]:
            options["start_from"] = os.path.basename(options["start_from"])
        return {
            "options": options,
            "seed": self.seed,
            "inputs": list(self.inputs),
            "classes": [list(self.classes.codes), [list(part) for part in self.classes.labels]],
            "points": [
                [
                    len(c.xyz),
                    str(coordinate_hash(c.xyz, 0).sum()),
                    str(np.asarray(c.position, np.int64).sum()),
                ]
                for c in self.clouds
            ],
        }

    def _tensors(self) -> dict[str, Any]:
        """All that training changes: the network, the best weights so far, the moments of Adam."""
        torch = self.torch
        out = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        out |= {f"best.{name}": torch.from_numpy(array) for name, array in self.best.items()}
        for name, parameter in self.network.named_parameters():
            moments = self.optimizer.state.get(parameter) or {}
            for key in _MOMENTS:
                none = torch.tensor(0.0) if key == "step" else torch.zeros_like(parameter)
                out[f"adam.{name}.{key}"] = moments.get(key, none).detach()
        return out

    def _save(self, path: str) -> None:
        state = {"identity": self._identity(), "curve": self.curve, "best_epoch": self.best_epoch}
        checkpoint.save(path, state, self._tensors())

    def _resume(self, path: str) -> None:
        state, tensors = checkpoint.load(path, self._identity(), self._tensors())
        curve: Any = state.get("curve")
        best: Any = state.get("best_epoch")
        needed = {"epoch", "loss"} | ({"mean_f1"} if self.held_batches else set())
        good = isinstance(curve, list) and all(isinstance(row, dict) and needed <= set(row) for row in curve)
        good = good and all(isinstance(row[key], int | float | None) for row in curve for key in needed)
        if not (good and isinstance(best, int) and 0 <= best <= len(curve)):
            raise ModelError(
                "the checkpoint's state is not right", where=path, cure="Delete it to begin anew"
            )
        self.network.load_state_dict({name: tensors[f"network.{name}"] for name in self.network.state_dict()})
        self.best = {name: tensors[f"best.{name}"].numpy() for name in self.best}
        for weights in (self.best, self.network.dump()):
            check(weights, self.options.configuration, len(self.inputs), self.n_classes)
        self.best_epoch, self.curve = best, curve
        for name, parameter in self.network.named_parameters():
            moments = {key: tensors[f"adam.{name}.{key}"] for key in _MOMENTS}
            self.optimizer.state[parameter] = {
                key: moment if key == "step" else moment.to(self.device) for key, moment in moments.items()
            }

    # ---- for the manifest ----------------------------------------------------------------------------------

    def _notes(self) -> dict[str, Any]:
        options = asdict(self.options)
        for own in ("configuration", "checkpoint", "start_from", "device", "points"):
            options.pop(own)
        start = self.options.start_from
        return {
            "network": {**options, "spacing": self.spacing, "start_from": start and os.path.basename(start)},
            "batches": {
                "all": self.choice.all,
                "chosen": len(self.choice.batches),
                "added_for_a_class": self.choice.added,
            },
            "epochs": len(self.curve),
            "best_epoch": self.best_epoch,
            "points_held_out": int(sum(np.count_nonzero(label >= 0) for label in self.held_labels)),
            "held_out": {k: v for k, v in (self._best_row() or {}).items() if k not in ("epoch", "loss")}
            or None,
            "curve": self.curve,
        }


def _device(wanted: str, torch) -> str:
    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise DependencyError(
            "'device' is cuda, but PyTorch sees no CUDA device",
            cure="Install a CUDA build of PyTorch and the driver, or use device auto",
        )
    return "cuda" if there and wanted != "cpu" else "cpu"


def _statistics(clouds, inputs) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and standard deviation of each input over the labeled points; 0 and 1 for coordinates."""
    mean, scale = [], []
    for name in inputs:
        if name in ("X", "Y", "Z"):
            mean.append(0.0)
            scale.append(1.0)
            continue
        values = np.concatenate(
            [np.asarray(c.dimensions[name], np.float64)[np.asarray(c.position) >= 0] for c in clouds]
        )
        deviation = float(values.std())
        mean.append(float(values.mean()))
        scale.append(deviation if deviation > 1e-6 else 1.0)
    return tuple(mean), tuple(scale)


def _source(options: NetworkOptions, inputs: tuple[str, ...]) -> Model:
    """The model that training starts from, if its network is the same."""
    path = str(options.start_from)
    model = load_model(path)
    net = model.algorithm
    if not isinstance(net, AlsNet):
        raise ModelError("training can start from a network only", where=path, found=net.name)
    if (
        net.configuration.levels != options.configuration.levels
        or net.configuration.head != options.configuration.head
    ):
        raise ModelError(
            "the model to start from has another network",
            where=path,
            found=f"configuration {net.configuration.name}",
            cure="Use its configuration",
        )
    if net.inputs != inputs:
        raise ModelError(
            "the model to start from has other inputs", where=path, found=", ".join(net.inputs),
            cure=f"Here they are {', '.join(inputs)}: change dimensions or coordinates",
        )  # fmt: skip
    return model


def _transfer(source: Model, start: Weights, classes: ClassMap) -> Weights:
    """The source's weights; the last layer's rows only for classes both have."""
    weights, codes = source.algorithm.weights, source.codes.tolist()
    scores = start["scores"].copy()
    for k, code in enumerate(classes.codes):
        if code in codes:
            scores[k] = weights["scores"][codes.index(code)]
    return {name: scores if name == "scores" else weights[name] for name in start}
