"""Which kernels each stage calls with its defaults: what a first job says that it will compile.

    python benchmarks/kernels.py            # writes pdal_stages/stages/kernels.json
    python benchmarks/kernels.py --check    # 1 where it says something else

On a generated town with a viaduct's heights, by the shipped model. Kernels called by other kernels are compiled within
them and not counted. What the command `warmup` compiles stands beside the stages.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import pdal_stages as ps
from pdal_stages.base import jit
from pdal_stages.classifier.warmup import features_part, other_part, warmup
from pdal_stages.stages import registry
from pdal_stages.synthetic import TownOptions, write_town
from pdal_stages.synthetic.demo import compile_kernels

TARGET = Path(jit.__file__).parents[1] / "stages" / "kernels.json"


def called(folder: Path) -> dict[str, list[str]]:
    """Names of kernels, by the type of the stage that calls them."""
    found: dict[str, set[str]] = defaultdict(set)
    running: list[str] = []
    kernel = jit.Kernel.__call__

    def call(self, *arguments):
        if running:
            module = self.__wrapped__.__module__.partition(".")[2]
            found[running[-1]].add(f"{module}.{self.__wrapped__.__name__}")
        return kernel(self, *arguments)

    def watched(kind, run):
        def run_watched(self, points):
            running.append(kind)
            try:
                return run(self, points)
            finally:
                running.pop()

        return run_watched

    jit.Kernel.__call__ = call
    for kind, stage in registry.stages().items():
        stage.run = watched(kind, stage.run)
    town = folder / "town.laz"
    write_town(TownOptions(size=120, density=8, seed=1), town)
    for row in _rows(town, folder):
        ps.Pipeline(row).execute()
    running.append("warmup")
    for part in (features_part, other_part, compile_kernels, warmup):
        part()
    return {kind: sorted(names) for kind, names in sorted(found.items())}


def _rows(town: Path, folder: Path):
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17], "decks": True}
    yield [
        str(town),
        {"type": "filters.detachednoise"},
        heights,
        {"type": "filters.modelclassifier", "model": "standard"},
        {"type": "filters.bridges"},
        {"type": "filters.wires"},
        {"type": "filters.consistency"},
        {"type": "filters.objects"},
        {"type": "writers.objects", "filename": str(folder / "objects.geojson")},
    ]
    yield [
        str(town),
        {"type": "filters.hag_minima"},
        {"type": "filters.multiscalefeatures"},
    ]
    yield [
        str(town),
        heights,
        {"type": "writers.classifiermodel", "filename": str(folder / "town.model"), "count": 200, "trees": 2},
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args().check
    with TemporaryDirectory() as folder:
        text = json.dumps(called(Path(folder)), indent=1) + "\n"
    if check:
        noted, now = json.loads(TARGET.read_text()), json.loads(text)
        for kind in sorted(noted.keys() | now.keys()):
            more, less = (
                set(a.get(kind, ())) - set(b.get(kind, ())) for a, b in ((now, noted), (noted, now))
            )
            if more or less:
                print(f"{kind}: called and not noted {sorted(more)}, noted and not called {sorted(less)}")
        return int(noted != now)
    TARGET.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
