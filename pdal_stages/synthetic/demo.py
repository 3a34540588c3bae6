"""The main job on a generated town: train on one half, classify the other, say how well."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ..base.errors import StageError
from ..base.files import write_whole
from ..base.version import __version__
from ..models import STANDARD
from ..stages.heights import PREPARATION

#: Classes of the town that the demo tells apart; small ones are left to the reader.
CLASSES = {
    "2": "Ground",
    "3": "Low vegetation",
    "5": "High vegetation",
    "6": "Building",
    "14": "Wire - conductor (phase)",
}


def run_demo(folder: str | Path, *, size: float = 200.0, density: float = 7.0, seed: int = 1) -> dict:
    """Generate, train, classify, compare, draw; the figures of :mod:`pdal_stages.accuracy.measures`.

    Everything goes through PDAL, as a user's pipelines would. Files in `folder`: ``town.laz``, ``town.model``,
    ``classified.laz``, ``accuracy.json``, ``accuracy.html``, ``classified.png``, ``standard.laz`` (by the model that comes
    with the package) and the three pipelines. A second call with the same arguments finds them and only prints the table.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not folder.is_dir():
        raise StageError("the demo's folder cannot be made", found=str(folder))
    settings = {"version": __version__, "size": size, "density": density, "seed": seed}
    stamp = folder / "demo.json"
    names = "classified.laz", "classified.png", "accuracy.html", "accuracy.json", "table.txt"
    outputs = [folder / name for name in names]
    if _same(stamp, settings) and all(path.is_file() for path in outputs):
        print(
            f"{folder} holds the results of this very demo; delete the folder to run it again.",
            file=sys.stderr,
        )
    else:
        stamp.unlink(missing_ok=True)
        _work(folder, size, density, seed)
        write_whole(stamp, json.dumps(settings).encode())
    print((folder / "table.txt").read_text(encoding="utf-8"))
    for path in outputs[:3]:
        print(path)
    return json.loads((folder / "accuracy.json").read_text(encoding="utf-8"))


def compile_kernels() -> None:
    """Compile the kernels that making a town and drawing a map of it need."""
    from ..reports.raster import Frame, surface
    from . import make_town

    town = make_town(20.0, 1.0, threads=1, progress=False)
    surface(town.x, town.y, town.z, Frame.around(town.x, town.y, 16))


def _same(stamp: Path, settings: dict) -> bool:
    try:
        return json.loads(stamp.read_text(encoding="utf-8")) == settings
    except (OSError, ValueError):
        return False


def _work(folder: Path, size: float, density: float, seed: int) -> None:
    import numpy as np

    from ..pipeline.run import Pipeline
    from . import TownOptions, write_town

    town = folder / "town.laz"
    with _step(f"a town of {size:g} x {size:g} m at {density:g} points/m2 under a simulated flight"):
        write_town(TownOptions(size=size, density=density, seed=seed), town)
    bounds = Pipeline([str(town)])
    bounds.execute()
    x = bounds.arrays[0]["X"]
    middle = float(np.floor((x.min() + x.max()) / 2))

    def las(name: str) -> dict:
        return {
            "type": "writers.las",
            "filename": str(folder / name),
            "forward": "all",
            "extra_dims": "all",
        }

    train = [
        {"type": "readers.las", "filename": str(town)},
        {"type": "filters.range", "limits": f"X[:{middle})"},
        *PREPARATION,
        {
            "type": "writers.classifiermodel",
            "filename": str(folder / "town.model"),
            "classes": CLASSES,
            "count": 5000,
            "seed": seed,
        },
    ]
    classify = [
        {"type": "readers.las", "filename": str(town)},
        {"type": "filters.range", "limits": f"X[{middle}:]"},
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        *PREPARATION,
        {"type": "filters.modelclassifier", "model": str(folder / "town.model"), "margin": True},
        {
            "type": "filters.accuracy",
            "classes": [int(code) for code in CLASSES],
            "json": str(folder / "accuracy.json"),
            "html": str(folder / "accuracy.html"),
            "model": str(folder / "town.model"),
            "title": "Classification of the generated town",
            "print": False,
        },
        las("classified.laz"),
    ]
    standard = {"type": "filters.modelclassifier", "model": STANDARD}
    unlabeled = [*classify[:4], standard, las("standard.laz")]
    for name, stages in (("train", train), ("classify", classify), ("standard", unlabeled)):
        write_whole(folder / f"{name}.json", (json.dumps(stages, indent=4) + "\n").encode())
    with _step("training on the western half"):
        Pipeline(train).execute(arrays=False)
    with _step("classifying the eastern half"):
        job = Pipeline(classify)
        job.execute()
    with _step("classifying it with the model that comes with the package, which has never seen such a town"):
        general = Pipeline(unlabeled)
        general.execute()
    _results(folder, job.arrays[0], general.arrays[0])


def _results(folder: Path, points, general) -> None:
    import numpy as np

    from ..accuracy.measures import Accuracy
    from ..reports.panels import triptych
    from ..reports.pictures import write_png

    def pair(found, codes):
        keep = np.isin(found["Reference"], codes)
        return keep, found["Reference"][keep].astype(np.uint8), found["Classification"][keep].astype(np.uint8)

    keep, reference, predicted = pair(points, [int(code) for code in CLASSES])
    own = Accuracy.from_labels(reference, predicted).table()
    _, truth, given = pair(general, [2, 4, 5, 6])
    truth[truth == 4] = 5
    shipped = Accuracy.from_labels(truth, given, classes=[2, 5, 6]).table()
    table = f"Trained on the western half:\n\n{own}\n\nThe model that comes with the package ({STANDARD}):\n\n{shipped}\n"
    write_whole(folder / "table.txt", table.encode())
    x, y, z = (points[axis][keep] for axis in "XYZ")
    with _step("drawing the picture"):
        write_png(folder / "classified.png", triptych(x, y, z, predicted, reference))


@contextlib.contextmanager
def _step(text: str) -> Iterator[None]:
    """Says what is being done, and how long it took."""
    started = time.monotonic()
    print(f"{text} ...", file=sys.stderr, flush=True)
    yield
    print(f"  done in {time.monotonic() - started:.1f} s", file=sys.stderr, flush=True)
