"""Demo on a generated town: train on one half, classify the other, score the result."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..base.errors import StageError
from ..base.files import write_json
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
    import numpy as np

    from ..pipeline.run import Pipeline
    from ..reports.pictures import triptych, write_png
    from . import make_town, write_town

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not folder.is_dir():
        raise StageError("the demo's folder cannot be made", found=str(folder))
    with _step(
        f"a town of {size:g} x {size:g} m at {density:g} points/m2 under a simulated flight"
    ):
        town = make_town(size, density, seed)
        write_town(town, str(folder / "town.laz"))
    stages = pipelines(folder, float(np.floor((town.x.min() + town.x.max()) / 2)), seed)
    for name, listed in stages.items():
        write_json(folder / f"{name}.json", listed, indent=4)
    with _step("training on the western half"):
        Pipeline(stages["train"]).execute(arrays=False)
    with _step("classifying the eastern half; how right that is"):
        job = Pipeline(stages["classify"])
        job.execute()
    with _step("the same with the model that comes with the package, trained on real surveys"):
        Pipeline(stages["standard"]).execute(arrays=False)
    with _step("drawing the picture"):
        (points,) = job.arrays
        shown = points[np.isin(points["Reference"], [*map(int, CLASSES)])]
        columns = (shown[name] for name in ("X", "Y", "Z", "Classification", "Reference"))
        write_png(folder / "classified.png", triptych(*columns))
    print("points; a picture of heights, classes and errors; a page of the accuracy:")
    for file in ("classified.laz", "classified.png", "accuracy.html"):
        print(f"  {folder / file}")


def pipelines(folder: Path, middle: float, seed: int) -> dict[str, list[dict[str, Any]]]:
    """Return the pipelines ``train``, ``classify``, ``standard`` of a town, divided at an X."""
    town = {"type": "readers.las", "filename": str(folder / "town.laz")}
    model, las = (
        str(folder / "town.model"),
        {"type": "writers.las", "forward": "all", "extra_dims": "all"},
    )
    train = [
        town,
        {"type": "filters.range", "limits": f"X[:{middle})"},
        *PREPARATION,
        {
            "type": "writers.classifiermodel",
            "filename": model,
            "classes": CLASSES,
            "count": 5000,
            "seed": seed,
        },
    ]
    eastern = [
        town,
        {"type": "filters.range", "limits": f"X[{middle}:]"},
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        *PREPARATION,
    ]
    classify = [
        *eastern,
        {"type": "filters.modelclassifier", "model": model, "margin": True},
        {
            "type": "filters.accuracy",
            "classes": [int(code) for code in CLASSES],
            "json": str(folder / "accuracy.json"),
            "html": str(folder / "accuracy.html"),
            "model": model,
        },
        {**las, "filename": str(folder / "classified.laz")},
    ]
    standard = [
        *eastern,
        {"type": "filters.modelclassifier", "model": STANDARD},
        {"type": "filters.accuracy", "classes": [2, 5, 6], "merge": {"5": [4]}},
        {**las, "filename": str(folder / "standard.laz")},
    ]
    return {"train": train, "classify": classify, "standard": standard}


@contextlib.contextmanager
def _step(text: str) -> Iterator[None]:
    """Print a step of the demo, and the time it took."""
    started = time.monotonic()
    print(f"{text} ...", file=sys.stderr, flush=True)
    yield
    print(f"  done in {time.monotonic() - started:.1f} s", file=sys.stderr, flush=True)
