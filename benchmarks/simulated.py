"""Simulated training data, then few real ones: does the generated town help on Delft with 1 % of its labels?

    python benchmarks/simulated.py --data FOLDER [--kind forest alsnet] [--seeds 3] [--json FILE]

Delft keeps the labels of one in a hundred squares of 5 m of its training part, drawn at random; all other points are
neighbors. The town has Delft's density and classes (ground, building, all else). Forests: from the few labels, from the
town, from both as two surveys, and on top of the town's (`base`). Networks: from the town, from the town on (`start_from`),
and from the few labels alone, with the epochs that the latter had on Delft and with those of the town as well. All of
Delft's test part is scored, nothing is chosen by it.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from classification import read

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.dimensions import preparing
from pdal_stages.synthetic import make_town

CLASSES = (1, 2, 6)
PREPARATION = [{"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}]
FOREST = TrainingOptions(
    dimensions=("HeightAboveGround", "Ground", "HeightAboveOpening_5", "HeightAboveOpening_17", "returns"),
    folds=0,
    count=10_000,  # this and the context were the defaults when the figures were made
    context=("own", "box1", "columnvotes2", "columnvotes8"),
)
#: Side of the squares that keep their labels, meters, and their share.
SIDE, SHARE = 5.0, 0.01


def with_heights(name: str, xyz: np.ndarray, labels: np.ndarray, dimensions: dict[str, Any]) -> TrainingCloud:
    made = preparing().made_of_coordinates(PREPARATION, xyz, None, None)
    return TrainingCloud(xyz, labels, {**dimensions, **made}, name=name)


def town(size: float, density: float) -> TrainingCloud:
    made = make_town(size, density, progress=False)
    labels = np.where(np.isin(made.classification, (2, 6)), made.classification, 1)
    returns = {"ReturnNumber": made.return_number, "NumberOfReturns": made.number_of_returns}
    return with_heights("town", made.xyz, labels.astype(np.uint8), returns)


def few(cloud: TrainingCloud, seed: int) -> TrainingCloud:
    """The cloud with labels in some squares alone."""
    cell = np.floor(cloud.xyz[:, :2] / SIDE).astype(np.int64)
    squares, square = np.unique(cell, axis=0, return_inverse=True)
    chosen = np.random.default_rng(seed).permutation(len(squares))[: round(SHARE * len(squares))]
    return replace(cloud, labels=np.where(np.isin(square.reshape(-1), chosen), cloud.labels, 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--kind", nargs="+", default=["forest", "alsnet"], choices=("forest", "alsnet"))
    parser.add_argument("--seeds", type=int, default=3, help="of the squares that keep their labels")
    parser.add_argument("--town", type=float, default=200.0, help="its side, meters")
    parser.add_argument("--epochs", nargs=2, type=int, default=(6, 12), help="on the town, on Delft")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.data is None:
        parser.error("name the folder of the clouds: --data DIR, or PDAL_STAGES_DATA")
    parts = {part: with_heights(part, *read(Path(options.data), "delft", part)) for part in ("train", "test")}
    test = parts["test"]
    known = np.isin(test.labels, CLASSES)
    simulated = town(options.town, 15.0)
    rows: list[dict[str, Any]] = []

    def score(kind: str, what: str, seed: int | None, fit: Any, *given: Any, **more: Any) -> Any:
        began = time.process_time()
        model = fit(*given, **more)
        trained = time.process_time() - began
        found = model.predict(test.xyz, test.dimensions).classification
        accuracy = Accuracy.from_labels(test.labels[known], found[known], classes=CLASSES)
        f1 = {str(one.code): round(100 * (one.f1 or 0.0), 2) for one in accuracy.per_class}
        figures = {
            "oa": round(100 * accuracy.overall_accuracy, 2),
            "mean_f1": round(float(np.mean(list(f1.values()))), 2),
        }
        rows.append(
            {"kind": kind, "what": what, "seed": seed, **figures, "f1": f1, "training_cpu": round(trained)}
        )
        print(json.dumps(rows[-1]), flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n")
        return model

    def network(clouds: list[TrainingCloud], seed: int, epochs: int, **more: Any) -> Any:
        own = {"configuration": "small", "validation": 0, "epochs": epochs, "learning_rate": 0.003, **more}
        how = TrainingOptions(
            algorithm="alsnet", alsnet=own, dimensions=("HeightAboveGround",), classes=list(CLASSES), seed=seed,
            voxel=0.0,
        )  # fmt: skip
        return train(clouds, how, progress=False)

    if "forest" in options.kind:
        how = replace(FOREST, classes=list(CLASSES))
        base = score("forest", "town", None, train, [simulated], how, progress=False)
        score("forest", "all of Delft's labels", None, train, [parts["train"]], how, progress=False)
        on_top = replace(how, base=base)
        for seed in range(options.seeds):
            real = few(parts["train"], seed)
            score("forest", "1 %", seed, train, [real], how, progress=False)
            score("forest", "town and 1 %", seed, train, [simulated, real], how, progress=False)
            score("forest", "1 % on top of town", seed, train, [real], on_top, progress=False)
    if "alsnet" in options.kind:
        with tempfile.TemporaryDirectory() as folder:
            start = str(Path(folder) / "town.model")
            before, after = options.epochs
            score("alsnet", "town", None, network, [simulated], 0, before).save(start)
            for seed in range(options.seeds):
                labeled = [few(parts["train"], seed)]
                score("alsnet", "town, then 1 %", seed, network, labeled, seed, after, start_from=start)
                score("alsnet", "1 %, epochs of both", seed, network, labeled, seed, before + after)
                score("alsnet", "1 %", seed, network, labeled, seed, after)


if __name__ == "__main__":
    main()
