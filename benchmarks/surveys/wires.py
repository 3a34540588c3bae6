"""Score wires and towers by models that have not seen them.

    python benchmarks/surveys/wires.py --data DIR --models MODELS --surveys FILE --json FILE \\
        [--crops FOLDER]

MODELS are those of `leave_one_out.py --save`, FILE its figures. Strips of the labeled line,
thinned, are classified by models that have neither the strip nor copies of its wires, and single
strands over two surveys, and lines set into all others, by models without their groups.
`--crops` adds helicopter scans of power lines, which no license lets anybody train on, by the
shipped model. Towers are found as `filters.towers` finds them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import laspy
import numpy as np
from clouds import Cloud, load, model_without, slug, thinned
from folds import STRIP_OF_GROUP
from lines import STRIPS, LabeledLine, arrange, hang_strands, labeled_line, string_line
from recipe import set_in
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from surveys import FOREST, GROUND, LINE_SURVEY, SLOPE, SURVEYS, TOWER, WIRE

from pdal_stages.classifier.model import Model, load_model
from pdal_stages.classifier.prediction import Prediction
from pdal_stages.reports.pictures import png, triptych
from pdal_stages.stages.preprocessing import PREPARATION
from pdal_stages.structures.towers import find_towers
from pdal_stages.terrain import detached_noise, filtered_ground

#: Points per square meter of the strips.
STRIP_DENSITIES = (7.0, 2.0)
#: Meters around a strip within which points are neighbors.
MARGIN = 50.0
#: Surveys that single strands are hung over.
LOW_VOLTAGE = ("Seville", "hamlet")
#: Points per square meter that the surveys of the labeled line's group are thinned to.
DUTCH_DENSITY = 2.0
#: Meters above the ground from which towers are scored: labels of their feet hold other things.
TOWER_FROM = 3.0
#: The strip that the card has pictures of.
PICTURED = 1
#: Points per square meter of surveys that lines with towers are set into.
LINE_DENSITIES = (7.0, 2.0)
#: Numbers of lines that are set into each: training has lower ones (`recipe.py`).
LINES = (1000, 1001, 1002)
#: Meters from a line within which points are classified.
NEAR_LINE = 40.0
#: Meters between conductors of lines of low voltage, at most.
CLOSE = 0.6
#: Label of noise of the crops.
NOISE = 7


def lines_model(models: Path) -> Path:
    """Return the model without the survey of the labeled line that still has copies of wires."""
    return models / f"{slug(SURVEYS[LINE_SURVEY].group)}-with-lines.model"


def count(found: np.ndarray, truth: np.ndarray) -> dict[str, int]:
    """Return points of wires and towers: there, found, and false ones among points with a truth."""
    out = {"points": int(np.count_nonzero(truth > 0))}
    for code, name in ((WIRE, "wire"), (TOWER, "tower")):
        out[name] = int(np.count_nonzero(truth == code))
        out[f"{name} found"] = int(np.count_nonzero((truth == code) & (found == code)))
        out[f"{name} false"] = int(
            np.count_nonzero((truth != code) & (truth > 0) & (found == code))
        )
    return out


def with_towers(codes: np.ndarray, xyz: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return classes (n,) with towers, of points (n, 3) with heights (n,)."""
    every = np.ones(len(codes), np.bool_)
    tower = find_towers(xyz, np.asarray(height, float), every, codes == WIRE)
    return np.where(tower, TOWER, codes).astype(np.uint8)


def classified_strips(
    data: Path, models: Path, pictures: Path | None = None
) -> Iterator[tuple[int, float, Prediction, np.ndarray]]:
    """Yield strips of the labeled line: number, density, classes found, truth (n,).

    Each is classified by a model that has neither the strip nor copies of its wires; points outside
    have no truth. `pictures` is the folder for those of the denser strips.
    """
    line, every = labeled_line(data), load(data, LINE_SURVEY)
    low, high = line.ends
    width = (high - low) / STRIPS
    for density in STRIP_DENSITIES:
        cloud = thinned(every, density)
        assert cloud is not None
        place = (cloud.xyz[:, :2] - line.origin) @ line.along - low
        for group, strip in STRIP_OF_GROUP.items():
            after = place - strip * width
            rows = np.flatnonzero((after > -MARGIN) & (after < width + MARGIN))
            part = cloud.taken(rows)
            inside = (after[rows] >= 0) & (after[rows] <= width)
            model = load_model(str(models / f"{slug(group)}.model"))
            found = model.predict(part.xyz, part.dimensions)
            height = part.dimensions["HeightAboveGround"]
            codes = with_towers(found.classification, part.xyz, height)
            found = replace(found, classification=codes)
            if pictures and strip == PICTURED and density == STRIP_DENSITIES[0]:
                draw(
                    line,
                    part.taken(np.flatnonzero(inside)),
                    found.classification[inside],
                    strip,
                    pictures,
                )
            yield strip, density, found, np.where(inside, part.truth, 0)


def draw(line: LabeledLine, cloud: Cloud, found: np.ndarray, strip: int, pictures: Path) -> None:
    """Write pictures of a strip in plan and section: heights, classes, errors."""
    shown = cloud.truth > 0
    x, y, z = (cloud.xyz[shown] - [*line.origin, 0.0]).T
    along, across = line.along @ [x, y], line.along @ [y, -x]
    for name, axes in (("plan", (along, across, z)), ("section", (along, z, across))):
        picture = triptych(*axes, found[shown], cloud.truth[shown])
        (pictures / f"standard-line-{strip}-{name}.png").write_bytes(png(picture))


def strips(data: Path, models: Path) -> list[dict[str, Any]]:
    """Score the strips of the labeled line."""
    out = []
    for strip, density, found, truth in classified_strips(data, models):
        out.append({"strip": strip, "density": density, **count(found.classification, truth)})
        print(out[-1], flush=True)
    return out


def strands(data: Path, models: Path) -> list[dict[str, Any]]:
    """Score single strands over surveys."""
    line, out = labeled_line(data), []
    for name in LOW_VOLTAGE:
        cloud = load(data, name)
        ground = cloud.xyz[:, 2] - cloud.dimensions["HeightAboveGround"]
        strip = STRIP_OF_GROUP[SURVEYS[name].group]
        every = np.ones(len(cloud.xyz), np.uint8)
        hung = set_in(
            replace(cloud, truth=every), hang_strands(line, strip, cloud.xyz, ground, seed=1)
        )
        model = load_model(str(model_without(models, name)))
        found = model.predict(hung.xyz, hung.dimensions).classification
        out.append({"survey": name, **count(found, hung.truth)})
        print(out[-1], flush=True)
    return out


def lines_set_in(data: Path, models: Path) -> list[dict[str, Any]]:
    """Score wires and towers of lines that are set into surveys, of every voltage.

    `tower beside` are false points of towers that are wires.
    """
    line, out = labeled_line(data), []
    for name, survey in SURVEYS.items():
        if survey.tells(WIRE):
            continue
        every, in_group = load(data, name), survey.group in STRIP_OF_GROUP
        model = load_model(str(model_without(models, name) if in_group else lines_model(models)))
        strip = STRIP_OF_GROUP.get(survey.group, line.strip_of_tower)
        for density in LINE_DENSITIES:
            if (cloud := thinned(every, density)) is None:
                continue
            for number in LINES:
                seed = (crc32(name.encode()), number)
                places = arrange(line, np.random.default_rng(list(seed))).conductors
                apart = pdist(places).min() if len(places) > 1 else np.inf
                row = line_set_in(cloud, line, strip, seed, model)
                kind = {"conductors": len(places), "close": bool(apart < CLOSE)}
                out.append({"landscape": survey.landscape, "density": density, **kind, **row})
                print(out[-1], flush=True)
    return out


def line_set_in(
    cloud: Cloud, line: LabeledLine, strip: int, seed: tuple[int, int], model: Model
) -> dict[str, Any]:
    """Score a line that is set into a cloud: the points near it."""
    ground = cloud.xyz[:, 2] - cloud.dimensions["HeightAboveGround"]
    implant = string_line(line, (strip,), cloud.xyz, ground, cloud.density, seed)
    every = np.ones(len(cloud.xyz), np.uint8)
    cloud = set_in(replace(cloud, truth=every), implant)
    if not len(implant.xyz):
        return {"cloud": cloud.name, "number": seed[1], **count(cloud.truth[:0], cloud.truth[:0])}
    near = cKDTree(implant.xyz[:, :2]).query(cloud.xyz[:, :2])[0] < NEAR_LINE
    found = model.predict(cloud.xyz, cloud.dimensions, where=near)
    height = np.asarray(cloud.dimensions["HeightAboveGround"])
    codes = with_towers(found.classification, cloud.xyz, height)
    low = (cloud.truth == TOWER) & (height < TOWER_FROM)
    truth = np.where(near & ~low, cloud.truth, 0)
    beside = int(np.count_nonzero((truth == WIRE) & (codes == TOWER)))
    scores = count(codes, truth)
    return {"cloud": cloud.name, "number": seed[1], **scores, "tower beside": beside}


def false_ones(data: Path, models: Path, runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return counts of wires and towers in surveys that have none.

    Those of `runs` (leave_one_out.py) count, but for the group of the labeled line: its model has
    no wires, so its surveys are classified once more, thinned, by one that has copies of them.
    """
    group, out = SURVEYS[LINE_SURVEY].group, []
    for run in runs:
        if SURVEYS[run["survey"]].group != group:
            counts = {"wire false": run["wires"], "tower false": run["towers"]}
            out.append({"cloud": run["cloud"], "points": run["all"], **counts})
    model = load_model(str(lines_model(models)))
    for name in (name for name, survey in SURVEYS.items() if survey.group == group):
        one = thinned(load(data, name), DUTCH_DENSITY) if name != LINE_SURVEY else None
        if one is not None:
            found = model.predict(one.xyz, one.dimensions).classification
            found = with_towers(found, one.xyz, one.dimensions["HeightAboveGround"])
            counts = {
                f"{word} false": int(np.count_nonzero(found == code))
                for word, code in (("wire", WIRE), ("tower", TOWER))
            }
            out.append({"cloud": one.name, "points": len(found), **counts})
            print(out[-1], flush=True)
    for row in out:
        survey = SURVEYS[row["cloud"].split(",")[0]]
        row["wooded"] = survey.landscape in (FOREST, SLOPE)
    return out


def crops(folder: Path) -> list[dict[str, Any]]:
    """Score helicopter scans by the shipped model, with noise marked and labels taken away."""
    model, out = load_model("standard"), []
    for path in sorted(folder.glob("*.laz")):
        las = laspy.read(path)
        codes = np.asarray(las.classification)
        xyz = np.ascontiguousarray(las.xyz)
        good = detached_noise(*np.ascontiguousarray(xyz.T)) == 0
        xyz, codes = xyz[good], codes[good]
        (stage,) = PREPARATION
        values = filtered_ground(*np.ascontiguousarray(xyz.T), openings=stage["openings"])
        none = np.zeros(len(xyz), np.uint8)
        dimensions = {**values, "ReturnNumber": none, "NumberOfReturns": none}
        found = model.predict(xyz, dimensions).classification
        found = with_towers(found, xyz, values["HeightAboveGround"])
        ground = codes == GROUND
        near = cKDTree(xyz[ground, :2]).query(xyz[:, :2])[1]
        low = xyz[:, 2] - xyz[ground, 2][near] < TOWER_FROM
        truth = np.where((codes == TOWER) & low | (codes == NOISE), 0, np.maximum(codes, 1))
        truth[codes == NOISE] = 0
        out.append({"crop": path.stem, **count(found, truth)})
        print(out[-1], flush=True)
    return out


def summarize(title: str, rows: list[dict[str, Any]]) -> str:
    """Return sums over some rows, as a line."""
    total = {
        key: sum(row[key] for row in rows)
        for key in rows[0]
        if isinstance(rows[0][key], int) and key not in ("strip", "wooded")
    }
    words = []
    for name in ("wire", "tower"):
        if total.get(name):
            words.append(f"{name}s {100 * total[f'{name} found'] / total[name]:.1f} % found")
        false = total[f"{name} false"]
        words.append(f"{false} false {name}s ({1e3 * false / total['points']:.3f} per mille)")
    return f"{title}: {', '.join(words)}"


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--models", type=Path, required=True, help="of leave_one_out.py --save")
    options.add_argument(
        "--surveys", type=Path, required=True, help="the figures of leave_one_out.py --json"
    )
    options.add_argument("--crops", type=Path, help="folder of helicopter scans")
    options.add_argument("--json", type=Path, help="where the counts go")
    args = options.parse_args()
    scores = {
        "strips": strips(args.data, args.models),
        "strands": strands(args.data, args.models),
        "lines": lines_set_in(args.data, args.models),
        "false": false_ones(
            args.data, args.models, json.loads(args.surveys.read_text())["surveys"]
        ),
        **({"crops": crops(args.crops)} if args.crops else {}),
    }
    for title, rows in scores.items():
        if title not in ("false", "lines"):
            print(summarize(title, rows))
    for landscape in dict.fromkeys(row["landscape"] for row in scores["lines"]):
        rows = [row for row in scores["lines"] if row["landscape"] == landscape]
        print(summarize(f"lines set in, {landscape}", rows))
    for wooded in (False, True):
        rows = [row for row in scores["false"] if row["wooded"] == wooded]
        print(summarize("woods and slopes" if wooded else "other surveys", rows))
    if args.json:
        args.json.write_text(json.dumps(scores, indent=1) + "\n")


if __name__ == "__main__":
    main()
