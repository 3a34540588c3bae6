"""What a model makes of the surveys that it was not trained on.

    python benchmarks/surveys/unseen.py --data DIR --model FILE --json JSON --picture docs/pictures/standard-places.png

Every survey as it was flown and thinned to 4 and 1 points per square meter, as by leave_one_out.py. The picture: ten places
chosen by chance among the errors (a survey is drawn, then one of its wrong points), as heights, classes and errors.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from clouds import Cloud, load, thinned
from leave_one_out import NAMES, score
from sources import check
from surveys import SURVEYS

from pdal_stages import Model, load_model
from pdal_stages.reports.views import BACKGROUND, png, triptych

#: Points per square meter that the surveys are thinned to.
THINNED = (4.0, 1.0)
#: Places in the picture: how many, in how many columns, how wide in meters and in pixels.
PLACES, COLUMNS, SIDE, WIDTH = 10, 2, 40.0, 780


def not_trained_on(model: Model) -> list[str]:
    """The surveys of which no copy is among a model's clouds."""
    seen = {cloud["name"].split(",")[0] for cloud in model.info["training"]["clouds"]}
    return [name for name in SURVEYS if name not in seen]


def place(model: Model, cloud: Cloud, random: np.random.Generator) -> tuple[str, np.ndarray] | None:
    """One of a cloud's errors in words, and the square around it; None if there is no error."""
    codes, known = model.predict(cloud.xyz, cloud.dimensions).classification, cloud.truth > 0
    wrong = np.flatnonzero(known & (codes != cloud.truth))
    if not len(wrong):
        return None
    at = random.choice(wrong)
    near = known & (np.abs(cloud.xyz[:, :2] - cloud.xyz[at, :2]).max(axis=1) < SIDE / 2)
    x, y, _ = cloud.xyz[at]
    says = f"{NAMES[int(cloud.truth[at])]} called {NAMES[int(codes[at])]}"
    drawn = triptych(*cloud.xyz[near].T, codes[near], cloud.truth[near], width=WIDTH)
    return f"{cloud.survey} at {x:.0f}, {y:.0f}: {says}", drawn


def sheet(pictures: list[np.ndarray], gap: int = 16) -> np.ndarray:
    """Pictures in rows, left to right."""
    wide = max(picture.shape[1] for picture in pictures) + gap
    rows = []
    for first in range(0, len(pictures), COLUMNS):
        row = pictures[first : first + COLUMNS]
        tall = max(picture.shape[0] for picture in row) + gap
        rows.append(np.full((tall, COLUMNS * wide, 3), BACKGROUND, np.uint8))
        for number, picture in enumerate(row):
            rows[-1][: picture.shape[0], number * wide :][:, : picture.shape[1]] = picture
    return np.concatenate(rows)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--model", type=Path, required=True, help="the model file")
    options.add_argument("--json", type=Path, required=True, help="where the figures go")
    options.add_argument("--picture", type=Path, required=True, help="where the ten places go")
    args = options.parse_args()
    model, random = load_model(args.model), np.random.default_rng(1)
    surveys = not_trained_on(model)
    check(args.data, [file for name in surveys for file in SURVEYS[name].files])
    runs, places = [], []
    for name in random.permutation(surveys):
        cloud = load(args.data, name)
        for one in (cloud, *(thinned(cloud, density) for density in THINNED)):
            if one is not None:
                runs.append(score(model, one))
                print(json.dumps(runs[-1]), flush=True)
        if len(places) < PLACES and (found := place(model, cloud, random)):
            places.append(found)
    order = {name: number for number, name in enumerate(SURVEYS)}
    runs.sort(key=lambda run: order[run["cloud"].split(",")[0]])
    args.picture.write_bytes(png(sheet([drawn for _, drawn in places])))
    told = {"surveys": runs, "places": [words for words, _ in places]}
    args.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
