"""Buildings and trees of generated towns by the side of the cells and the density of points, by their true classes.

python benchmarks/objectcells.py [--seeds 3 4]

The share of true buildings of which 80 % of the area is covered by outlines, and F1 of trees of 3 m and more. Towns of 8
points/m2 are thinned by a hash of the coordinates. `taken` is what ``pdal-stages objects`` takes by itself.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import shapely

from pdal_stages.base.hashing import coordinate_hash
from pdal_stages.objects import Cells, ObjectSettings, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.compare import compare_buildings, matched_by_place
from pdal_stages.objects.outlines import raw_outlines, straight_outlines
from pdal_stages.synthetic import TownOptions, make_town
from pdal_stages.synthetic.truth import true_objects

sys.path.insert(0, str(Path(__file__).parent))
from objects import DENSITY, SIZE, STEP, true_buildings

DENSITIES, SIDES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), (0.5, 1.0, 2.0, 4.0)


def scores(cells, houses, trees, square):
    """Share of houses covered, F1 of trees."""
    size = cells.size
    found = find_objects(cells, ObjectSettings(cell=size), progress=False)
    raw = raw_outlines(found.tables[Kind.BUILDING], size)
    shapes = [shapely.transform(s, lambda xy: xy * size) for s in straight_outlines(raw, size)]
    table = found.tables[Kind.TREE].columns
    at = np.column_stack([table["x"], table["y"]])
    inner = shapely.contains_xy(square.buffer(-2), *at.T)
    places, high = np.array([(t.x, t.y) for t in trees]), np.array([t.height for t in trees])
    pairs = matched_by_place(at[inner], table["height"][inner], places, high)
    covered = compare_buildings(shapes, houses)["covered"]
    return covered, 2 * len(pairs) / (inner.sum() + len(places))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4])
    rows: dict = {}
    for seed in parser.parse_args().seeds:
        made = make_town(SIZE, DENSITY, seed, progress=False)
        true = true_objects(TownOptions(SIZE, DENSITY, seed))
        x0, y0 = made.options.origin[:2]
        square = shapely.box(x0, y0, x0 + SIZE, y0 + SIZE)
        houses = [h.intersection(square) for h in true_buildings(true.houses, STEP)]
        houses = [h for h in houses if h.area >= 4]
        inside = square.buffer(-2)
        trees = [t for t in true.trees if t.height >= 3 and inside.contains(shapely.Point(t.x, t.y))]
        chance = coordinate_hash(made.xyz, 0) / 2.0**64
        for density in DENSITIES:
            kept, taken = chance < density / DENSITY, 0.0
            for side in SIDES:
                cells = Cells.of(*made.xyz[kept].T, made.classification[kept], side)
                taken = taken or (side if not cells.thin() or side == SIDES[-1] else 0.0)
                rows.setdefault((density, side), []).append(scores(cells, houses, trees, square))
            rows.setdefault((density, "taken"), []).append(taken)
    print("| points/m² | " + " | ".join(f"{side:g} m" for side in SIDES) + " | taken |")
    print("|---:|" + "---:|" * (len(SIDES) + 1))
    for density in DENSITIES:
        cell = (np.mean(rows[density, side], axis=0) for side in SIDES)
        shown = " | ".join(f"{100 * covered:.0f} % / {f1:.2f}" for covered, f1 in cell)
        print(f"| {density:g} | {shown} | {', '.join(f'{t:g}' for t in rows[density, 'taken'])} |")


if __name__ == "__main__":
    main()
