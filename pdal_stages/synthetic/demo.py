"""Demo on a generated town: train on one half, classify the other, score the result."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from ..base.files import write_json
from ..base.json_types import StageJson
from ..classifier.model_file import STANDARD
from ..stages.preprocessing import PREPARATION

#: Classes of the town that the demo trains; rare ones are left out.
CLASSES = {
    "2": "Ground",
    "3": "Low vegetation",
    "5": "High vegetation",
    "6": "Building",
    "14": "Wire - conductor (phase)",
}


def run_demo(
    folder: str | Path, *, size: float = 200.0, density: float = 7.0, seed: int = 1
) -> None:
    """Generate a town, train, classify, score, draw.

    Everything goes through PDAL, as a user's pipelines would. Files in `folder`: ``town.laz``,
    ``town.model``, ``classified.laz``, ``accuracy.json``, ``accuracy.html``, ``classified.png``,
    ``standard.laz`` (by the model that comes with the package) and the three pipelines.
    """
    from ..pipeline.run import Pipeline
    from ..reports.pictures import triptych, write_png
    from . import make_town, write_town

    folder, started = Path(folder), time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)

    def tell(text: str) -> None:
        """Print the next step of the demo, and the time since its start."""
        print(f"{time.monotonic() - started:6.1f} s  {text}", file=sys.stderr, flush=True)

    tell(f"a town of {size:g} x {size:g} m at {density:g} points/m2 under a simulated flight")
    town = make_town(size, density, seed)
    write_town(town, folder / "town.laz")
    stages = pipelines(folder, float(np.floor((town.x.min() + town.x.max()) / 2)), seed)
    for name, listed in stages.items():
        write_json(folder / f"{name}.json", listed, indent=4)
    tell("training on the western half")
    Pipeline(stages["train"]).execute(arrays=False)
    tell("classifying the eastern half; how right that is")
    job = Pipeline(stages["classify"])
    job.execute()
    tell("the same with the model that comes with the package, trained on real surveys")
    Pipeline(stages["standard"]).execute(arrays=False)
    (points,) = job.arrays
    shown = points[np.isin(points["Reference"], [*map(int, CLASSES)])]
    columns = (shown[name] for name in ("X", "Y", "Z", "Classification", "Reference"))
    write_png(folder / "classified.png", triptych(*columns))
    tell("done: points; a picture of heights, classes and errors; a page of the accuracy:")
    for file in ("classified.laz", "classified.png", "accuracy.html"):
        print(f"  {folder / file}")


def pipelines(folder: Path, middle: float, seed: int) -> dict[str, list[StageJson]]:
    """Return the pipelines ``train``, ``classify``, ``standard`` of a town, divided at an X."""
    town = {"type": "readers.las", "filename": str(folder / "town.laz")}
    las = {"type": "writers.las", "forward": "all", "extra_dims": "all"}
    model = str(folder / "town.model")
    training = {"filename": model, "classes": CLASSES, "count": 5000, "seed": seed}
    eastern = [
        town,
        {"type": "filters.range", "limits": f"X[{middle}:]"},
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        *PREPARATION,
    ]
    accuracy = {
        "type": "filters.accuracy",
        "classes": [int(code) for code in CLASSES],
        "json": str(folder / "accuracy.json"),
        "html": str(folder / "accuracy.html"),
        "model": model,
    }
    return {
        "train": [
            town,
            {"type": "filters.range", "limits": f"X[:{middle})"},
            *PREPARATION,
            {"type": "writers.classifiermodel", **training},
        ],
        "classify": [
            *eastern,
            {"type": "filters.modelclassifier", "model": model, "margin": True},
            accuracy,
            {**las, "filename": str(folder / "classified.laz")},
        ],
        "standard": [
            *eastern,
            {"type": "filters.modelclassifier", "model": STANDARD},
            {"type": "filters.accuracy", "classes": [2, 5, 6], "merge": {"5": [4]}},
            {**las, "filename": str(folder / "standard.laz")},
        ],
    }
