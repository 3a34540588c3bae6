"""How well `review` tells where the errors are.

    python benchmarks/surveys/review.py --data DIR --models MODELS

MODELS is the folder that leave_one_out.py --save filled. Each survey is classified, by the command,
with the model that has not seen its group. The table: points expected wrong beside those that are,
and the share of the wrong points in the patches that come first, up to a tenth of the area, beside
what knowing the truth would find.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import laspy
import numpy as np
from clouds import model_without, slug, true_classes
from surveys import SURVEYS

from pdal_stages import cli
from pdal_stages.review.expected_errors import ReviewCells, cell_side, find_patches

#: The part of the area that is looked at first.
FIRST = 0.1


@dataclass
class Classified:
    """A survey's points as a model that has not seen it classified them."""

    name: str
    xyz: np.ndarray
    codes: np.ndarray
    reliability: np.ndarray
    height: np.ndarray
    label: np.ndarray

    @cached_property
    def truth(self) -> np.ndarray:
        """True classes, 0 where they are not known."""
        x, y, _ = self.xyz.T
        return true_classes(SURVEYS[self.name], x, y, self.label, self.height)


def classified(data: Path, name: str, model: Path, kept: Path) -> Classified:
    """Return a survey's files, classified by the command; kept as long as the model is the same."""
    path = kept / f"{slug(name)}.npz"
    if not path.exists() or path.stat().st_mtime < model.stat().st_mtime:
        with tempfile.TemporaryDirectory() as folder:
            np.savez(path, **_classify(data, name, model, Path(folder)))
    with np.load(path) as held:
        return Classified(name, **{key: held[key] for key in held.files})


def _classify(data: Path, name: str, model: Path, folder: Path) -> dict[str, np.ndarray]:
    survey = SURVEYS[name]
    (folder / "raw").mkdir()
    codes = []
    for number, file in enumerate(survey.files):
        las = laspy.read(data / file)
        if str(las.header.version) == "1.0":  # which laspy does not write
            las = laspy.convert(las, file_version="1.2")
        las.points = las.points[~np.isin(las[survey.dimension], survey.dropped)]
        codes.append(np.asarray(las[survey.dimension]).astype(np.uint8))
        las.write(folder / "raw" / f"{number}.laz")
    inputs = [str(path) for path in sorted((folder / "raw").iterdir())]
    target = str(folder / "classified") + "/"
    assert cli.main(["classify", *inputs, target, "--model", str(model), "--no-progress"]) == 0
    found = [laspy.read(folder / "classified" / Path(one).name) for one in inputs]
    label = np.concatenate(codes)
    height = np.concatenate([np.asarray(las["HeightAboveGround"]) for las in found]).astype(
        np.float32
    )
    xyz = np.concatenate([np.column_stack([las.x, las.y, las.z]) for las in found]).astype(float)
    out = {
        "xyz": xyz,
        "codes": np.concatenate([np.asarray(las.classification) for las in found]).astype(np.uint8),
        "reliability": np.concatenate([np.asarray(las["Reliability"]) for las in found]).astype(
            np.float32
        ),
        "height": height,
        "label": label,
    }
    there = ~np.isin(out["codes"], (7, 18)) & (out["reliability"] > 0)  # overlap keeps its class
    return {key: values[there] for key, values in out.items()}


def judged(one: Classified) -> tuple[int, int, float, float, float]:
    """Return points judged, wrong, expected wrong, and the shares of the wrong in the first tenth.

    These are of the area, by the list and at best.
    """
    known = (one.truth > 0) & np.isin(one.codes, (2, 3, 4, 5, 6))
    codes, wrong = one.codes[known], one.codes[known] != one.truth[known]
    xyz, reliability = one.xyz[known], one.reliability[known]
    side = cell_side(len(xyz), 16.0 * len(np.unique(np.floor(xyz[:, :2] / 4.0), axis=0)))
    cells, truth = (
        ReviewCells.from_points(xyz, codes, reliability, side),
        ReviewCells.from_points(xyz, codes, 1.0 - wrong, side),
    )
    true = truth.errors.sum(axis=1)
    found = [_first(each, true) for each in (cells, truth)]
    return len(codes), int(wrong.sum()), float(cells.errors.sum()), *found


def _first(cells: ReviewCells, true: np.ndarray) -> float:
    """Return the share of the wrong points in the patches first in line, a tenth of the area."""
    patches = find_patches(cells)
    if not len(patches):
        return 0.0
    area, held = (
        np.cumsum(patches.area),
        np.cumsum(np.bincount(patches.of_cell, true, len(patches))),
    )
    at = np.interp(FIRST * area[-1], np.append(0.0, area), np.append(0.0, held))
    return float(at / max(held[-1], 1))


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument(
        "--models", type=Path, required=True, help="folder that leave_one_out.py --save filled"
    )
    options.add_argument("--surveys", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    args = options.parse_args()
    print(
        "| survey | points judged | wrong | expected | in the first 10 % | at best "
        "|\n|---|---:|---:|---:|---:|---:|"
    )
    for name in args.surveys:
        model = model_without(args.models, name)
        survey = classified(args.data, name, model, args.models)
        points, wrong, expected, found, best = judged(survey)
        print(
            f"| {name} | {points:,} | {wrong:,} | {expected:,.0f} | {found:.0%} | {best:.0%} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
