"""An error map of each paper's recipe: train, classify the test part, draw heights, classes and
errors side by side.

    python benchmarks/papers/maps.py --data DIR --out docs/pictures [--only NAME ...]

Prints overall accuracy and mean F1 of each, which the pictures show. [W18] takes 10,000 samples per
class; [WM19]'s network is the small configuration, which trains on a CPU.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from PIL import Image

from pdal_stages import TrainingCloud, TrainingOptions, hag_minima, train
from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.classifier.training_options import with_recipe
from pdal_stages.reports.pictures import triptych

#: Pixels of the longer side and colors of a picture: under 400 kB in a repository.
WIDTH = 900
COLORS = 64
DELFT = ("delft/train.laz", "delft/test.laz", (1, 2, 6))
MONTPELLIER = ("montpellier/train_*.laz", "montpellier/test_*.laz", (2, 3, 4, 5, 6))
OAKLAND = ("oakland/train/*.laz", "oakland/test/oakland_part2_ac.laz", (2, 5, 6, 14, 15))
#: By recipe: training and test parts with their classes, and options that make it fit a small
#: machine.
MAPS: dict[str, tuple[tuple[str, str, tuple[int, ...]], dict[str, Any]]] = {
    "blomley2016": (DELFT, {}),
    "weinmann2018": (MONTPELLIER, {"count": 10_000}),
    "he2017": (OAKLAND, {}),
    "winiwarter2019": (MONTPELLIER, {"alsnet": {"configuration": "small", "epochs": 20}}),
}


def read(data: Path, pattern: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return coordinates (n, 3), labels (n,) and the dimensions that recipes read."""
    parts = [laspy.read(path) for path in sorted(data.glob(pattern))]
    xyz = np.concatenate([np.column_stack([las.x, las.y, las.z]) for las in parts])
    labels = np.concatenate([np.asarray(las.classification) for las in parts])
    names = {
        "Intensity": "intensity",
        "ReturnNumber": "return_number",
        "NumberOfReturns": "number_of_returns",
    }
    dimensions = {
        name: np.concatenate([np.asarray(las[word]) for las in parts])
        for name, word in names.items()
    }
    dimensions["HeightAboveGround"] = hag_minima(*xyz.T)
    return xyz, labels, dimensions


def options_of(recipe: str, more: dict[str, Any]) -> TrainingOptions:
    """Return the options of a recipe with others beside it."""
    options = with_recipe({"recipe": recipe, **more})
    del options["recipe"]
    return TrainingOptions(**options)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--only", nargs="+", default=list(MAPS), choices=list(MAPS))
    options = parser.parse_args()
    for recipe in options.only:
        (training, test, classes), more = MAPS[recipe]
        chosen = options_of(recipe, {"folds": 0, "classes": list(classes), **more})
        xyz, labels, dimensions = read(options.data, training)
        model = train(TrainingCloud(xyz, labels, dimensions, name=recipe), chosen)
        xyz, truth, dimensions = read(options.data, test)
        predicted = model.predict(xyz, dimensions).classification
        scored = np.isin(truth, classes)
        accuracy = Accuracy.from_labels(truth[scored], predicted[scored], classes=list(classes))
        oa, f1 = 100 * (accuracy.overall_accuracy or 0), 100 * (accuracy.mean_f1 or 0)
        print(f"{recipe}: OA {oa:.1f}, mean F1 {f1:.1f}", flush=True)
        picture = triptych(*xyz[scored].T, predicted[scored], truth[scored])
        image = Image.fromarray(picture)
        image.thumbnail((WIDTH, WIDTH))
        image.quantize(COLORS).save(options.out / f"paper-{recipe}.png", optimize=True)


if __name__ == "__main__":
    main()
