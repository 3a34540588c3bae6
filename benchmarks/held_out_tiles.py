"""How defaults were chosen: each training tile of Montpellier held out in turn, the forest trained on the other three.

Cross-validation over small blocks amid the training points is flattered by what neighbors share; a whole tile that
was never seen is what a user's next tile is. Train parts only.

    python benchmarks/held_out_tiles.py --data FOLDER [--count 2500] [--trees 40] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import laspy
import numpy as np
from sklearn.ensemble import RandomForestClassifier

import pdal_stages as ps

CODES = (2, 3, 4, 5, 6)
#: Name -> (with shape distributions, with HeightAboveLowest, features tried at a split)
SETS = {
    "560 features": (True, False, (0.1,)),
    "560 and HeightAboveLowest": (True, True, (0.1,)),
    "covariance and geometric": (False, False, ("sqrt", 0.1)),
    "the same and HeightAboveLowest": (False, True, ("sqrt", 0.1)),
}
WEIGHTS = (0.0, 0.1, 0.2, 0.3)


def load(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates, labels and tile numbers of all training tiles."""
    parts = [laspy.read(p) for p in sorted(folder.glob("train_*.laz"))]
    xyz = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts])
    labels = np.concatenate([np.asarray(p.classification) for p in parts])
    return xyz, labels, np.repeat(np.arange(len(parts)), [len(p) for p in parts])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--count", type=int, default=2500)
    parser.add_argument("--trees", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if not options.data:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    xyz, labels, tile = load(Path(options.data, "montpellier"))
    rng = np.random.default_rng(options.seed)
    height = ps.hag_minima(*xyz.T)
    known = np.isin(labels, CODES)
    confusions: dict[tuple, np.ndarray] = {}
    for held in np.unique(tile):
        drawn = [np.flatnonzero((tile != held) & (labels == code)) for code in CODES]
        available = np.array([len(rows) for rows in drawn], float)
        drawn = [rng.choice(rows, min(options.count, len(rows)), replace=False) for rows in drawn]
        train = np.concatenate(drawn)
        weight = np.concatenate([np.full(len(rows), options.count / len(rows)) for rows in drawn])
        test = rng.choice(np.flatnonzero((tile == held) & known), 12_000, replace=False)
        queries = np.concatenate([train, test])
        table = ps.compute_features(
            xyz,
            queries,
            "weinmann2018",
            "all,HeightAboveLowest",
            dimensions={"HeightAboveGround": height[queries]},
        )
        shape = np.array([name[:2] in ("A3", "D1", "D2", "D3", "D4") for name in table.names])
        lowest = np.array([name.startswith("HeightAboveLowest") for name in table.names])
        for name, (with_shapes, with_lowest, splits) in SETS.items():
            values = table.values[:, (with_shapes | ~shape) & (with_lowest | ~lowest)]
            for split in splits:
                forest = RandomForestClassifier(
                    options.trees, max_features=split, n_jobs=-1, random_state=options.seed
                )
                forest.fit(values[: len(train)], labels[train], sample_weight=weight)
                probability = forest.predict_proba(values[len(train) :])
                for power in WEIGHTS:
                    found = forest.classes_[(probability * available**power).argmax(axis=1)]
                    matrix = confusions.setdefault(
                        (name, split, power), np.zeros((len(CODES), len(CODES)), int)
                    )
                    np.add.at(
                        matrix, (np.searchsorted(CODES, labels[test]), np.searchsorted(CODES, found)), 1
                    )
        print(f"tile {held + 1} of {tile.max() + 1} held out", flush=True)
    print(
        "\n| features | tried at a split | prior_weight | OA | 3, 4, 5 merged | mean F1 |\n|---|---|---:|---:|---:|---:|"
    )
    for (name, split, power), matrix in confusions.items():
        accuracy = ps.Accuracy.from_confusion(matrix, CODES)
        merged = accuracy.merge({5: [3, 4]})
        print(
            f"| {name} | {split} | {power:g} | {100 * accuracy.overall_accuracy:.1f} | "
            f"{100 * merged.overall_accuracy:.1f} | {100 * accuracy.mean_f1:.1f} |"
        )


if __name__ == "__main__":
    main()
