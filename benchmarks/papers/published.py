"""What the four papers publish, as numbers, what follows from them, and ours beside: makes
docs/papers/published.md.

    python benchmarks/papers/published.py > docs/papers/published.md
    python benchmarks/papers/published.py --ours vaihingen-accuracy.json

The tables stand here so that ours can be held beside them; the sums below check them against
themselves. With --ours the confusion matrix that vaihingen-evaluate.json writes is printed beside
the published ones.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tables import table

from pdal_stages.classifier.training_options import RECIPES

# ---- [H17] Table 2, and the classes of the test clouds -----------------------------------------------------

H17_CLASSES = ("vegetation", "wire", "pole/trunk", "ground", "facade")
H17_POINTS = np.array([267_325, 3_794, 7_933, 934_146, 111_112])
#: As printed: rows "precision" and "recall", per class.
H17 = {
    "v_k": ([88.77, 89.17, 69.92, 99.70, 65.86], [94.59, 8.13, 56.50, 99.72, 83.09]),
    "v_r": ([89.31, 93.83, 71.28, 99.70, 69.66], [94.15, 10.36, 59.55, 99.80, 82.60]),
    "v_c": ([89.44, 92.25, 71.56, 99.70, 83.75], [94.66, 15.16, 66.96, 99.84, 86.67]),
}

# ---- [B16] Tables 2 to 5: measures, distributions, both; GML A, then GML B ----------------------------------

B16_ROWS = ("c1", "c2", "c3", "c5", "kopt", "all cylinders", "all")
B16 = {
    "Kappa": [
        [25.21, 34.09, 35.72, 31.87, 32.46, 36.44],
        [30.61, 42.35, 44.48, 32.39, 35.84, 37.21],
        [32.24, 44.76, 48.64, 31.59, 33.39, 35.10],
        [41.64, 42.05, 50.42, 27.59, 27.43, 28.87],
        [23.34, 32.49, 28.28, 43.66, 27.95, 43.96],
        [35.45, 48.37, 49.61, 35.52, 38.20, 39.54],
        [57.28, 53.93, 61.17, 59.70, 58.31, 63.76],
    ],
    "Overall accuracy": [
        [50.22, 56.62, 57.88, 63.65, 65.57, 68.60],
        [55.49, 64.07, 65.68, 64.07, 68.76, 69.05],
        [57.70, 66.14, 69.12, 62.92, 66.05, 66.61],
        [65.10, 63.88, 70.76, 58.09, 59.16, 59.44],
        [41.57, 51.82, 47.11, 74.29, 58.68, 74.28],
        [60.42, 68.92, 69.93, 66.93, 69.79, 70.43],
        [74.33, 72.20, 76.76, 84.49, 83.74, 86.56],
    ],
    "Mean class recall": [
        [45.90, 52.96, 52.73, 72.73, 69.57, 75.14],
        [49.53, 58.77, 57.97, 72.53, 71.73, 76.40],
        [49.34, 59.47, 60.32, 71.96, 69.76, 74.94],
        [46.50, 56.57, 58.17, 69.06, 64.43, 70.66],
        [36.42, 47.44, 39.19, 74.99, 64.33, 75.70],
        [51.98, 64.84, 65.04, 76.46, 75.15, 79.72],
        [63.48, 68.02, 70.15, 83.47, 81.74, 85.17],
    ],
    "Mean class precision": [
        [30.92, 36.13, 35.58, 42.18, 41.78, 44.84],
        [32.33, 38.20, 37.92, 43.17, 45.35, 46.26],
        [32.49, 38.68, 38.85, 44.41, 46.42, 46.25],
        [34.29, 38.38, 39.28, 43.69, 42.53, 45.02],
        [35.81, 37.50, 37.12, 50.96, 49.65, 51.72],
        [33.94, 39.83, 39.28, 45.04, 46.68, 47.92],
        [41.64, 41.40, 43.60, 57.11, 55.12, 58.87],
    ],
}
#: Tables 6 and 7. Rows and columns as above; GML B has no cars. Low vegetation follows from the
#: means (Tables 4 and 5), since its rows are not legible in the text used here. Two cells of it
#: were misread; they are set so that Tables 3 and 4 come out: recall of trees by measures, GML A
#: all cylinders (63.56) and GML B all (93.65; the copy has 95.05).
B16_CLASSES = {
    "recall": {
        "ground": [
            [50.82, 34.01, 43.17, 60.35, 63.41, 66.10],
            [51.30, 40.25, 46.14, 60.78, 66.95, 66.34],
            [55.42, 42.47, 49.63, 59.29, 63.66, 63.29],
            [57.05, 37.51, 48.92, 54.05, 56.24, 55.41],
            [43.12, 40.07, 44.36, 72.93, 55.16, 72.66],
            [57.13, 46.38, 55.63, 63.51, 67.00, 67.17],
            [64.57, 52.38, 62.89, 83.82, 82.93, 86.02],
        ],
        "building": [
            [50.79, 43.19, 50.61, 69.51, 54.98, 69.55],
            [50.75, 42.52, 48.63, 71.04, 61.54, 75.55],
            [53.18, 38.26, 48.14, 73.18, 56.51, 75.37],
            [56.38, 39.33, 53.75, 71.81, 52.27, 68.61],
            [62.85, 48.89, 60.11, 66.93, 52.11, 68.61],
            [60.47, 45.70, 53.78, 80.74, 74.05, 84.34],
            [63.82, 53.58, 64.81, 80.58, 80.01, 84.00],
        ],
        "car": [
            [59.97, 62.04, 69.03],
            [56.51, 66.77, 68.22],
            [49.92, 63.31, 62.47],
            [18.86, 52.46, 38.55],
            [33.35, 45.81, 31.56],
            [37.56, 73.45, 71.59],
            [45.19, 74.31, 71.00],
        ],
        "tree": [
            [50.11, 75.90, 70.64, 88.46, 88.97, 89.11],
            [59.50, 84.61, 82.77, 88.79, 87.98, 88.79],
            [60.23, 86.75, 86.27, 89.40, 91.57, 91.06],
            [72.91, 86.62, 89.80, 85.95, 87.95, 88.96],
            [40.13, 61.85, 49.53, 90.60, 93.26, 92.06],
            [63.56, 88.38, 82.47, 89.53, 92.71, 91.53],
            [83.17, 89.30, 88.92, 93.65, 94.92, 94.10],
        ],
    },
    "precision": {
        "ground": [
            [62.52, 87.51, 82.76, 99.22, 98.41, 98.96],
            [64.02, 92.38, 88.89, 99.43, 98.84, 99.21],
            [62.77, 93.48, 89.93, 99.56, 99.04, 99.51],
            [70.72, 94.30, 91.11, 99.37, 99.23, 99.62],
            [91.52, 89.08, 93.31, 99.14, 97.47, 99.31],
            [63.57, 93.99, 82.37, 99.40, 99.40, 99.59],
            [85.75, 95.07, 93.90, 99.58, 99.62, 99.78],
        ],
        "building": [
            [6.79, 5.34, 6.79, 24.81, 21.90, 30.80],
            [6.50, 6.25, 7.40, 32.84, 37.34, 38.20],
            [7.96, 6.67, 8.95, 41.31, 47.72, 44.08],
            [10.16, 7.50, 10.82, 42.18, 37.58, 46.12],
            [7.11, 5.74, 6.97, 16.54, 9.19, 16.05],
            [9.71, 8.13, 9.97, 35.57, 38.43, 41.33],
            [11.63, 9.55, 11.62, 33.33, 33.70, 38.54],
        ],
        "car": [
            [2.83, 3.07, 3.43],
            [4.67, 3.87, 5.19],
            [4.67, 3.31, 5.46],
            [2.33, 2.37, 4.09],
            [0.62, 1.18, 0.78],
            [6.90, 6.61, 11.18],
            [11.46, 7.75, 12.80],
        ],
        "tree": [
            [81.09, 81.27, 82.76, 29.69, 31.23, 31.64],
            [83.56, 82.29, 83.63, 28.56, 29.34, 30.30],
            [83.73, 82.36, 83.80, 27.67, 28.10, 28.82],
            [84.13, 82.06, 83.10, 27.37, 27.29, 27.73],
            [79.71, 89.31, 84.11, 74.28, 86.53, 76.42],
            [84.89, 82.87, 85.81, 29.97, 30.89, 31.46],
            [93.17, 87.38, 92.75, 77.51, 68.70, 75.76],
        ],
    },
}
#: Table 1, test parts, thousands of points: GML A, GML B.
B16_POINTS = {
    "ground": (440, 978), "building": (20, 55), "car": (3, 0), "tree": (532, 111), "low vegetation": (8, 17),
}  # fmt: skip

# ---- [W18] Tables 1 and 2, [WM19] Figure 9: ISPRS Vaihingen --------------------------------------------------

VAIHINGEN = (
    "power line",
    "low vegetation",
    "impervious surface",
    "car",
    "fence/hedge",
    "roof",
    "facade",
    "shrub",
    "tree",
)
#: What the labels become by the recipe.
VAIHINGEN_CODES = tuple(
    int(value.partition(" ")[0]) for value in RECIPES["vaihingen"]["classes"].values()
)
W18 = [
    [432, 1, 0, 0, 0, 44, 20, 2, 101],
    [0, 56068, 15233, 125, 1692, 8859, 595, 14128, 1990],
    [1, 19068, 80162, 146, 118, 1502, 38, 850, 101],
    [0, 644, 112, 1082, 428, 121, 7, 1280, 34],
    [0, 934, 48, 53, 1212, 256, 87, 4059, 773],
    [181, 1534, 183, 7, 503, 90920, 2164, 2494, 11062],
    [26, 365, 13, 33, 67, 808, 5668, 1468, 2776],
    [7, 3177, 239, 152, 1182, 549, 546, 15351, 3615],
    [28, 546, 25, 7, 277, 1977, 1266, 6575, 43525],
]
WM19 = [
    [385, 1, 0, 0, 0, 132, 3, 11, 68],
    [0, 77999, 9209, 5, 4, 579, 88, 6978, 3828],
    [0, 8184, 92937, 18, 0, 171, 25, 627, 24],
    [0, 86, 1054, 1116, 44, 2, 8, 1313, 85],
    [0, 796, 463, 3, 296, 40, 11, 3994, 1819],
    [98, 1331, 36, 1, 0, 99515, 625, 1757, 5685],
    [5, 916, 149, 20, 0, 2218, 3827, 1883, 2206],
    [6, 4821, 325, 11, 9, 405, 119, 9814, 9308],
    [5, 974, 25, 2, 0, 1762, 275, 5387, 45796],
]
#: Multi-class with 10,000 samples of each class, from the text: overall accuracy, kappa, mean F1.
W18_TEN_THOUSAND = (68.1, 60.5, 52.6)
#: Target against background, 100,000 samples of each: recall, precision, F1 of the target and of
#: the background; overall accuracy, kappa, mean F1.
W18_BINARY = {
    "Car": (44.1, 44.3, 44.2, 99.5, 99.5, 99.5, 99.0, 43.7, 71.9),
    "Building (roof and facade)": (87.7, 83.7, 85.7, 92.9, 94.8, 93.9, 91.4, 79.5, 89.8),
    "Tree": (91.6, 55.1, 68.8, 88.7, 98.6, 93.9, 89.0, 62.6, 81.1),
}


#: Where our results of the papers' experiments are, made by the commands of docs/papers.md.
OURS = Path(__file__).resolve().parents[2] / "docs" / "papers"
SCENES = ("delft", "montpellier")
MEASURES = {
    "Kappa": "kappa",
    "Overall accuracy": "oa",
    "Mean class recall": "mcr",
    "Mean class precision": "mcp",
}
SETS = ("measures", "distributions", "both")
RADII = ("c1", "c2", "c3", "c5")


@cache
def our_runs(paper: str, scene: str) -> list[dict[str, Any]]:
    """Return our finished runs of a paper's experiments on a scene."""
    runs: list[dict[str, Any]] = json.loads((OURS / f"{paper}-{scene}.json").read_text())["runs"]
    return runs


def our_mean(scene: str, hood: str, features: str, *keys: str) -> float:
    """Return the mean over seeds of one of our [B16] figures."""
    tables = []
    for run in our_runs("b16", scene):
        if (run["neighborhood"], run["set"]) == (hood, features):
            value: Any = run
            for key in keys:
                value = value[key]
            tables.append(value)
    return float(np.mean(tables))


def b16_ours(measure: str, scene: str) -> str:
    """Return our half of a table of [B16]."""
    rows = [
        [hood, *(f"{our_mean(scene, hood, kind, MEASURES[measure]):.2f}" for kind in SETS)]
        for hood in B16_ROWS
    ]
    return table(["Neighborhood", *SETS], rows)


def f1_over_radii(scene: str) -> str:
    """Return our F1 of each class over the radius of a cylinder, both feature sets [B16 5]."""
    classes = list(our_runs("b16", scene)[0]["f1"])
    rows = [
        [hood, *(f"{our_mean(scene, hood, 'both', 'f1', one):.1f}" for one in classes)]
        for hood in RADII
    ]
    return table(["Cylinder", *(f"class {one}" for one in classes)], rows)


def w18_ours() -> list[str]:
    """Return our figures and confusion matrices of [W18]'s multi-class runs, all features, first
    seed."""
    rows, matrices = [], []
    for scene in SCENES:
        for run in our_runs("w18", scene):
            if run["kind"] == "all" and run["target"] is None and run["seed"] == 0:
                name = f"{scene.capitalize()}, {run['count']:,} per class"
                rows.append([name, *(f"{run[key]:.2f}" for key in ("oa", "kappa", "mf1"))])
                cells = [
                    [str(code), *(f"{n:,}" for n in line)]
                    for code, line in zip(run["classes"], run["matrix"], strict=True)
                ]
                matrices += [name, table(["Reference", *map(str, run["classes"])], cells)]
    return [table(["Ours", "OA", "Kappa", "Mean F1"], rows), *matrices]


def figures(matrix) -> dict[str, np.ndarray | float]:
    """Overall accuracy, kappa, recall, precision and F1 (per cent) of a confusion matrix, reference
    in rows."""
    m = np.asarray(matrix, float)
    total, right = m.sum(), np.diag(m)
    recall, precision = right / m.sum(axis=1), right / m.sum(axis=0)
    chance = (m.sum(axis=0) * m.sum(axis=1)).sum() / total**2
    oa = right.sum() / total
    f1 = 2 * recall * precision / (recall + precision)
    return {
        "oa": 100 * oa,
        "kappa": 100 * (oa - chance) / (1 - chance),
        "recall": 100 * recall,
        "precision": 100 * precision,
        "f1": 100 * f1,
    }


def h17() -> str:
    """Say which word of [H17]'s Table 2 is which: predicted points must add up to all points."""
    total = H17_POINTS.sum()
    rows = []
    for name, (precision, recall) in H17.items():
        p, r = np.array(precision) / 100, np.array(recall) / 100
        rows.append(
            [
                name,
                f"{(H17_POINTS * r / p).sum() / total:.4f}",
                f"{(H17_POINTS * p / r).sum() / total:.4f}",
                f"{100 * (H17_POINTS * r).sum() / total:.2f}",
                f"{100 * (H17_POINTS * p).sum() / total:.2f}",
            ]
        )
    head = [
        "Neighborhood",
        "Predicted points / N, as printed",
        "with the words exchanged",
        "OA, as printed",
        "OA, exchanged",
    ]
    return table(head, rows)


def b16(measure: str, first: int) -> str:
    """One data set's half of a table."""
    rows = [
        [name, *(f"{v:.2f}" for v in values[first : first + 3])]
        for name, values in zip(B16_ROWS, B16[measure], strict=True)
    ]
    return table(["Neighborhood", "measures", "distributions", "both"], rows)


def b16_class(word: str, name: str, first: int) -> np.ndarray:
    """Recall or precision of a class on a data set, (7, 3): low vegetation is what is left of the
    mean."""
    if name != "low vegetation":
        rows = [row for row in B16_CLASSES[word][name] if len(row) > first]
        return np.array(rows)[:, first : first + 3]
    others = [
        b16_class(word, scene, first)
        for scene in B16_POINTS
        if scene != name and B16_POINTS[scene][first // 3]
    ]
    return (len(others) + 1) * np.array(B16[f"Mean class {word}"])[:, first : first + 3] - np.sum(
        others, axis=0
    )


def b16_overall(first: int) -> np.ndarray:
    """Overall accuracy that follows from the classes' recalls and their sizes, (7, 3); sizes are
    whole thousands."""
    there = {name: sizes[first // 3] for name, sizes in B16_POINTS.items() if sizes[first // 3]}
    right = sum(size * b16_class("recall", name, first) for name, size in there.items())
    return right / sum(there.values())


def b16_classes(scene: str, first: int) -> list[str]:
    """Tables of every class of a data set, as b16_experiments.py prints ours."""
    text = []
    for word in ("recall", "precision"):
        for name, sizes in B16_POINTS.items():
            if sizes[first // 3]:
                figure = b16_class(word, name, first)
                rows = [
                    [hood, *(f"{v:.1f}" for v in row)]
                    for hood, row in zip(B16_ROWS, figure, strict=True)
                ]
                text += [
                    f"{scene}, {name}: {word}",
                    table(["Neighborhood", "measures", "distributions", "both"], rows),
                ]
    return text


def confusion(matrix) -> str:
    """A confusion matrix, reference in rows."""
    rows = [[name, *(f"{n:,}" for n in row)] for name, row in zip(VAIHINGEN, matrix, strict=True)]
    return table(["Reference", *VAIHINGEN], rows)


def vaihingen() -> str:
    w18, wm19 = figures(W18), figures(WM19)
    rows = [
        [
            name,
            f"{sum(WM19[i]):,}",
            *(
                f"{entry[key][i]:.1f}"
                for entry in (w18, wm19)
                for key in ("recall", "precision", "f1")
            ),
        ]
        for i, name in enumerate(VAIHINGEN)
    ]
    head = [
        "Class",
        "Points",
        *(f"{who} {w}" for who in ("[W18]", "[WM19]") for w in ("recall", "precision", "F1")),
    ]
    return table(head, rows)


def overall(**more: Any) -> str:
    rows = [["[W18], forest, 10,000 per class (text)", *map(str, W18_TEN_THOUSAND)]]
    for name, matrix in {
        "[W18], forest, 100,000 per class (Tab. 1)": W18,
        "[WM19], alsNet (Fig. 9)": WM19,
        **more,
    }.items():
        f = figures(matrix)
        rows.append([name, f"{f['oa']:.2f}", f"{f['kappa']:.2f}", f"{np.mean(f['f1']):.2f}"])
    return table(["Confusion matrix", "OA", "Kappa", "Mean F1"], rows)


def page() -> str:
    """The whole page."""
    parts = [
        "# What the papers publish",
        "The four papers' own figures, to hold [ours](../papers.md) beside. Made by `python "
        "benchmarks/papers/published.py`,"
        " which also checks them against themselves. Figures are per cent.",
        "## [H17] Table 2: precision and recall are exchanged",
        "For every class, true points times recall over precision is the number of points *called* "
        "that class, and these"
        " must add up to all N = 1,324,310. With the two words of the table as printed they do "
        "not; exchanged, they do to"
        " four digits, for all three neighborhoods, and the overall accuracy of v_c comes out as "
        "the text states it (96.1). OA is derived from the table; for v_k and v_r the paper gives none.",
        h17(),
    ]
    for number, measure in enumerate(B16, 2):
        parts.append(f"## [B16] Table {number}: {measure.lower()}")
        for first, scene in ((0, "GML A"), (3, "GML B")):
            parts += [scene, b16(measure, first)]
        for ours in SCENES:
            parts += [f"Ours, {ours.capitalize()}", b16_ours(measure, ours)]
    parts.append("## [B16] Section 5: F1 by class over the radius, ours")
    for ours in SCENES:
        parts += [ours.capitalize(), f1_over_radii(ours)]
    parts.append("## [B16] Tables 6 and 7: classes")
    worst = max(
        float(
            np.abs(
                b16_overall(first) - np.array(B16["Overall accuracy"])[:, first : first + 3]
            ).max()
        )
        for first in (0, 3)
    )
    parts.append(
        "Low vegetation is what the means of Tables 4 and 5 leave, since its rows are not legible "
        "in the copy of the text"
        " used here; the recall of trees by measures (all cylinders on GML A, all on GML B) is set "
        "so that Tables 3 and 4"
        " come out."
        " With these, recalls and sizes of the classes give all 42 overall accuracies of Table 3 "
        f"to {worst:.2f}."
    )
    for first, scene in ((0, "GML A"), (3, "GML B")):
        parts += b16_classes(scene, first)
    parts += [
        "## [W18] and [WM19] on ISPRS Vaihingen",
        overall(),
        "[W18] says of ten times the samples: +3.4 OA, +3.8 kappa, +5.7 mean F1.",
        "[WM19] gives 80.6 in its abstract and 80.2 in its text; its matrix says 80.6. Its kappa "
        "and mean F1 are derived from the matrix; it gives neither.",
        vaihingen(),
        "[W18], Tab. 1",
        confusion(W18),
        "[WM19], Fig. 9",
        confusion(WM19),
        "## [W18], ours: multi-class on our scenes",
        *w18_ours(),
        "## [W18] Table 2: binary, 100,000 samples per class",
        table(
            [
                "Target",
                "Recall",
                "Precision",
                "F1",
                *(f"Background {w}" for w in ("recall", "precision", "F1")),
                "OA",
                "Kappa",
                "Mean F1",
            ],
            [[name, *(f"{v:.1f}" for v in values)] for name, values in W18_BINARY.items()],
        ),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def beside(path: Path) -> str:
    """Our confusion matrix of Vaihingen, as filters.accuracy writes it, beside the published
    ones."""
    report = json.loads(path.read_text())
    codes = [entry["code"] for entry in report["classes"]]
    lost = set(VAIHINGEN_CODES) - set(codes)
    if lost:
        raise SystemExit(
            f"{path}: classes {sorted(lost)} are missing; vaihingen-evaluate.json writes all nine"
        )
    at = [codes.index(code) for code in VAIHINGEN_CODES]
    matrix = np.array(report["confusion"]["counts"])[np.ix_(at, at)]
    rows = [
        [name, *(f"{entry['f1'][i]:.1f}" for entry in map(figures, (W18, WM19, matrix)))]
        for i, name in enumerate(VAIHINGEN)
    ]
    return "\n".join(
        [
            overall(Ours=matrix),
            table(["F1", "[W18]", "[WM19]", "Ours"], rows),
            "[WM19], Fig. 9\n",
            confusion(WM19),
            "Ours\n",
            confusion(matrix),
        ]
    )


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--ours", type=Path, help="JSON that vaihingen-evaluate.json wrote")
    ours = options.parse_args().ours
    print(page() if ours is None else beside(ours), end="")


if __name__ == "__main__":
    main()
