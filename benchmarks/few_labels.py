"""A few labels of a survey that the base has not seen: from nothing, and on top of the base.

    python benchmarks/few_labels.py --data FOLDER [--base MODEL] [--survey bank] [--labels 10 100
    300] [--json FILE]

Of each survey the western half gives labels, drawn at random, as many of each class; the eastern
half is scored (at most 200,000 points of it, drawn once). The base must not know the survey:
benchmarks/surveys trains one without it.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.interface import preprocessing
from pdal_stages.classifier.model import load_model

#: File, what its labels become, codes that are dropped.
SURVEYS = {
    "bank": ("rural/lidarhd_bank.laz", {2: 2, 4: 5, 5: 5, 6: 6}, (65,)),
    "sparse": ("rural/ign_0p3ppm2.laz", {2: 2, 4: 5, 5: 5, 6: 6}, (64, 65, 66, 67)),
    "pines": ("forest/neon_osbs.laz", {2: 2, 5: 5}, (7,)),
}
SCORED = 200_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", required=True, type=Path)
    parser.add_argument("--base", default="standard")
    parser.add_argument("--survey", nargs="+", default=list(SURVEYS), choices=SURVEYS)
    parser.add_argument("--labels", nargs="+", type=int, default=[10, 100, 300])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    base = load_model(options.base)
    rows = [
        row for name in options.survey for row in scores(options.data, name, base, options.labels)
    ]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def scores(folder: Path, name: str, base, counts):
    """Overall accuracies of one survey, a row for each number of labels."""
    file, becomes, dropped = SURVEYS[name]
    las = laspy.read(folder / file)
    there = ~np.isin(las.classification, dropped)
    xyz = np.column_stack([las.x, las.y, las.z])[there]
    table = np.zeros(256, np.int64)
    table[list(becomes)] = list(becomes.values())
    label = table[np.asarray(las.classification)[there]]
    dimensions = dict(
        preprocessing().made_of_coordinates(base.info["preparation"], xyz, None, None)
    )
    dimensions["ReturnNumber"] = np.asarray(las.return_number)[there]
    dimensions["NumberOfReturns"] = np.asarray(las.number_of_returns)[there]
    west = xyz[:, 0] < np.median(xyz[:, 0])
    scored = np.flatnonzero(~west & (label > 0))
    if len(scored) > SCORED:
        scored = np.random.default_rng(1).choice(scored, SCORED, replace=False)
    queries = np.zeros(len(xyz), bool)
    queries[scored] = True

    def score(model) -> float:
        predicted = model.predict(xyz, dimensions, queries).classification
        return 100 * float(np.mean(predicted[queries] == label[queries]))

    alone = score(base)
    print(f"{name}: base {alone:.2f}", flush=True)
    names = (
        "HeightAboveGround",
        "Ground",
        "HeightAboveOpening_5",
        "HeightAboveOpening_17",
        "returns",
    )
    how = TrainingOptions(dimensions=names, folds=0)
    for count in counts:
        random, few = np.random.default_rng(count), np.zeros(len(label), np.int64)
        for code in sorted(set(becomes.values())):
            rows = np.flatnonzero(west & (label == code))
            few[random.choice(rows, min(count, len(rows)), replace=False)] = code
        cloud = TrainingCloud(xyz, few, dimensions, name)
        nothing = score(train([cloud], how, progress=False))
        on_top = score(train([cloud], replace(how, base=base), progress=False))
        print(
            f"{name}, {count} a class: from nothing {nothing:.2f}, on top {on_top:.2f}", flush=True
        )
        yield {
            "survey": name,
            "labels": count,
            "base": alone,
            "from_nothing": nothing,
            "on_top": on_top,
        }


if __name__ == "__main__":
    main()
