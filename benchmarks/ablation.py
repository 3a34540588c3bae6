"""What each rule and parameter of the ground filter does to real labeled clouds: error with it, and without or with another.

    python benchmarks/ablation.py --data FOLDER [--only NAME ...] [--json FILE]

FOLDER holds the surveys of `surveys/sources.csv`, the ISPRS filter samples, and bridge/pont.laz; what is missing is left
out and named. Each cloud is classified into ground and the rest. Errors are counted over ground, vegetation (4, 5) and
buildings, over all points of the ISPRS samples; low vegetation and unclassified points are not scored. From twelve surveys
clips of 160 m are cut, and a basement, a pit or a canal is dug into the middle of each: points of the hole are not scored.

A rule stays only if, on clouds it was not made for, it lowers the mean error of a kind of clouds by 0.05 points or more, or
rescues a cloud by a whole point, and harms none by more than 0.3. What a row changes by more than 0.15 is listed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parent / "surveys"))
from clouds import mislabeled, published
from surveys import GROUND, SURVEYS, VEGETATION

from pdal_stages.terrain import filtered_ground, smrf

#: A cloud: its kind, (n, 3) coordinates in meters, (n,) 2 ground, 5 and 6 objects, 0 not scored.
Cloud = tuple[str, np.ndarray, np.ndarray]
#: Surveys into which holes are dug: of every landscape, country and density.
DUG = (
    "meadows", "Montpellier", "hamlet", "Delft", "town's edge", "river", "pines", "Amsterdam", "firs", "suburb",
    "bridges", "steep",
)  # fmt: skip
#: Half widths west-east and south-north, and depth, in meters.
HOLES = {"basement": (12.5, 7.5, 3.5), "pit": (12.0, 12.0, 8.0), "canal": (np.inf, 4.0, 3.0)}
#: Half the side of a clip in meters.
CLIP = 80.0
#: Height in meters above the nearest labeled ground from which a point of "everything else" is vegetation.
TALL = 2.0
#: Changes of a cloud's error, in points, that are listed.
LISTED = 0.15


def labeled_survey(data: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a survey's coordinates and truth. Heights come from its labeled ground, never from the filter."""
    known = SURVEYS[name]
    xyz, codes, _ = published(data, known)
    kept = ~np.isin(codes, known.dropped)
    xyz, codes = xyz[kept], codes[kept]
    truth = np.zeros(len(xyz), np.uint8)
    for code, ours in known.labels.items():
        truth[codes == code] = ours
    ground = truth == GROUND
    if known.tall and ground.any():
        _, nearest = cKDTree(xyz[ground, :2]).query(xyz[:, :2])
        height = xyz[:, 2] - xyz[ground, 2][nearest]
        for code, least in known.tall.items():
            truth[(codes == code) & (height >= max(least, TALL))] = VEGETATION
    truth[mislabeled(known, *xyz[:, :2].T)] = 0
    return xyz, truth


def dug(xyz: np.ndarray, truth: np.ndarray, hole: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a clip of a cloud with a hole dug into its middle."""
    away = np.abs(xyz[:, :2] - np.median(xyz[:, :2], axis=0))
    near = (away < CLIP).all(axis=1)
    xyz, truth, away = xyz[near].copy(), truth[near].copy(), away[near]
    west, south, depth = HOLES[hole]
    inside = (away[:, 0] < west) & (away[:, 1] < south)
    xyz[inside, 2] -= depth
    truth[inside] = 0
    return xyz, truth


def read_labeled(path: Path, classes: dict[int, int], other: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a file's coordinates and truth; codes that `classes` does not name become `other`."""
    las = laspy.read(path)
    codes = np.asarray(las.classification)
    truth = np.full(len(codes), other, np.uint8)
    for code, ours in classes.items():
        truth[codes == code] = ours
    return np.column_stack([las.x, las.y, las.z]).astype(float), truth


def clouds(data: Path) -> Iterator[tuple[str, Cloud]]:
    """Yield the name and the cloud of each that is there and has labeled ground."""
    for name in SURVEYS:
        try:
            xyz, truth = labeled_survey(data, name)
        except FileNotFoundError as error:
            print(f"left out: {error.filename} is missing", file=sys.stderr)
            continue
        if (truth == GROUND).any():
            yield name, ("survey", xyz, truth)
            if name in DUG:
                for hole in HOLES:
                    yield f"{name} + {hole}", ("dug", *dug(xyz, truth, hole))
    if (path := data / "bridge" / "pont.laz").exists():
        yield "pont", ("survey", *read_labeled(path, {2: 2, 4: 5, 5: 5, 6: 6}, 0))
    for path in sorted(data.glob("isprs_filter/*.laz")):
        yield path.stem, ("ISPRS", *read_labeled(path, {2: 2}, 5))


@contextmanager
def changed(module: Any, name: str, value: Any) -> Iterator[None]:
    """Give a module's constant or function another value."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def no_outliers(raster: np.ndarray, highest: np.ndarray, cell: float) -> np.ndarray:
    """Find no low outliers."""
    return np.zeros(raster.shape, bool)


def option(**values: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a filter with other options."""
    return lambda xyz: filtered_ground(xyz, **values)["Ground"] == 1


def without(name: str, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return the filter with another value of a name in `terrain.smrf`."""

    def found(xyz: np.ndarray) -> np.ndarray:
        with changed(smrf, name, value):
            return filtered_ground(xyz)["Ground"] == 1

    return found


#: By the words of the table: the ground (n,) bool of coordinates.
ROWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": option(),
    "without low outliers": without("pits", no_outliers),
    "without regaining ground": without("ROUNDS", 0),
    "regained once": without("ROUNDS", 1),
    "surface of 8 m blocks": without("NEAR", 8.0),
    "window 75": option(window=75.0),
    "window 40": option(window=40.0),
    "window 25": option(window=25.0),
    "window 14": option(window=14.0),
    "slope 0.1": option(slope=0.1),
    "slope 0.2": option(slope=0.2),
    "threshold 0.4": option(threshold=0.4),
    "threshold 0.6": option(threshold=0.6),
    "scalar 0.9": option(scalar=0.9),
    "cell 0.5": option(cell=0.5),
}


def error(ground: np.ndarray, truth: np.ndarray) -> float:
    """Return the share of scored points, in percent, that are wrongly called ground or not."""
    scored = truth > 0
    return 100.0 * float(np.mean(ground[scored] != (truth[scored] == GROUND)))


def table(errors: dict[str, dict[str, float]], kinds: dict[str, str]) -> str:
    """Return means by kind of cloud, and what each row changes, as Markdown."""
    base = next(iter(errors.values()))
    each = list(dict.fromkeys(kinds.values()))
    lines = [f"| | {' | '.join(each)} | changes, points |", f"|---|{'---:|' * len(each)}---|"]
    for row, of in errors.items():
        means = [np.mean([of[name] for name in of if kinds[name] == kind]) for kind in each]
        moved = sorted((of[name] - base[name], name) for name in of)
        shown = "; ".join(f"{name} {by:+.2f}" for by, name in moved if abs(by) > LISTED)
        lines.append(f"| {row} | {' | '.join(f'{mean:.2f}' for mean in means)} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("PDAL_STAGES_DATA"))
    parser.add_argument("--only", nargs="+", choices=list(ROWS), help="rows beside the first")
    parser.add_argument("--json", type=Path, help="write every cloud's error here")
    options = parser.parse_args()
    if options.data is None:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    every = dict(clouds(Path(options.data)))
    kinds = {name: kind for name, (kind, _, _) in every.items()}
    errors: dict[str, dict[str, float]] = {}
    for row, found in ROWS.items():
        if options.only and row not in (*options.only, "as it is"):
            continue
        began = time.process_time()
        errors[row] = {name: error(found(xyz), truth) for name, (_, xyz, truth) in every.items()}
        print(f"{row}: {time.process_time() - began:.0f} CPU s", file=sys.stderr, flush=True)
    print(table(errors, kinds))
    if options.json:
        options.json.write_text(json.dumps(errors, indent=1) + "\n")


if __name__ == "__main__":
    main()
