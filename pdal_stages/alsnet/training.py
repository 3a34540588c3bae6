"""Training alsNet: epochs of selected batches, scored on ground held out [WM19 3, 4]."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError, OptionError
from ..base.json_types import JsonObject
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from ..classifier.class_map import ClassMap
from ..classifier.model import Model, load_model
from ..classifier.model_info import SampleCounts
from ..classifier.sampling import figures
from ..classifier.training_clouds import TrainingCloud
from ..classifier.training_options import TrainingOptions
from .batches import SHIFT, Pyramid, join_pyramids
from .classifier import AlsNet
from .configuration import NetworkOptions
from .network import Weights, check_weights, initial_weights
from .training_data import TrainingData, class_weights, cover, select_batches

#: Share of the first learning rate that is left at the last epoch; in between it follows a cosine
#: (not tuned).
LAST_RATE = 0.01

optional_inputs: dict[str, tuple[str, ...]] = {}


def own_options(options: Any) -> NetworkOptions:
    """Return the options of the network, from a mapping or as they are."""
    if isinstance(options, NetworkOptions):
        return options
    return NetworkOptions.from_dict(options or {})


def inputs(options: TrainingOptions) -> tuple[str, ...]:
    """Return the network's inputs: coordinates from the batch's center, then dimensions."""
    names = tuple(dict.fromkeys([*options.alsnet.coordinates, *options.dimensions]))
    if not names:
        raise OptionError(
            "a network needs at least one input",
            cure="Name a dimension, or set 'coordinates' to Z or XYZ",
        )
    return names


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """Train a network, see :func:`pdal_stages.classifier.train`.

    A batch sees only its own cloud.
    """
    from .torch_network import torch  # before any work: its error tells what to install

    training = NetworkTraining(clouds, options)
    threads, labeled, position = (
        torch.get_num_threads(),
        training.data.labeled,
        training.data.position,
    )
    try:
        torch.set_num_threads(resolve_threads(options.threads))
        devices = [torch.cuda.current_device()] if training.device == "cuda" else []
        with torch.random.fork_rng(devices=devices):
            network = training.run(progress)
    finally:
        torch.set_num_threads(threads)
    codes, names = labeled.classes.codes, labeled.classes.names
    count = np.bincount(position[position >= 0], minlength=len(codes)).tolist()
    counts = [SampleCounts(available=n, samples=n, duplicates=0) for n in count]
    size = {"count": sum(count), "seed": options.seed, "samples": sum(count)}
    info = labeled.describe(
        options, counts, {**size, **training.describe()}, [None], ("numpy", "torch")
    )
    return Model((network,), list(zip(codes, names, strict=True)), info)


class NetworkTraining:
    """The network, its optimizer, and what has been reached."""

    def __init__(self, clouds: Sequence[TrainingCloud], options: TrainingOptions) -> None:
        from . import torch_network

        self.backend, self.torch = torch_network, torch_network.torch
        self.options, self.seed = options.alsnet, options.seed
        self.threads = resolve_threads(options.threads)
        self.device = torch_network.resolve_device(self.options.device)
        names, network = inputs(options), self.options
        start = None if network.start_from is None else _load_start(network, names)
        start_from = None if start is None else start[1]
        self.data = data = TrainingData(clouds, options, names, start_from)
        count = data.count_trained()
        self.selected, self.added = select_batches(
            data.batches, data.train_labels, data.n_classes, network.histogram_threshold
        )
        self.held_batches = cover(data.batches, data.held_labels >= 0)
        weights = initial_weights(network.configuration, len(names), data.n_classes, self.seed)
        if start is not None:
            weights = _transfer(*start, weights, data.labeled.classes)
        shape = network.configuration, len(names), data.n_classes
        self.network = torch_network.Network(*shape).load(weights).to(self.device)
        self.optimizer = self.torch.optim.Adam(self.network.parameters(), lr=network.learning_rate)
        weight = class_weights(count, network.class_weights)
        self.weight = self.torch.tensor(weight, dtype=self.torch.float32, device=self.device)
        self.curve: list[JsonObject] = []  #: loss and scores of each epoch
        self.best: Weights = self.network.dump()  #: weights of the epoch of the best mean F1
        self.best_epoch = 0

    def run(self, progress: bool) -> AlsNet:
        """Train all epochs; return the best network."""
        options, data = self.options, self.data
        total = options.epochs * (len(self.selected) + len(self.held_batches))
        with Progress(total, "training alsNet", "batches", enabled=progress) as bar:
            while len(self.curve) < options.epochs and not self._patience_is_over():
                self._run_epoch(bar)
        check_weights(self.best, options.configuration, len(data.inputs), data.n_classes)
        return AlsNet(
            self.best,
            options.configuration,
            data.inputs,
            data.mean,
            data.scale,
            data.spacing,
            data.n_classes,
            self.options.reach,
        )

    def _run_epoch(self, bar: Progress) -> None:
        """Train one epoch, score it, and keep the weights where they are the best so far."""
        epoch = len(self.curve)
        row: JsonObject = {"epoch": epoch + 1, "loss": self._train_epoch(epoch, bar)}
        bar.label = f"training alsNet, epoch {epoch + 1}, loss {row['loss']:.3f}"
        if self.held_batches:
            row |= self._validate(bar)
            bar.label += f", held out mean F1 {100 * _score(row):.1f} %"
        self.curve.append(row)
        first = not self.held_batches or not self.best_epoch
        if first or _score(row) > _score(self._best_row()):
            self.best, self.best_epoch = self.network.dump(), epoch + 1

    def _best_row(self) -> JsonObject:
        return self.curve[self.best_epoch - 1] if self.best_epoch else {}

    def _patience_is_over(self) -> bool:
        if not self.options.patience or not self.held_batches:
            return False
        return len(self.curve) - self.best_epoch >= self.options.patience

    def _train_epoch(self, epoch: int, bar: Progress) -> float:
        """Train on every selected batch once; return the mean loss."""
        options = self.options
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self.selected))
        size = options.batches_per_step
        steps = [order[k : k + size].tolist() for k in range(0, len(order), size)]
        self.torch.manual_seed(int(np.random.default_rng([self.seed, epoch, 1]).integers(2**62)))
        phase = min(epoch / options.epochs, 1.0)
        cosine = 0.5 * (1.0 + math.cos(math.pi * phase))
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * (LAST_RATE + (1.0 - LAST_RATE) * cosine)
        self.network.train()
        total, weight = 0.0, 0

        def prepare(numbers: list[int]) -> tuple[int, Pyramid, npt.NDArray[np.int64]]:
            parts = [self._augmented_batch(self.selected[k], epoch) for k in numbers]
            labels = np.concatenate([labels for _, labels in parts])
            return len(numbers), join_pyramids([pyramid for pyramid, _ in parts]), labels

        for count, pyramid, labels in map_blocks(prepare, steps, self.threads):
            known = int(np.count_nonzero(labels >= 0))
            # A single point has no variance to be normalized by.
            if known and len(labels) > 1:
                total += self._step(pyramid, labels) * known
                weight += known
            bar.update(count)
        return total / weight if weight else 0.0

    def _augmented_batch(self, number: int, epoch: int) -> tuple[Pyramid, npt.NDArray[np.int64]]:
        """Return a batch's pyramid and labels, changed at random where the options say so."""
        random = np.random.default_rng([self.seed, epoch, 2, number])
        data, batches = self.data, self.data.batches
        center, members = batches.centers[number], batches.members(number)
        if self.options.augment:
            shift = random.uniform(-1.0, 1.0, 2) * SHIFT * data.spacing
            moved = center + shift
            nearest = batches.nearest_points(float(moved[0]), float(moved[1]))
            if len(nearest):  # not moved off the cloud's edge
                center, members = moved, nearest
        rows, pyramid = data.pyramid(members, center, random if self.options.augment else None)
        return pyramid, data.train_labels[rows]

    def _step(self, pyramid: Pyramid, labels: npt.NDArray[np.int64]) -> float:
        """Do a step of the optimizer; return the cross entropy, the loss [WM19 2.4]."""
        torch = self.torch
        scores = self.network(self.backend.tensors(pyramid, self.device))
        target = torch.from_numpy(labels).to(self.device)
        loss = torch.nn.functional.cross_entropy(
            scores, target, weight=self.weight, ignore_index=-1
        )
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

    def _validate(self, bar: Progress) -> JsonObject:
        """Return the scores on the ground held out, by the sums of probabilities over batches."""
        data, torch = self.data, self.torch
        self.network.eval()
        sums = np.zeros((len(data.xyz), data.n_classes), np.float32)

        def prepare(number: int) -> tuple[npt.NDArray[np.int64], Pyramid]:
            return data.pyramid(data.batches.members(number), data.batches.centers[number])

        with torch.no_grad():
            for rows, pyramid in map_blocks(prepare, self.held_batches, self.threads):
                scores = self.network(self.backend.tensors(pyramid, self.device))
                sums[rows] += torch.softmax(scores, dim=1).cpu().numpy()
                bar.update(1)
        matrix = np.zeros((data.n_classes, data.n_classes), np.int64)
        labels = data.held_labels
        rows = np.flatnonzero(labels >= 0)
        np.add.at(matrix, (labels[rows], sums[rows].argmax(axis=1)), 1)
        return figures(matrix, data.labeled.classes.codes)

    def describe(self) -> JsonObject:
        """Return the manifest's entries: batches, epochs, curve, validation."""
        options, data = asdict(self.options), self.data
        for name in ("configuration", "start_from", "device"):
            options.pop(name)
        start, best = self.options.start_from, self._best_row()
        start = start and os.path.basename(start)
        return {
            "network": {**options, "spacing": data.spacing, "start_from": start},
            "batches": {
                "all": len(data.batches),
                "chosen": len(self.selected),
                "added_for_classes": self.added,
            },
            "epochs": len(self.curve),
            "best_epoch": self.best_epoch,
            "points_held_out": int(np.count_nonzero(data.held_labels >= 0)),
            "held_out": {k: v for k, v in best.items() if k not in ("epoch", "loss")} or None,
            "curve": self.curve,
        }


def _score(row: JsonObject) -> float:
    return float(row["mean_f1"] or 0.0)


def _load_start(options: NetworkOptions, names: tuple[str, ...]) -> tuple[Model, AlsNet]:
    """Return the model and network that training starts from; ModelError where they do not fit."""
    path = str(options.start_from)
    model = load_model(path)
    net, wanted = model.algorithm, options.configuration
    if not isinstance(net, AlsNet):
        raise ModelError("training can start from a network only", where=path, found=net.name)
    theirs = net.configuration.levels, net.configuration.head, net.inputs
    if theirs != (wanted.levels, wanted.head, names):
        raise ModelError(
            "the model to start from has other inputs or another network",
            where=path,
            found=f"configuration {net.configuration.name}, inputs {', '.join(net.inputs)}",
            cure="Use its configuration and inputs: options configuration, coordinates, dimensions",
        )
    return model, net


def _transfer(source: Model, network: AlsNet, start: Weights, classes: ClassMap) -> Weights:
    """Return the source's weights, of the last layer only for classes that both have [WM19 3]."""
    weights, codes = network.weights, source.codes.tolist()
    scores = start["scores"].copy()
    for k, code in enumerate(classes.codes):
        if code in codes:
            scores[k] = weights["scores"][codes.index(code)]
    return {**weights, "scores": scores}
