"""Training a network: epochs of chosen batches, scored on ground held out, resumable at any
epoch."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError, OptionError
from ..base.files import CHECKPOINT, Output, write_whole
from ..base.hashing import hash_rows
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from ..classifier.class_map import ClassMap
from ..classifier.input_dimensions import add_return_features, take_dimensions
from ..classifier.load_model import load_model
from ..classifier.model import Model
from ..classifier.sampling import figures
from ..classifier.training_clouds import TrainingCloud, label_classes
from ..classifier.training_options import TrainingOptions
from ..features.cell_means import density
from . import training_batches
from .batches import Circles, spacing_for
from .classifier import AlsNet, make_pyramid, scaled
from .configuration import NetworkOptions
from .network import Weights, check, fresh
from .sampling_and_grouping import stack

#: Of a checkpoint: a file of PyTorch's own, read with ``weights_only`` (nothing in it is executed),
#: and its SHA-256.
FORMAT = "pdal-stages alsnet checkpoint 4"

optional_inputs: dict[str, tuple[str, ...]] = {}


def outputs(options: TrainingOptions) -> list[Output]:
    """The checkpoint, if one is wanted."""
    path = options.alsnet.checkpoint
    return [Output(path, "checkpoint", CHECKPOINT)] if path else []


def own_options(options: Any) -> NetworkOptions:
    """The options of the network."""
    if isinstance(options, NetworkOptions):
        return options
    return NetworkOptions.from_dict(options or {})


def inputs(options: TrainingOptions) -> tuple[str, ...]:
    """The network's inputs: coordinates from the batch's center, then dimensions; OptionError where
    there are none."""
    names = tuple(dict.fromkeys([*options.alsnet.coordinates, *options.dimensions]))
    if not names:
        raise OptionError(
            "a network needs at least one input",
            cure="Name a dimension, or set 'coordinates' to Z or XYZ",
        )
    return names


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """See :func:`pdal_stages.classifier.train`. A batch sees only its own cloud."""
    from .torch_network import torch  # before any work: says what to install where it is missing

    session = _Session(clouds, options)
    known, position, before = session.labeled, session.position, torch.get_num_threads()
    try:
        torch.set_num_threads(session.threads)
        with torch.random.fork_rng(
            devices=[torch.cuda.current_device()] if session.device == "cuda" else []
        ):
            net = session.run(progress)
    finally:
        torch.set_num_threads(before)
    count = np.bincount(position[position >= 0], minlength=len(known.classes.codes))
    counts = ({"available": int(m), "samples": int(m), "duplicates": 0} for m in count)
    every = int(count.sum())
    training = {"count": every, "seed": options.seed, "samples": every, **session.notes()}
    info = known.describe(options, counts, training, [None], ("numpy", "torch"))
    classes = list(zip(known.classes.codes, known.classes.names, strict=True))
    return Model((net,), classes, info)


class _Session:
    """One training: its data, the network, the optimizer, what has been reached."""

    def __init__(self, clouds: Sequence[TrainingCloud], training: TrainingOptions) -> None:
        from .torch_network import Network, chosen_device, torch

        self.torch, self.options, self.seed = torch, training.alsnet, training.seed
        self.threads, self.inputs = resolve_threads(training.threads), inputs(training)
        options, names = self.options, self.inputs
        # Of all clouds, one after the other; the place of each point's class is -1 where it is only
        # a neighbor.
        self.clouds = [cloud.xyz for cloud in clouds]
        self.labeled = label_classes(clouds, training)
        self.position = position = np.concatenate([np.asarray(one) for _, one in self.labeled])
        self.classes = classes = self.labeled.classes
        self.n_classes = len(classes.codes)
        each: list[dict[str, npt.NDArray[Any]]] = []
        for cloud, xyz in zip(clouds, self.clouds, strict=True):
            there = add_return_features(names, xyz, cloud.dimensions, self.threads)
            each.append(take_dimensions(names, there, len(xyz), where=cloud.name))
        values = {
            name: np.concatenate([own[name] for own in each]).astype(np.float64) for name in each[0]
        }
        self.device = chosen_device(options.device)
        source = None if options.start_from is None else _source(options, names)
        self.mean: tuple[float, ...]
        self.scale: tuple[float, ...]
        if source is None:
            # Mean and standard deviation over the labeled points; 0 and 1 for coordinates.
            told = [values.get(name, np.zeros(len(position)))[position >= 0] for name in names]
            self.mean = tuple(float(column.mean()) for column in told)
            self.scale = tuple(float(s) if (s := column.std()) > 1e-6 else 1.0 for column in told)
        else:
            self.mean, self.scale = source.algorithm.mean, source.algorithm.scale
        points = options.configuration.points
        self.spacing = options.spacing or spacing_for(
            points, float(np.median([density(xyz) for xyz in self.clouds]))
        )
        self.xyz = training_batches.side_by_side(self.clouds, self.spacing)
        self.columns = scaled(self.xyz, values, names, self.mean, self.scale)
        self.circles = Circles(self.xyz, points, self.spacing, self.columns)
        held = training_batches.hold_out(
            np.concatenate(self.clouds), position, options.validation, options.block_size
        )
        self.train_labels = np.where(held, -1, position).astype(np.int64)
        self.held_labels = np.where(held, position, -1).astype(np.int64)
        count = np.bincount(self.train_labels[self.train_labels >= 0], minlength=self.n_classes)
        if not count.all():
            k = int(np.argmin(count))
            raise OptionError(
                f"class {classes.codes[k]} ({classes.names[k]}) has no points outside the ground "
                "held out",
                cure="Make block_size smaller, set validation to 0, or give more training data",
            )
        threshold = options.histogram_threshold
        self.chosen = training_batches.choose(
            self.circles, self.train_labels, self.n_classes, threshold
        )
        self.held_batches = training_batches.covering(self.circles, self.held_labels >= 0)
        start = fresh(options.configuration, len(names), self.n_classes, self.seed)
        if source is not None:
            start = _transfer(source, start, classes)
        self.network = (
            Network(options.configuration, len(names), self.n_classes).load(start).to(self.device)
        )
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=options.learning_rate)
        weight = training_batches.class_weights(count, options.class_weights)
        self.weight = torch.tensor(weight, dtype=torch.float32, device=self.device)
        self.curve: list[dict[str, Any]] = []
        self.best: Weights = self.network.dump()
        self.best_epoch = 0

    def run(self, progress: bool) -> AlsNet:
        """All epochs, or those that are left."""
        options = self.options
        if options.checkpoint and os.path.exists(options.checkpoint):
            self._resume(options.checkpoint)
        left = max(options.epochs - len(self.curve), 0)
        total = left * (len(self.chosen) + len(self.held_batches))
        with Progress(total, "training alsNet", "batches", enabled=progress) as bar:
            while len(self.curve) < options.epochs and not self._patience_is_over():
                epoch = len(self.curve)
                row: dict[str, Any] = {"epoch": epoch + 1, "loss": self._epoch(epoch, bar)}
                bar.label = f"training alsNet, epoch {epoch + 1}, loss {row['loss']:.3f}"
                if self.held_batches:
                    row |= self._validate(bar)
                    bar.label += f", held out mean F1 {100 * _score(row):.1f} %"
                self.curve.append(row)
                if (
                    not self.held_batches
                    or not self.best_epoch
                    or _score(row) > _score(self._best_row())
                ):
                    self.best, self.best_epoch = self.network.dump(), epoch + 1
                if options.checkpoint:
                    self._save(options.checkpoint)
        check(self.best, options.configuration, len(self.inputs), self.n_classes)
        return AlsNet(
            self.best,
            options.configuration,
            self.inputs,
            self.mean,
            self.scale,
            self.spacing,
            self.n_classes,
        )

    def _best_row(self) -> dict[str, Any]:
        return self.curve[self.best_epoch - 1] if self.best_epoch else {}

    def _patience_is_over(self) -> bool:
        patience = self.options.patience
        return bool(
            patience and self.held_batches and len(self.curve) - self.best_epoch >= patience
        )

    def _epoch(self, epoch: int, bar: Progress) -> float:
        """Train on every chosen batch once; the mean loss."""
        options = self.options
        order = np.random.default_rng([self.seed, epoch]).permutation(len(self.chosen))
        size = options.batches_per_step
        steps = [order[k : k + size].tolist() for k in range(0, len(order), size)]
        self.torch.manual_seed(int(np.random.default_rng([self.seed, epoch, 1]).integers(2**62)))
        phase = min(epoch / options.epochs, 1.0)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * (
                0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * phase))
            )
        self.network.train()
        total, weight = 0.0, 0

        def prepare(numbers: list[int]):
            made = [self._augmented(self.chosen[k], epoch) for k in numbers]
            return stack([pyramid for pyramid, _ in made]), np.concatenate(
                [labels for _, labels in made]
            )

        for numbers, (pyramid, labels) in zip(
            steps, map_blocks(prepare, steps, self.threads), strict=True
        ):
            known = int(np.count_nonzero(labels >= 0))
            if known and len(labels) > 1:
                total += self._step(pyramid, labels) * known
                weight += known
            bar.update(len(numbers))
        return total / weight if weight else 0.0

    def _augmented(self, number: int, epoch: int):
        """(pyramid, labels) of a batch, changed as the options say."""
        random = np.random.default_rng([self.seed, epoch, 2, number])
        center, members, change = self.circles.centers[number], self.circles.members(number), None
        if self.options.augment:
            moved = center + random.uniform(-1.0, 1.0, 2) * training_batches.SHIFT * self.spacing
            around = self.circles.around(float(moved[0]), float(moved[1]))
            if len(around):  # not moved off the cloud's edge
                center, members = moved, around
            change = lambda xyz: training_batches.augmented(xyz, random)  # noqa: E731
        order, pyramid = self._pyramid(members, center, change)
        return pyramid, self.train_labels[members[order]]

    def _pyramid(self, members, center, change: Any = None):
        configuration = self.options.configuration
        return make_pyramid(
            self.xyz, self.columns, members, center, self.inputs, configuration, change
        )

    def _step(self, pyramid, labels: npt.NDArray[np.int64]) -> float:
        from .torch_network import tensors

        torch = self.torch
        scores = self.network(tensors(pyramid, self.device))
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

    def _validate(self, bar: Progress) -> dict[str, Any]:
        """Scores on the ground held out."""
        from .torch_network import tensors

        self.network.eval()
        sums = np.zeros((len(self.xyz), self.n_classes), np.float32)

        def prepare(number: int):
            members = self.circles.members(number)
            order, pyramid = self._pyramid(members, self.circles.centers[number])
            return members[order], pyramid

        with self.torch.no_grad():
            for rows, pyramid in map_blocks(prepare, self.held_batches, self.threads):
                scores = self.network(tensors(pyramid, self.device))
                sums[rows] += self.torch.softmax(scores, dim=1).cpu().numpy()
                bar.update(1)
        matrix = np.zeros((self.n_classes, self.n_classes), np.int64)
        rows = np.flatnonzero(self.held_labels >= 0)
        np.add.at(matrix, (self.held_labels[rows], sums[rows].argmax(axis=1)), 1)
        return figures(matrix, self.classes.codes)

    def _identity(self) -> str:
        """What a checkpoint must agree with, as JSON: options, classes and data."""
        options = asdict(self.options)
        for free in ("epochs", "patience", "device", "checkpoint"):
            options.pop(free)
        options["start_from"] = options["start_from"] and os.path.basename(options["start_from"])
        labels = [list(self.classes.codes), [list(part) for part in self.classes.labels]]
        values = (*self.xyz.T, *self.columns.T, self.position)
        data = [*map(len, self.clouds), str(hash_rows(values, 0).sum())]
        return json.dumps([FORMAT, options, self.seed, self.inputs, labels, data])

    def _save(self, path: str) -> None:
        """Write all that training changes, whole or not at all, and its digest."""
        torch, buffer = self.torch, BytesIO()
        best = {name: torch.from_numpy(array) for name, array in self.best.items()}
        torch.save(
            {
                "identity": self._identity(),
                "curve": self.curve,
                "best_epoch": self.best_epoch,
                "best": best,
                "network": self.network.state_dict(),
                "optimizer": self.optimizer.state_dict(),
            },
            buffer,
        )
        write_whole(path, buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())

    def _resume(self, path: str) -> None:
        """Go on from a checkpoint of this very training; ModelError where it is damaged or of
        another."""
        data = Path(path).read_bytes()
        cure = "Delete the checkpoint to begin anew, or name another file"
        if hashlib.sha256(data[:-32]).digest() != data[-32:]:
            raise ModelError(
                "this is not a checkpoint of this release, or it is damaged", where=path, cure=cure
            )
        try:
            found = self.torch.load(BytesIO(data[:-32]), map_location="cpu", weights_only=True)
            mine = found["identity"] == self._identity()
            if mine:
                self.network.load_state_dict(found["network"])
                self.optimizer.load_state_dict(found["optimizer"])
                self.best = {name: tensor.numpy() for name, tensor in found["best"].items()}
                self.curve, self.best_epoch = found["curve"], found["best_epoch"]
        except Exception as error:  # PyTorch's own, of files that somebody made
            raise ModelError(
                "the checkpoint cannot be read",
                where=path,
                found=f"{type(error).__name__}: {error}".splitlines()[0][:200],
                cure=cure,
            ) from error
        if not mine:
            what = "the checkpoint belongs to another training, of other options, classes or data"
            raise ModelError(what, where=path, cure=cure)

    def notes(self) -> dict[str, Any]:
        """For the manifest: batches, epochs, curve, validation."""
        options = asdict(self.options)
        for own in ("configuration", "checkpoint", "start_from", "device", "points"):
            options.pop(own)
        start, best = self.options.start_from, self._best_row()
        return {
            "network": {
                **options,
                "spacing": self.spacing,
                "start_from": start and os.path.basename(start),
            },
            "batches": {"all": len(self.circles), "chosen": len(self.chosen)},
            "epochs": len(self.curve),
            "best_epoch": self.best_epoch,
            "points_held_out": int(np.count_nonzero(self.held_labels >= 0)),
            "held_out": {k: v for k, v in best.items() if k not in ("epoch", "loss")} or None,
            "curve": self.curve,
        }


def _score(row: dict[str, Any]) -> float:
    return float(row["mean_f1"] or 0.0)


def _source(options: NetworkOptions, names: tuple[str, ...]) -> Model:
    """The model that training starts from, if its network is the same."""
    path = str(options.start_from)
    model = load_model(path)
    net, wanted = model.algorithm, options.configuration
    if not isinstance(net, AlsNet):
        raise ModelError("training can start from a network only", where=path, found=net.name)
    if (net.configuration.levels, net.configuration.head) != (wanted.levels, wanted.head):
        raise ModelError(
            "the model to start from has another network",
            where=path,
            found=f"configuration {net.configuration.name}",
            cure="Use its configuration",
        )
    if net.inputs != names:
        raise ModelError(
            "the model to start from has other inputs", where=path, found=", ".join(net.inputs),
            cure=f"Here they are {', '.join(names)}: change dimensions or coordinates",
        )  # fmt: skip
    return model


def _transfer(source: Model, start: Weights, classes: ClassMap) -> Weights:
    """The source's weights; the last layer's rows only for classes both have."""
    weights, codes = source.algorithm.weights, source.codes.tolist()
    scores = start["scores"].copy()
    for k, code in enumerate(classes.codes):
        if code in codes:
            scores[k] = weights["scores"][codes.index(code)]
    return {**weights, "scores": scores}
