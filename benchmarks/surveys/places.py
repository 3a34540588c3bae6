"""Ten places chosen by chance among the errors on surveys left out, as pictures: heights, classes, errors.

    python benchmarks/surveys/places.py --data DIR --models MODELS --json benchmarks/results/surveys-places.json \\
        --picture docs/pictures/standard-places.png

MODELS is what ``leave_one_out.py --save`` filled. A survey is drawn, then one of its wrong points; the square around it is
shown, and one line tells what the labels and what the model say there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from clouds import load, slug
from leave_one_out import NAMES
from surveys import SURVEYS

from pdal_stages import load_model
from pdal_stages.reports.views import BACKGROUND, triptych, write_png

SIDE, WIDTH, COLUMNS = 40.0, 780, 2


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--models", type=Path, required=True, help="folder of the models")
    options.add_argument("--json", type=Path, required=True, help="where the list goes")
    options.add_argument("--picture", type=Path, required=True, help="the picture")
    options.add_argument("--seed", type=int, default=1)
    args = options.parse_args()
    random = np.random.default_rng(args.seed)
    shown, told = [], []
    for survey in random.permutation(list(SURVEYS))[: 5 * COLUMNS]:
        cloud = load(args.data, survey)
        found = load_model(args.models / f"{slug(survey)}.model").predict(cloud.xyz, cloud.dimensions)
        codes, known = found.classification, cloud.truth > 0
        wrong = np.flatnonzero(known & (codes != cloud.truth))
        if not len(wrong):
            continue
        at = random.choice(wrong)
        near = known & (np.abs(cloud.xyz[:, :2] - cloud.xyz[at, :2]).max(axis=1) < SIDE / 2)
        shown.append(triptych(*cloud.xyz[near].T, codes[near], cloud.truth[near], width=WIDTH))
        x, y, z = cloud.xyz[at]
        says = f"{NAMES[int(cloud.truth[at])]} is called {NAMES[int(codes[at])]}"
        told.append(f"{survey} ({x:.0f}, {y:.0f}, {z:.0f}): {says}")
        print(told[-1], flush=True)
    write_png(args.picture, sheet(shown))
    args.json.write_text(json.dumps(told, indent=1) + "\n")


def sheet(pictures: list[np.ndarray], gap: int = 16) -> np.ndarray:
    """Pictures in rows, left to right."""
    tall, wide = (max(picture.shape[axis] for picture in pictures) + gap for axis in (0, 1))
    rows = -(-len(pictures) // COLUMNS)
    out = np.full((rows * tall, COLUMNS * wide, 3), BACKGROUND, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = number // COLUMNS * tall, number % COLUMNS * wide
        out[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return out


if __name__ == "__main__":
    main()
