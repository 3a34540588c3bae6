"""alsNet trained on labeled clouds and scored on others.

    python benchmarks/alsnet.py --train A.laz B.laz --test C.laz --classes '{"2": "Ground", "6":
    "Building"}' \
        --network '{"configuration": "small", "epochs": 30}'

Scores are over the test points of the classes trained. Nothing is fitted or chosen on test points:
epochs are chosen on blocks of the training part. Seconds are CPU seconds of the process (all
threads).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import laspy
import numpy as np

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.terrain.minima import hag_minima


def cloud_of(paths: list[Path]) -> TrainingCloud:
    """All files together, heights included."""
    tiles = [laspy.read(path) for path in paths]
    xyz = np.concatenate([tile.xyz for tile in tiles])
    names = {
        "Intensity": "intensity",
        "ReturnNumber": "return_number",
        "NumberOfReturns": "number_of_returns",
    }
    dimensions = {
        our: np.concatenate([np.asarray(tile[name]) for tile in tiles])
        for our, name in names.items()
    }
    labels = np.concatenate([np.asarray(tile.classification) for tile in tiles])
    return TrainingCloud(xyz, labels, {**dimensions, "HeightAboveGround": hag_minima(*xyz.T)})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train", nargs="+", type=Path, required=True)
    parser.add_argument("--test", nargs="+", type=Path, required=True)
    parser.add_argument("--classes", type=json.loads, required=True)
    parser.add_argument(
        "--network", type=json.loads, default={}, help="options of the network, as JSON"
    )
    parser.add_argument("--dimensions", nargs="*", default=["HeightAboveGround"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--save", type=Path, help="the model")
    args = parser.parse_args()
    options = TrainingOptions(
        algorithm="alsnet", alsnet=args.network, dimensions=args.dimensions, classes=args.classes, seed=args.seed,
        threads=args.threads, voxel=0.0,
    )  # fmt: skip
    started = time.process_time()
    model = train([cloud_of(args.train)], options, progress=True)
    print(
        f"trained in {time.process_time() - started:.0f} s, epoch "
        f"{model.info['training']['best_epoch']}"
    )
    if args.save:
        model.save(args.save)
    test = cloud_of(args.test)
    started = time.process_time()
    prediction = model.predict(test.xyz, test.dimensions, threads=args.threads)
    print(f"classified {len(test.xyz):,} points in {time.process_time() - started:.0f} s")
    codes = [code for code, _ in model.classes]
    print(Accuracy.from_labels(test.labels, prediction.classification, classes=codes).table())


if __name__ == "__main__":
    main()
