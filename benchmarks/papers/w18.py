"""[W18]'s questions on real production clouds: how many samples, binary or multi-class, and which
features carry it.

    python benchmarks/papers/w18.py --data DIR --cache DIR

All 560 features (nine neighborhoods and the height above ground). As many random samples of each
class, those of a class with fewer points counted several times; trees are fully grown on bootstraps
of all samples, with the root of the number of features tried at a node; covariance features,
geometric properties and the height are cut off at the 1st and 99th percentile of the samples,
histograms are not [W18 3.2]. Binary runs draw as many samples of the target as of everything else.
Beside the paper's questions, one of our own: how much of the result a tenth of the features
carries. Importances come from the training samples alone; the tenth they pick is then trained and
scored by itself, beside a tenth drawn by chance.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import scenes
from kit import Cache, Results, draw, figures, finish, grow_forest, limits, note, parser, predict
from tables import choose, spread, table, values

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.features.registry import GROUPS

EXPERIMENT = 3  # raised when runs mean something else than before, so that none is resumed
#: Scene -> classes found by themselves, against all others; several labels may be one target.
TARGETS = {"montpellier": ((6,), (5,)), "delft": ((6,),), "vaihingen": ((5, 6), (8,), (3,))}


def names_of(scene: scenes.Scene) -> list[str]:
    """The features of the paper: all but the point's own Z."""
    return [name for name in scene.plan.names if name != "Z"]


def group(name: str) -> str:
    """The kind of a feature."""
    head, _, _ = name.rpartition("_")
    for kind in ("covariance", "geometric", "A3", "D1", "D2", "D3", "D4"):
        if any(name.startswith(word + "_") and head.startswith(word) for word in GROUPS[kind]):
            return kind
    return name


def neighborhood(name: str) -> str:
    return name if name == "HeightAboveGround" else name.rpartition("_")[2]


class Trainer:
    """Trains and scores on one scene; importances of finished runs serve later ones."""

    def __init__(self, scene: scenes.Scene, trees: int, threads: int | None) -> None:
        self.scene, self.trees, self.threads = scene, trees, threads
        self.names = names_of(scene)

    def run(
        self,
        count: int,
        seed: int,
        target: tuple[int, ...] | None = None,
        chosen: list[str] | None = None,
    ) -> dict[str, Any]:
        """Train on `count` samples per class; `target`: these labels as one class against all
        others."""
        scene, names = self.scene, chosen or self.names
        codes, train, test = self._labels(target)
        columns = scene.columns(names)
        rows = np.sort(draw(train, codes, count, seed))  # the table is a file: read it forwards
        x = np.ascontiguousarray(scene.train_values[rows][:, columns])
        low, high = limits(x, names)
        np.clip(x, low, high, out=x)
        forest = grow_forest(x, train[rows], trees=self.trees, seed=seed, threads=self.threads)
        predicted = predict(forest, scenes.Columns(scene.test_values, columns), codes, low, high)
        result = Accuracy.from_labels(test, predicted, classes=codes)
        ranked = sorted(zip(forest.feature_importances_.tolist(), names, strict=True), reverse=True)
        return {
            **figures(result),
            "features": len(names),
            "samples": len(x),
            "importance": {name: round(value, 6) for value, name in ranked},
        }

    def _labels(self, target: tuple[int, ...] | None) -> tuple[list[int], np.ndarray, np.ndarray]:
        train, test = self.scene.train.labels, self.scene.test.labels
        if target is None:
            return sorted(self.scene.classes), train, test
        code, other = target[0], 0 if target[0] != 0 else 255
        return (
            sorted([other, code]),
            np.where(np.isin(train, target), code, other),
            np.where(np.isin(test, target), code, other),
        )


def labels(text: str) -> tuple[int, ...]:
    """The labels of a target: ``6`` or ``5+6``."""
    return tuple(int(part) for part in text.split("+"))


def best_tenth(result: dict[str, Any]) -> list[str]:
    ranked = list(result["importance"])
    return sorted(ranked[: round(len(ranked) / 10)])


# ---- tables ------------------------------------------------------------------------------------------------


def report(runs: list[dict[str, Any]]) -> str:
    text = []
    for name in dict.fromkeys(run["scene"] for run in runs):
        here = choose(runs, scene=name)
        text.append(f"## {name}\n")
        rows = []
        for what in dict.fromkeys(
            (run["kind"], run["count"]) for run in here if run["target"] is None
        ):
            chosen = choose(here, kind=what[0], count=what[1], target=None)
            cells = [spread(values(chosen, key)) for key in ("oa", "kappa", "mcr", "mcp", "mf1")]
            rows.append(
                [what[0], f"{what[1]:,}", str(chosen[0]["features"]), str(len(chosen)), *cells]
            )
        scores = ("OA", "Kappa", "Mean recall", "Mean precision", "Mean F1")
        head = ("Features", "Samples per class", "Number", "Seeds", *scores)
        text.append(table(head, rows))
        codes = list(choose(here, kind="all", target=None)[0]["f1"])
        rows = []
        for what in dict.fromkeys(
            (run["kind"], run["count"]) for run in here if run["target"] is None
        ):
            chosen = choose(here, kind=what[0], count=what[1], target=None)
            rows.append(
                [f"{what[0]}, {what[1]:,}", *(spread(values(chosen, "f1", code)) for code in codes)]
            )
        text.append(
            "F1 by class\n\n" + table(("", *(scenes.name_of(name, code) for code in codes)), rows)
        )
        text.append(_binary(here))
        text.append(_carriers(here))
    return "\n".join(text)


#: Measures of a class, and of a whole run, in the tables of binary experiments.
OF_CLASS, OF_RUN = ("recall", "precision", "f1"), ("oa", "kappa", "mf1")


def against_others(run: dict[str, Any], codes: list[int]) -> dict[str, Any]:
    """Return the figures of a run where the codes are class 1, and all others class 0."""
    counts, target = np.asarray(run["matrix"]), np.isin(run["classes"], codes)
    sides = (~target, target)
    parts = [[int(counts[np.ix_(true, found)].sum()) for found in sides] for true in sides]
    return figures(Accuracy.from_confusion(parts, (0, 1)))


def _binary(runs: list[dict[str, Any]]) -> str:
    """Return a table of binary runs as [W18 Table 2], beside the same class of multi-class runs."""
    rows = []
    for target, count in dict.fromkeys(
        (r["target"], r["count"]) for r in runs if r["target"] is not None
    ):
        ours = choose(runs, target=target, count=count)
        multi = choose(runs, target=None, kind="all", count=count)
        codes = [int(code) for code in target.split("+")]
        scene = runs[0]["scene"]
        label = " and ".join(scenes.name_of(scene, code) for code in codes)
        for words, chosen in (("binary", ours), ("multi-class", multi)):
            both = [
                against_others(run, codes[:1] if words == "binary" else codes) for run in chosen
            ]
            cells = [
                spread(values(both, key, str(code))) for code in (1, 0) for key in OF_CLASS
            ] + [spread(values(both, key)) for key in OF_RUN]
            rows.append([f"{label}, {words}", f"{count:,}", str(len(chosen)), *cells])
    each = ("recall", "precision", "F1")
    head = (*map(str.capitalize, each), *(f"Background {word}" for word in each))
    head = ("Target", "Samples per class", "Seeds", *head, "OA", "Kappa", "Mean F1")
    return table(head, rows) if rows else ""


def _carriers(runs: list[dict[str, Any]]) -> str:
    """Say where the best tenth comes from, and its share of all importance."""
    text = []
    for label, part in (("Neighborhood", neighborhood), ("Kind", group)):
        share: Counter[str] = Counter()
        places: Counter[str] = Counter()
        full = choose(runs, kind="all", target=None)
        full = [run for run in full if run["count"] == min(r["count"] for r in full)]
        for run in full:
            for name, value in run["importance"].items():
                share[part(name)] += 100 * value / len(full)
            places.update(part(name) for name in best_tenth(dict(run)))
        rows = [
            [name, f"{value:.1f} %", f"{places[name] / len(full):.1f}"]
            for name, value in share.most_common()
        ]
        text.append(table((label, "Share of importance", "Features in the best tenth"), rows))
    first = list(full[0]["importance"].items())[:15]
    text.append(
        table(("Feature (seed 0)", "Importance"), [[n, f"{100 * v:.2f} %"] for n, v in first])
    )
    return "\n".join(text)


def run_scene(
    scene: scenes.Scene, results: Results, args: Any, targets: tuple[tuple[int, ...], ...]
) -> list[dict[str, Any]]:
    trainer, runs = Trainer(scene, args.trees, args.threads), []

    def get(make, **run: Any) -> dict[str, Any]:
        run = {"scene": scene.name, "trees": args.trees, **run}
        runs.append({**run, **results.get(run, make)})
        return runs[-1]

    few = args.count[0]
    for seed in range(args.seeds):
        full = get(
            lambda s=seed: trainer.run(few, s), kind="all", count=few, target=None, seed=seed
        )
        best = best_tenth(full)
        get(
            lambda s=seed, b=best: trainer.run(few, s, chosen=b),
            kind="best tenth", count=few, target=None, seed=seed,
        )  # fmt: skip
        chance = sorted(
            np.random.default_rng(seed).choice(trainer.names, len(best), replace=False).tolist()
        )
        get(
            lambda s=seed, c=chance: trainer.run(few, s, chosen=c),
            kind="a tenth by chance", count=few, target=None, seed=seed,
        )  # fmt: skip
    for count in args.count:
        for seed in range(args.seeds if count == few else args.large_seeds):
            if count != few:
                get(
                    lambda s=seed, n=count: trainer.run(n, s),
                    kind="all",
                    count=count,
                    target=None,
                    seed=seed,
                )
            for target in targets:
                get(
                    lambda s=seed, n=count, t=target: trainer.run(n, s, target=t),
                    kind="all", count=count, target="+".join(map(str, target)), seed=seed,
                )  # fmt: skip
    return runs


def main() -> None:
    options = parser(__doc__)
    scenes.add_options(options)
    options.add_argument("--count", type=int, nargs="+", default=[10_000, 100_000])
    options.add_argument("--large-seeds", type=int, default=1, help="for all counts but the first")
    options.add_argument("--trees", type=int, default=100)
    options.add_argument(
        "--target",
        nargs="+",
        type=labels,
        help="classes found by themselves; 5+6: two labels as one class",
    )
    args = options.parse_args()
    if args.data is None:
        options.error("name the folder of the clouds: --data DIR, or PDAL_STAGES_DATA")
    cache, runs = Cache(args.cache), []
    for name in args.scene:
        classes = tuple(args.classes) if args.classes else None
        scene = scenes.load(
            args.data, name, cache, classes=classes, columns=args.columns, threads=args.threads
        )
        if args.chequerboard:
            scene = scenes.chequerboard(scene)
        note(f"{scene.name}: tables of {scene.train_values.shape} and {scene.test_values.shape}")
        path = None if args.cache is None else args.cache / "w18.jsonl"
        targets = tuple(args.target) if args.target else TARGETS.get(name.partition(",")[0], ())
        runs += run_scene(
            scene, Results(path, {**scenes.context(scene), "experiment": EXPERIMENT}), args, targets
        )
    finish(args, runs, "[W18]'s questions", report(runs))


if __name__ == "__main__":
    main()
