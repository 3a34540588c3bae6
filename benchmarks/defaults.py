"""How the defaults of training were chosen: parts of training clouds that a model has not seen.

    python benchmarks/defaults.py --data DIR                       # every table
    python benchmarks/defaults.py --data DIR --table trees --json FILE
    python benchmarks/defaults.py --data DIR --table base --count 40000 --bases MODELS

Each training tile of Montpellier, and each third of Delft's training part, of Seville and of the
hamlet, is classified by a model of the rest of that survey, with one thing of the defaults changed.
Cross-validation over small blocks amid the training points is flattered by what neighbors share; a
tile never seen is what a user's next tile is. Test parts are not touched. MODELS holds shipped
models that have not seen the survey, as ``benchmarks/surveys/leave_one_out.py --save`` writes them.
CPU seconds are those of training, and microseconds a point those of classifying, both with one
thread.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.accuracy import Accuracy
from pdal_stages.classifier.input_dimensions import DEFAULT_DIMENSIONS, OPTIONAL_DIMENSIONS
from pdal_stages.classifier.model import load_model
from pdal_stages.features.registry import SURFACE_FEATURES
from pdal_stages.terrain import filtered_ground

#: What ``pdal-stages train`` takes where points have it.
DIMENSIONS = (*DEFAULT_DIMENSIONS, *OPTIONAL_DIMENSIONS, "returns")
PAPERS = "c1,c2,c3,c5,s1,s2,s3,s5,kopt"
ONE = {"passes": 1}
FEATURES = TrainingOptions().feature_set
#: Defaults until 2026-11-23.
FORMER = {"count": 10_000, "context": ("own", "box1", "columnvotes2", "columnvotes8")}
#: The table of models built on another, and the option.
BASE = "base"
#: Table -> row -> what differs from today's defaults.
TABLES: dict[str, dict[str, dict[str, Any]]] = {
    "features": {
        "today's": ONE,
        "neighborhoods of weinmann2018": {**ONE, "neighborhoods": PAPERS},
        "the same, with density and shape distributions": {
            **ONE,
            "neighborhoods": PAPERS,
            "feature_set": "all,HeightAboveLowest",
        },
        "without s5": {**ONE, "neighborhoods": "k10,k20,k50"},
        "without k10": {**ONE, "neighborhoods": "s5,k20,k50"},
        "with c2": {**ONE, "neighborhoods": "c2,s5,k10,k20,k50"},
        "without return numbers": {
            **ONE,
            "dimensions": (*DEFAULT_DIMENSIONS, *OPTIONAL_DIMENSIONS),
        },
        "without heights above openings": {
            **ONE,
            "dimensions": (*DEFAULT_DIMENSIONS, "Ground", "returns"),
        },
        "heights above ground alone": {**ONE, "dimensions": DEFAULT_DIMENSIONS},
    },
    "surfaces": {
        "none": {},
        "agreement and lowest of k20": {
            "feature_set": (*FEATURES, "NormalAgreement_k20", "SurfaceVariationMin_k20")
        },
        "all four of k20": {
            "feature_set": (*FEATURES, *(f"{name}_k20" for name in SURFACE_FEATURES))
        },
    },
    "samples": {
        "10,000, own and around": FORMER,
        "10,000, around": {"count": 10_000},
        "40,000, own and around": {**FORMER, "count": 40_000},
        "40,000, around": {"count": 40_000},
    },
    "voxel": {"0.125 m": {}, "none": {"voxel": 0.0}, "0.25 m": {"voxel": 0.25}},
    "passes": {"1": ONE, "2": {}, "3": {"passes": 3}},
    "context": {
        ",".join(tokens): {"context": tokens}
        for tokens in (
            ("own", "box1", "columnvotes2", "columnvotes8"),
            ("own", "box2", "columnvotes1", "columnvotes4"),
            ("own", "box2", "columnvotes1", "columnvotes4", "columnvotes8"),
            ("own", "box2", "columnvotes1", "columnvotes4", "columnvotes16"),
            ("box1", "columnvotes2", "columnvotes8"),
            ("box1", "box4", "columnvotes1", "columnvotes4", "columnvotes8"),
            ("own", "box1", "box4", "columnvotes1", "columnvotes4", "columnvotes8"),
            ("own", "box1", "box4", "columnvotes1", "columnvotes4", "columnvotes16"),
        )
    },
    "trees": {
        "50, leaves of 3 (default)": {},
        "100, leaves of 3": {"trees": 100},
        "40, leaves of 3": {"trees": 40},
        "50, leaves of 5": {"min_samples_leaf": 5},
        "50, leaves of 3, 10,000 samples of a class": {"count": 10_000},
    },
    BASE: {
        "no base": {},
        "base, one pass on top": {BASE: True},
    },
}
CODES = {
    "Montpellier": (2, 3, 4, 5, 6),
    "Delft": (1, 2, 6),
    "Seville": (2, 3, 4, 5, 6),
    "hamlet": (2, 3, 4, 5, 6),
}
THIRDS = {
    "Delft": "delft/train.laz",
    "Seville": "seville/plazanueva.laz",
    "hamlet": "rural/lidarhd_57ppm2.laz",
}


def cloud(files: list[Path], codes: tuple[int, ...], name: str) -> TrainingCloud:
    """A labeled cloud with heights and return numbers."""
    parts = [laspy.read(file) for file in files]
    xyz = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts]).astype(float)
    labels = np.concatenate([np.asarray(p.classification) for p in parts]).astype(np.uint8)
    dimensions = filtered_ground(*np.ascontiguousarray(xyz.T), openings=(5, 17))
    for ours, word in (("ReturnNumber", "return_number"), ("NumberOfReturns", "number_of_returns")):
        dimensions[ours] = np.concatenate([np.asarray(p[word]) for p in parts]).astype(np.uint8)
    return TrainingCloud(xyz, np.where(np.isin(labels, codes), labels, 0), dimensions, name=name)


def held_out(data: Path) -> Iterator[tuple[str, TrainingCloud, TrainingCloud]]:
    """(scene, what is trained on, what is classified)."""
    files = sorted((data / "montpellier").glob("train_*.laz"))
    whole = cloud(files, CODES["Montpellier"], "Montpellier")
    tile = np.repeat(np.arange(len(files)), [laspy.open(file).header.point_count for file in files])
    for number in range(len(files)):
        yield (
            "Montpellier",
            *(whole.part(np.flatnonzero(rows)) for rows in (tile != number, tile == number)),
        )
    for scene, file in THIRDS.items():
        whole = cloud([data / file], CODES[scene], scene)
        third = np.searchsorted(np.quantile(whole.xyz[:, 1], [1 / 3, 2 / 3]), whole.xyz[:, 1])
        for number in range(3):
            yield (
                scene,
                *(whole.part(np.flatnonzero(rows)) for rows in (third != number, third == number)),
            )


def options(changes: dict[str, Any], codes: tuple[int, ...], count: int) -> TrainingOptions:
    """Today's defaults with changes."""
    options = {
        "dimensions": DIMENSIONS,
        "classes": list(codes),
        "count": count,
        "threads": 1,
        "folds": 0,
    }
    return TrainingOptions(**{**options, **changes})


def run(
    data: Path, rows: dict[str, dict[str, Any]], count: int, bases: Path | None = None
) -> list[dict[str, Any]]:
    """A line for each row."""
    scores = {
        name: {
            scene: np.zeros((len(codes), len(codes)), np.int64) for scene, codes in CODES.items()
        }
        for name in rows
    }
    seconds = {name: [0.0, 0.0, 0] for name in rows}
    columns = {}
    for scene, rest, held in held_out(data):
        codes = CODES[scene]
        for name, changes in rows.items():
            if BASE in changes:
                changes = {**changes, BASE: load_model(bases / f"{scene}.model")}
            began = time.process_time()
            model = train([rest], options(changes, codes, count), progress=False)
            trained = time.process_time()
            predicted = model.predict(held.xyz, held.dimensions, threads=1).classification
            seconds[name][0] += trained - began
            seconds[name][1] += time.process_time() - trained
            seconds[name][2] += len(held.xyz)
            columns[name] = len(model.passes[-1].plan.names)
            known = np.isin(held.labels, codes)
            pair = (
                np.searchsorted(codes, held.labels[known]),
                np.searchsorted(codes, predicted[known]),
            )
            np.add.at(scores[name][scene], pair, 1)
        print(f"{scene}: a part held out", flush=True)
    lines = []
    for name in rows:
        line: dict[str, Any] = {"name": name, "features": columns[name]}
        for scene, codes in CODES.items():
            accuracy = Accuracy.from_confusion(scores[name][scene], codes)
            line[scene] = {
                "oa": 100 * accuracy.overall_accuracy,
                "f1": 100 * accuracy.mean_f1,
                "classes": {str(code): 100 * value for code, value in accuracy.f1.items()},
            }
        line["training"], line["classifying"] = (
            seconds[name][0],
            1e6 * seconds[name][1] / seconds[name][2],
        )
        lines.append(line)
    return lines


def text(tables: dict[str, list[dict[str, Any]]]) -> str:
    """Return Markdown: overall accuracy / mean F1 / F1 of low vegetation, percent."""
    out = []
    for title, lines in tables.items():
        out += [
            f"| {title} | features | {' | '.join(CODES)} | mean | training, CPU s | microseconds a "
            "point |",
            "|---|---:|" + "---:|" * len(CODES) + "---:|---:|---:|",
        ]
        for line in lines:
            scores = [line[scene] for scene in CODES]
            cells = [
                _figures(score["oa"], score["f1"], score["classes"].get("3")) for score in scores
            ]
            low = [score["classes"]["3"] for score in scores if "3" in score["classes"]]
            mean = _figures(
                *(statistics.fmean(score[key] for score in scores) for key in ("oa", "f1")),
                statistics.fmean(low),
            )
            out.append(
                f"| {line['name']} | {line['features']} | {' | '.join([*cells, mean])} | "
                f"{line['training']:.0f} | "
                f"{line['classifying']:.1f} |"
            )
        out.append("")
    return "\n".join(out)


def _figures(*values: float | None) -> str:
    return " / ".join(f"{value:.1f}" for value in values if value is not None)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    parser.add_argument("--table", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--count", type=int, default=2500, help="samples of each class")
    parser.add_argument("--json", type=Path, help="where the figures go")
    parser.add_argument("--bases", type=Path, help="folder of models, for the table of bases")
    arguments = parser.parse_args()
    tables = {}
    for title in arguments.table:
        if title == BASE and arguments.bases is None:
            print("the table of bases needs --bases")
            continue
        tables[title] = run(arguments.data, TABLES[title], arguments.count, arguments.bases)
        print(text({title: tables[title]}), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(tables, indent=1) + "\n")


if __name__ == "__main__":
    main()
