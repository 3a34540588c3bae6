"""An error map of each paper's recipe: train, classify the test part, draw heights, classes and
errors side by side.

    python benchmarks/papers/maps.py --data DIR --out docs/pictures [--only NAME ...]
    python benchmarks/papers/maps.py --data DIR --out OUT --only weinmann2018-binary --scene vaihingen

Prints overall accuracy and mean F1 of each, which the pictures show. [W18] takes 10,000 samples per
class; [WM19]'s network is the small configuration, which trains on a CPU. The picture of the binary
recipe is [W18 Figure 4]: the classes of the multi-class recipe and of one binary model per target.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from PIL import Image
from pts_input import read_pts
from w18 import TARGETS

from pdal_stages import TrainingCloud, TrainingOptions, hag_minima, train
from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.classifier.class_map import ClassMap
from pdal_stages.classifier.training_options import RECIPES, with_recipe
from pdal_stages.reports.pictures import (
    CLASS_COLORS,
    HEIGHT_COLORS,
    paint,
    ramp,
    shading,
    surface,
    triptych,
)

#: Pixels of the longer side and colors of a picture: under 400 kB in a repository.
WIDTH = 900
COLORS = 64
#: The picture of several models.
FIGURE_4 = "weinmann2018-binary"
#: Scene -> training part, test part, and labels with what they become.
SCENES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "delft": ("delft/train.laz", "delft/test.laz", {"1": 1, "2": 2, "6": 6}),
    "montpellier": (
        "montpellier/train_*.laz",
        "montpellier/test_*.laz",
        {"2": 2, "3": 3, "4": 4, "5": 5, "6": 6},
    ),
    "oakland": (
        "oakland/train/*.laz",
        "oakland/test/oakland_part2_ac.laz",
        {"2": 2, "5": 5, "6": 6, "14": 14, "15": 15},
    ),
    "vaihingen": ("vaihingen/train*.pts", "vaihingen/test*.pts", RECIPES["vaihingen"]["classes"]),
}
#: By recipe: the scene, and options that make it fit a small machine.
MAPS: dict[str, tuple[str, dict[str, Any]]] = {
    "blomley2016": ("delft", {}),
    "weinmann2018": ("montpellier", {"count": 10_000}),
    FIGURE_4: ("montpellier", {"count": 10_000}),
    "he2017": ("oakland", {}),
    "winiwarter2019": ("montpellier", {"alsnet": {"configuration": "small", "epochs": 20}}),
}


def read(data: Path, pattern: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return coordinates (n, 3), labels (n,) and the dimensions that recipes read."""
    if pattern.endswith(".pts"):
        cloud = read_pts(sorted(data.glob(pattern)), pattern)
        dimensions = {**cloud.dimensions, "HeightAboveGround": hag_minima(*cloud.xyz.T)}
        return cloud.xyz, cloud.labels, dimensions
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


def classified(
    data: Path, scene: str, recipe: str, more: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return coordinates (n, 3), true and predicted codes (n,) of a test part; prints the score."""
    training, test, classes = SCENES[scene]
    chosen = options_of(recipe, {"folds": 0, "classes": classes, **more})
    xyz, labels, dimensions = read(data, training)
    model = train(TrainingCloud(xyz, labels, dimensions, name=recipe), chosen)
    xyz, labels, dimensions = read(data, test)
    known = ClassMap.parse(chosen.classes)
    known = known if chosen.target is None else known.binary(chosen.target)
    position = known.index(labels)
    scored = position >= 0
    truth = np.array(known.codes)[position[scored]]
    predicted = model.predict(xyz, dimensions).classification[scored]
    accuracy = Accuracy.from_labels(
        truth,
        predicted,
        classes=list(known.codes),
        names=dict(zip(known.codes, known.names, strict=True)),
    )
    f1 = ", ".join(f"{c.name} {100 * (c.f1 or 0):.1f}" for c in accuracy.per_class)
    print(
        f"{recipe}: OA {100 * (accuracy.overall_accuracy or 0):.1f}, kappa "
        f"{100 * (accuracy.kappa or 0):.1f}, mean F1 {100 * (accuracy.mean_f1 or 0):.1f} ({f1})",
        flush=True,
    )
    return xyz[scored], truth, predicted


def figure_4(data: Path, scene: str, more: dict[str, Any]) -> np.ndarray:
    """Return an image of classes: multi-class, then each target against "Background" [W18]."""
    xyz, _, predicted = classified(data, scene, "weinmann2018", more)
    panels = [predicted]
    for target in TARGETS[scene]:
        labels, classes = ",".join(map(str, target)), dict(SCENES[scene][2])
        first = classes[str(target[0])]
        code = int(str(first).partition(" ")[0])
        rest = {label: value for label, value in classes.items() if int(label) not in target}
        binary = {**more, "classes": {labels: first, **rest}, "target": code}
        panels.append(classified(data, scene, FIGURE_4, binary)[2])
    ground = surface(*xyz.T, WIDTH // 2)
    light = shading(ground)
    drawn = [paint(ground, CLASS_COLORS[ground.per_pixel(codes, 0)], light) for codes in panels]
    if len(drawn) % 2:
        drawn.append(paint(ground, ramp(ground.z, HEIGHT_COLORS), light))
    rows = [np.concatenate(drawn[i : i + 2], axis=1) for i in range(0, len(drawn), 2)]
    return np.concatenate(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--only", nargs="+", default=list(MAPS), choices=list(MAPS))
    parser.add_argument("--scene", choices=list(SCENES), help="another scene than a recipe's own")
    options = parser.parse_args()
    for recipe in options.only:
        scene, more = MAPS[recipe]
        scene = options.scene or scene
        if recipe == FIGURE_4:
            picture = figure_4(options.data, scene, more)
        else:
            xyz, truth, predicted = classified(options.data, scene, recipe, more)
            picture = triptych(*xyz.T, predicted, truth)
        image = Image.fromarray(picture)
        image.thumbnail((WIDTH, WIDTH))
        image.quantize(COLORS).save(options.out / f"paper-{recipe}.png", optimize=True)


if __name__ == "__main__":
    main()
