"""Leave groups of surveys out: a survey's model has seen nothing of its group.

    python benchmarks/surveys/leave_one_out.py --data DIR --json FILE --save MODELS

Groups are whole countries and landscapes (`surveys.GROUPS`). Every survey is scored at its own
density and thinned to 1 point per square meter. OA and F1 over ground, vegetation and building; low
vegetation and what is none of the three is not scored; `wires.py` scores wires. The figure to raise is the mean over groups
of the mean OA over their surveys; beside it stand buildings in surveys without buildings.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from clouds import Cloud, load, slug, thinned
from folds import GroupsLeftOut
from recipe import contradicted
from surveys import (
    BUILDING,
    COAST,
    FOREST,
    GROUPS,
    LINE_SURVEY,
    SLOPE,
    SURVEYS,
    TOWER,
    VEGETATION,
    WIRE,
    LabeledSurvey,
)
from wires import classified_strips, lines_model

from pdal_stages import TrainingCloud
from pdal_stages.accuracy import Accuracy
from pdal_stages.classifier.calibration import Calibration
from pdal_stages.classifier.prediction import Prediction
from pdal_stages.reports.pictures import png, triptych

#: Points per square meter that the surveys are thinned to.
THINNED = (1.0,)
#: Surveys of which the card has a picture.
PICTURED = ("Seville", "hamlet")
NAMES = {2: "ground", 5: "vegetation", 6: "building"}
#: Classes found, true classes and reliability (n,) of points.
Judged = tuple[np.ndarray, np.ndarray, np.ndarray]


def draw(found: np.ndarray, cloud: Cloud, pictures: Path) -> None:
    """Write a picture of a classified cloud (heights, classes, errors) into a folder."""
    shown = cloud.truth > 0
    drawn = triptych(*cloud.xyz[shown].T, found[shown], cloud.truth[shown])
    (pictures / f"standard-{slug(cloud.name)}.png").write_bytes(png(drawn))


def score(found: np.ndarray, cloud: Cloud) -> dict[str, Any]:
    """Compare the classes (n,) that a model gave to a cloud with the truth."""
    known = np.isin(cloud.truth, list(NAMES))
    codes = sorted(set(found[known].tolist()) | set(NAMES))
    result = Accuracy.from_labels(cloud.truth[known], found[known], classes=codes)
    matrix = [
        [int(np.count_nonzero((cloud.truth == a) & (found == b))) for b in NAMES] for a in NAMES
    ]
    wrong = {
        f"{NAMES[a]} as {NAMES[b]}": matrix[i][j]
        for i, a in enumerate(NAMES)
        for j, b in enumerate(NAMES)
        if a != b
    }
    whole = TrainingCloud(cloud.xyz, cloud.truth, cloud.dimensions)
    gone = contradicted(whole)
    worst = max(wrong, key=lambda key: wrong[key])
    return {
        "survey": cloud.survey,
        "cloud": cloud.name,
        "points": int(known.sum()),
        "density": round(cloud.density, 2),
        "oa": 100 * float(np.mean(found[known] == cloud.truth[known])),
        "f1": {
            NAMES[c]: 100 * f
            for c, f in result.f1.items()
            if f is not None and (cloud.truth == c).any()
        },
        "contradicted": int(np.count_nonzero(gone)),
        "worst": worst,
        "share": 100 * wrong[worst] / int(known.sum()),
        "matrix": matrix,
        "all": len(found),
        "wires": int(np.count_nonzero(found == WIRE)),
        "towers": int(np.count_nonzero(found == TOWER)),
    }


def at(runs: list[dict[str, Any]], density: float | None) -> list[dict[str, Any]]:
    """Return the runs of surveys as flown (None), or thinned to a density."""
    end = "" if density is None else f", {density:g} points per m2"
    return [run for run in runs if run["cloud"] == run["survey"] + end]


def group_means(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Return the mean OA over each group's surveys."""
    oa: dict[str, list[float]] = {group: [] for group in GROUPS}
    for run in runs:
        oa[SURVEYS[run["survey"]].group].append(run["oa"])
    return {group: float(np.mean(found)) for group, found in oa.items() if found}


def false_buildings(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Return the percentage called building by survey, of forests and slopes without any."""
    out = {}
    for run in runs:
        survey = SURVEYS[run["survey"]]
        if survey.landscape in (FOREST, SLOPE) and BUILDING not in survey.labels.values():
            called = sum(row[-1] for row in run["matrix"])
            out[run["survey"]] = 100 * called / run["points"]
    return out


def group_table(runs: list[dict[str, Any]]) -> str:
    """Return means by group and false buildings, as flown and thinned, as Markdown."""
    densities = (None, *THINNED)
    each = [group_means(at(runs, density)) for density in densities]
    false = [false_buildings(at(runs, density)) for density in densities]
    heads = ("as flown", *(f"at {density:g}/m²" for density in THINNED))
    lines = [
        f"| group left out | surveys | {' | '.join(heads)} |",
        "|---|---:|" + "---:|" * len(heads),
    ]
    for group in each[0]:
        count = sum(SURVEYS[run["survey"]].group == group for run in at(runs, None))
        cells = " | ".join(f"{means[group]:.1f}" if group in means else "-" for means in each)
        lines.append(f"| {group} | {count} | {cells} |")
    cells = " | ".join(f"**{np.mean(list(means.values())):.2f}**" for means in each)
    lines.append(f"| **mean of the groups** | | {cells} |")
    cells = " | ".join(
        f"{np.mean(list(one.values())):.2f} % ({max(one, key=lambda k: one[k])}: "
        f"{max(one.values()):.2f} %)"
        for one in false
    )
    lines.append(f"| building in {len(false[0])} forests without any: mean (worst) | | {cells} |")
    return "\n".join(lines)


def survey_table(runs: list[dict[str, Any]]) -> str:
    """Return a line for each survey as flown, with its OA when thinned, as Markdown."""
    heads = " | ".join(f"OA at {density:g}/m²" for density in THINNED)
    lines = [
        f"| survey | points/m² | OA | {heads} | F1 ground | vegetation | building | what costs "
        "most |",
        "|---|---:|---:|" + "---:|" * len(THINNED) + "---:|---:|---:|---|",
    ]
    thin = [{run["survey"]: f"{run['oa']:.1f}" for run in at(runs, one)} for one in THINNED]
    for run in at(runs, None):
        name = run["survey"]
        cells = [f"{run['oa']:.1f}", *(found.get(name, "-") for found in thin)]
        cells += [f"{run['f1'][one]:.1f}" if one in run["f1"] else "-" for one in NAMES.values()]
        cost = f"{run['worst']} ({run['share']:.1f} %)"
        lines.append(f"| {name} | {run['density']} | {' | '.join(cells)} | {cost} |")
    return "\n".join(lines)


def judge(found: Prediction, truth: np.ndarray) -> Judged:
    """Return what is known of the points that have a truth (n,)."""
    known = truth > 0
    return found.classification[known], truth[known], found.reliability[known]


def calibrates(survey: LabeledSurvey) -> bool:
    """Return whether the limits of --keep-sure rest on a survey, see :func:`calibrate`."""
    return survey.landscape != COAST and not survey.tall and survey.tells(VEGETATION)


def calibrate(judged: dict[str, Judged], line: list[Judged]) -> Calibration:
    """Return how often models are right at which reliability, where vegetation is labeled.

    Rocks and scrub are left out: models that have seen no such land are surely wrong there, and the
    shipped one has seen it. `judged` has what is known of the scored points by survey, `line` of
    strips with wires, where wires alone count. Towers are not counted: one is labeled.
    """
    names = [name for name in judged if calibrates(SURVEYS[name])]
    out = Calibration(
        about=f"{len(names)} surveys ({', '.join(names)}), each classified by a model that had not "
        "seen its group; strips of a power line by models that had not seen its wires"
    )
    # Between all points alike and all surveys alike: limits should hold in a survey, not in the sum
    # of all.
    points = np.array([float(len(judged[name][0])) for name in names])
    weight = points**-0.25 * points.sum() / (points**0.75).sum()
    for name, of_point in zip(names, weight, strict=True):
        codes, truth, reliability = judged[name]
        out.add(codes, truth, reliability, np.full(len(codes), of_point))
    for codes, truth, reliability in line:
        wire = codes == WIRE
        of_point = np.full(np.count_nonzero(wire), weight.mean())
        out.add(codes[wire], truth[wire], reliability[wire], of_point)
    for table in (out.right, out.wrong):
        table.pop(TOWER, None)
    return out


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--json", type=Path, help="where the figures go")
    options.add_argument("--trained", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    options.add_argument("--groups", nargs="+", default=GROUPS, choices=GROUPS)
    options.add_argument("--pictures", type=Path, help="folder for the card's pictures")
    options.add_argument("--calibration", type=Path, help="where the counts behind --keep-sure go")
    options.add_argument(
        "--save", type=Path, required=True, help="folder for the models and the features"
    )
    args = options.parse_args()
    args.save.mkdir(parents=True, exist_ok=True)
    runs: list[dict[str, Any]] = []
    judged: dict[str, Judged] = {}
    started = time.process_time()
    left_out = GroupsLeftOut(args.data, args.trained, args.save)
    print(f"features: {time.process_time() - started:.0f} CPU s", flush=True)
    for group in args.groups:
        started = time.process_time()
        model = left_out.without(group)
        model.save(args.save / f"{slug(group)}.model")
        print(f"{group}: {time.process_time() - started:.0f} CPU s", flush=True)
        for name in (name for name, survey in SURVEYS.items() if survey.group == group):
            cloud = load(args.data, name)
            for one in (cloud, *(thinned(cloud, density) for density in THINNED)):
                if one is None:
                    continue
                found = model.predict(one.xyz, one.dimensions)
                runs.append(score(found.classification, one))
                print(json.dumps(runs[-1]), flush=True)
                if one is cloud:
                    judged[name] = judge(
                        found, np.where(np.isin(one.truth, list(NAMES)), one.truth, 0)
                    )
                    if args.pictures and name in PICTURED:
                        draw(found.classification, one, args.pictures)
    left_out.without(SURVEYS[LINE_SURVEY].group, with_lines=True).save(lines_model(args.save))
    line = [
        judge(found, truth)
        for _, _, found, truth in classified_strips(args.data, args.save, args.pictures)
    ]
    print(group_table(runs), survey_table(runs), sep="\n\n")
    if args.json:
        args.json.write_text(json.dumps({"surveys": runs}, indent=1) + "\n")
    if args.calibration:
        counts = json.dumps(calibrate(judged, line).to_dict(), separators=(",", ":"))
        args.calibration.write_text(counts + "\n")


if __name__ == "__main__":
    main()
