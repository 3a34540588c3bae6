"""Objects of generated towns and of Delft's train part against what truly stands there.

python benchmarks/objects.py [--data FOLDER [--picture FILE]] python benchmarks/objects.py
--classified MODEL... [--refuse REASON,...] [--flags FLAG,...]  (a row a model)
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path

import numpy as np
import shapely

from pdal_stages import Cells, ObjectSettings, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.outlines import raw_outlines, straight_outlines
from pdal_stages.synthetic import make_town
from pdal_stages.synthetic.town import ORIGIN

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from object_accuracy import compare_buildings, match_by_place
from town_truth import true_objects

SIZE = 300.0
DENSITY = 8.0
#: Two roofs are one building where they differ by at most STEP along a third of the wall they
#: share.
STEP = 2.5
SHARE = 0.34
TOUCHING = 0.6


def true_buildings(houses, step):
    """Outlines of buildings: houses that touch and whose roofs meet; a `step` of 0: all that
    touch."""
    shapes = [shapely.Polygon(house.corners) for house in houses]
    parent = list(range(len(shapes)))

    def root(n):
        while parent[n] != n:
            n = parent[n]
        return n

    for a, b in itertools.combinations(range(len(shapes)), 2):
        if shapes[a].distance(shapes[b]) >= TOUCHING:
            continue
        near = []
        for first, other in ((a, b), (b, a)):
            edge = shapes[first].exterior
            places = shapely.line_interpolate_point(edge, np.arange(0, edge.length, 0.25))
            places = shapely.get_coordinates(
                places[shapely.dwithin(shapes[other], places, TOUCHING)]
            )
            near.append(
                np.abs(houses[a].height(places) - houses[b].height(places)) <= (step or np.inf)
            )
        near = np.concatenate(near)
        if len(near) and near.mean() >= SHARE:
            parent[root(a)] = root(b)
    groups = {}
    for n, shape in enumerate(shapes):
        groups.setdefault(root(n), []).append(shape)
    joined = [
        shapely.union_all(shapely.buffer(g, 0.3, join_style="mitre")) for g in groups.values()
    ]
    return [shape.buffer(-0.3, join_style="mitre") for shape in joined]


def town(seed, codes=None, refuse=()):
    """Figures of a town, by its true classes or by others (`codes`: of a town its codes and
    reliabilities).

    `refuse`: reasons of objects that are left out.
    """
    town_points = make_town(SIZE, DENSITY, seed, progress=False)
    true = true_objects(SIZE, seed)
    x0, y0 = ORIGIN[:2]
    square = shapely.box(x0, y0, x0 + SIZE, y0 + SIZE)
    codes, reliability = (town_points.classification, None) if codes is None else codes(town_points)
    cells = Cells.from_points(*town_points.xyz.T, codes, 0.5, reliability=reliability)
    rows = {}
    for step in (0.0, STEP):
        started = time.process_time()
        objects, _ = find_objects(cells, ObjectSettings(step=step), progress=False).without(refuse)
        raw = raw_outlines(objects.tables[Kind.BUILDING], 0.5)
        shapes = [shapely.transform(s, lambda xy: xy / 2) for s in straight_outlines(raw)]
        seconds = time.process_time() - started
        houses = [h.intersection(square) for h in true_buildings(true.houses, step)]
        rows[f"buildings, step {step:g}"] = (
            compare_buildings(shapes, [h for h in houses if h.area >= 4]),
            seconds,
        )
    trees = [
        t
        for t in true.trees
        if t.height >= 3 and square.buffer(-2).contains(shapely.Point(t.x, t.y))
    ]
    places, high = np.array([(t.x, t.y) for t in trees]), np.array([t.height for t in trees])
    radius = np.array([t.radius for t in trees])
    table = objects.tables[Kind.TREE].columns
    at = np.column_stack([table["x"], table["y"]])
    inner = shapely.contains_xy(square.buffer(-2), *at.T)
    at, tall = at[inner], table["height"][inner]
    pairs = match_by_place(at, tall, places, high)
    away = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    np.fill_diagonal(away, np.inf)
    alone = (away > radius[:, None] + radius[None] + 0.5).all(1)
    extra = sorted(set(range(len(at))) - {a for a, _ in pairs})
    wrong = sum(alone[np.argmin(np.hypot(*(places - at[n]).T))] for n in extra)
    hit = sum(alone[b] for _, b in pairs)
    rows["trees"] = 2 * len(pairs) / (len(at) + len(places)), 2 * hit / (hit + wrong + alone.sum())
    return rows


def delft(data, picture=None):
    """Figures of Delft's train part by its own classes: houses covered, area, boundary; and a
    picture of a part."""
    import json

    import laspy

    las = laspy.read(Path(data) / "delft" / "train.laz")
    xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
    objects = find_objects(Cells.from_points(*xyz.T, codes, 0.5), progress=False)
    raw = raw_outlines(objects.tables[Kind.BUILDING], 0.5)
    listed = json.loads((Path(data) / "delft" / "buildings_train.geojson").read_text())["features"]
    true = [shapely.make_valid(shapely.from_geojson(json.dumps(f["geometry"]))) for f in listed]
    for name, shapes in (("cells", raw), ("straight", straight_outlines(raw))):
        shapes = [shapely.transform(s, lambda xy: xy / 2) for s in shapes]
        got = compare_buildings(shapes, true)
        print(
            f"Delft, {name}: {100 * got['covered']:.1f} % of {len(true)} outlines covered by 80 % "
            "or more, "
            f"{100 * got['area']['completeness']:.1f} % of their area, boundary "
            f"{got['boundary']['median']:.2f} m, "
            f"95 %: {got['boundary']['p95']:.2f} m"
        )
    if picture:
        draw(picture, {(58, 116, 214): true, (190, 30, 36): shapes}, true)


def draw(path, colored, around, size=(170, 140), pixels=5, finer=3):
    """Outlines by color, in the middle of what they are `around`: `size` in meters, `pixels` a
    meter."""
    from PIL import Image, ImageDraw

    west, south, east, north = shapely.total_bounds(around)
    corner = np.array([(west + east - size[0]) / 2, (south + north + size[1]) / 2])
    image = Image.new("RGB", tuple(side * pixels * finer for side in size), "white")
    pen = ImageDraw.Draw(image)
    for color, shapes in colored.items():
        for ring in (
            ring for part in shapely.get_parts(shapes) for ring in [part.exterior, *part.interiors]
        ):
            at = (shapely.get_coordinates(ring) - corner) * (pixels * finer, -pixels * finer)
            pen.line([tuple(xy) for xy in at], color, 2 * finer, joint="curve")
    image.reduce(finer).quantize(64).save(path)


def classified(model, flags=()):
    """Codes and reliabilities of a town by a model file, as `pdal-stages classify` gives them."""

    def codes(made):
        import tempfile

        import laspy

        from pdal_stages.cli import main
        from pdal_stages.synthetic import write_town

        with tempfile.TemporaryDirectory() as folder:
            write_town(made, f"{folder}/town.laz")
            main(["classify", f"{folder}/town.laz", f"{folder}/out.laz", "--model", model, *flags])
            las = laspy.read(f"{folder}/out.laz")
            return np.asarray(las.classification), np.asarray(las["Reliability"], float)

    return codes


def row(model, seeds, refuse, flags):
    """F1 of buildings, all trees, isolated ones in towns classified by a model: mean and least."""
    by = classified(model, flags) if model != "true" else None
    figures = []
    for seed in seeds:
        objects = town(seed, by, refuse)
        figures.append(
            [objects[f"buildings, step {STEP:g}"][0]["objects"]["f1"], *objects["trees"]]
        )
        print(f"{model}, town {seed}: {np.round(figures[-1], 3)}", flush=True)
    print(f"{model} {' '.join(flags)}, refuse {','.join(refuse)}: mean "
          f"{np.round(np.mean(figures, axis=0), 3)}, "
          f"least {np.min(np.round(figures, 3), axis=0)}", flush=True)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", help="folder of the real clouds")
    parser.add_argument(
        "--picture", metavar="FILE", help="of the outlines in Delft over the official ones"
    )
    parser.add_argument(
        "--classified",
        metavar="MODEL",
        nargs="+",
        help="classes by models instead of the true ones; 'true' for these",
    )
    parser.add_argument(
        "--refuse", default="", help="reasons of objects that are left out, parted by commas"
    )
    parser.add_argument(
        "--flags", default="", help="more flags of classify, parted by commas: wires,bridges"
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
    options = parser.parse_args()
    for model in options.classified or ():
        flags = [f"--{flag}" for flag in options.flags.split(",") if flag]
        row(model, options.seeds, [r for r in options.refuse.split(",") if r], flags)
    for seed in () if options.classified else options.seeds:
        for name, value in town(seed).items():
            if name == "trees":
                print(f"town {seed}, trees: F1 {value[0]:.3f}, isolated ones {value[1]:.3f}")
            else:
                got, seconds = value
                objects = got["objects"]
                print(
                    f"town {seed}, {name}: F1 {objects['f1']:.3f} ({objects['completeness']:.3f} "
                    "complete, "
                    f"{objects['correctness']:.3f} correct), area IoU {got['area']['iou']:.3f}, "
                    "boundary "
                    f"{got['boundary']['median']:.2f} m, 95 %: {got['boundary']['p95']:.2f} m; "
                    f"{seconds:.2f} CPU s"
                )
    if options.data:
        delft(options.data, options.picture)
