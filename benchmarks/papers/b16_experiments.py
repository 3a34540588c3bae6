"""[B16]'s experiments on real production clouds: seven neighborhoods x three feature sets on each
scene.

    python benchmarks/papers/b16_experiments.py --data DIR --cache DIR

DIR holds montpellier/ and delft/ (train*.laz, test*.laz), or any folder of ``.pts`` text (see
pts_input.py). Measures are the covariance and geometric features and the point's own height Z;
distributions are the shape distributions. 1,000 samples per class, a forest of fully grown trees,
all test points of the classes. The number of trees is searched in a grid, as the paper does; it
does not say by what. Here it is the one of TREES whose forest is right about the most of its
out-of-bag samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scenes
from kit import Cache, Results, draw, figures, finish, limits, note, parser, predict, search_trees
from tables import choose, spread, table, values

from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.classifier.training_options import RECIPES
from pdal_stages.features.registry import GROUPS

NEIGHBORHOODS = {
    "c1": ("c1",),
    "c2": ("c2",),
    "c3": ("c3",),
    "c5": ("c5",),
    "kopt": ("kopt",),
    "all cylinders": ("c1", "c2", "c3", "c5"),
    "all": ("c1", "c2", "c3", "c5", "kopt"),
}
SETS = ("measures", "distributions", "both")
COUNT = 1000
TREES = RECIPES["blomley2016"]["trees_grid"]
EXPERIMENT = 3  # raised when runs mean something else than before, so that none is resumed


def names_of(tokens: tuple[str, ...], feature_set: str) -> list[str]:
    """Names of an experiment's features; Z belongs to the measures, once."""
    measures = (*GROUPS["covariance"], *GROUPS["geometric"])
    wanted = {
        "measures": measures,
        "distributions": GROUPS["shapes"],
        "both": (*measures, *GROUPS["shapes"]),
    }
    result = [
        f"{word}_{token}"
        for token in tokens
        for word in wanted[feature_set]
        if word != "Radius" or token == "kopt"  # a cylinder's is the same everywhere
    ]
    return result if feature_set == "distributions" else [*result, "Z"]


def experiment(
    scene: scenes.Scene, neighborhood: str, feature_set: str, seed: int, threads: int | None
) -> dict[str, Any]:
    """One of the experiments."""
    names = names_of(NEIGHBORHOODS[neighborhood], feature_set)
    columns = scene.columns(names)
    rows = draw(scene.train.labels, scene.classes, COUNT, seed)
    chosen = np.array(scene.train_values[rows])[:, columns]
    low, high = limits(chosen, names)
    forest = search_trees(
        np.clip(chosen, low, high), scene.train.labels[rows], TREES, seed=seed, threads=threads
    )
    prediction = predict(
        forest, scenes.Columns(scene.test_values, columns), scene.classes, low, high
    )
    result = Accuracy.from_labels(scene.test.labels, prediction, classes=scene.classes)
    return {**figures(result), "features": len(names), "trees": len(forest.estimators_)}


# ---- tables ------------------------------------------------------------------------------------------------


def report(runs: list[dict[str, Any]]) -> str:
    """All tables as Markdown."""
    text = []
    for name in dict.fromkeys(run["scene"] for run in runs):
        here = choose(runs, scene=name)
        text.append(f"## {name}\n")
        for key, words in (
            ("kappa", "Kappa"),
            ("oa", "Overall accuracy"),
            ("mcr", "Mean class recall"),
            ("mcp", "Mean class precision"),
            ("mf1", "Mean F1"),
        ):
            rows = [
                [
                    hood,
                    *(
                        spread(values(choose(here, neighborhood=hood, set=kind), key))
                        for kind in SETS
                    ),
                ]
                for hood in NEIGHBORHOODS
            ]
            text.append(f"{words} [%]\n\n" + table(("Neighborhood", *SETS), rows))
        for key in ("recall", "precision"):
            for code in here[0]["recall"]:
                rows = [
                    [
                        hood,
                        *(
                            spread(values(choose(here, neighborhood=hood, set=kind), key, code), 1)
                            for kind in SETS
                        ),
                    ]
                    for hood in NEIGHBORHOODS
                ]
                words = f"{scenes.name_of(name, code)}: {key} [%]\n\n"
                text.append(words + table(("Neighborhood", *SETS), rows))
        chosen = [run["trees"] for run in here]
        text.append(
            "Trees chosen: "
            + ", ".join(
                f"{n} in {chosen.count(n)} of {len(chosen)} forests" for n in sorted(set(chosen))
            )
            + "\n"
        )
        text.append(_findings(here))
    return "\n".join(text)


def _findings(runs: list[dict[str, Any]]) -> str:
    """Return how often each of the paper's three findings holds, seed against seed."""

    def better(first: tuple[str, str], second: tuple[str, str]) -> str:
        pairs = []
        for a in choose(runs, neighborhood=first[0], set=first[1]):
            for b in choose(runs, neighborhood=second[0], set=second[1], seed=a["seed"]):
                pairs.append(a["kappa"] - b["kappa"])
        won = sum(gain > 0 for gain in pairs)
        return f"{np.mean(pairs):+.2f} ({won} of {len(pairs)})" if pairs else "–"

    rows = [
        [f"both sets beat measures, {hood}", better((hood, "both"), (hood, "measures"))]
        for hood in NEIGHBORHOODS
    ]
    rows += [
        [f"both sets beat distributions, {hood}", better((hood, "both"), (hood, "distributions"))]
        for hood in NEIGHBORHOODS
    ]
    singles = ("c1", "c2", "c3", "c5")
    rows += [
        [
            f"all cylinders beat {neighborhood}, {feature_set}",
            better(("all cylinders", feature_set), (neighborhood, feature_set)),
        ]
        for feature_set in SETS
        for neighborhood in singles
    ]
    rows += [
        [
            f"all beat {neighborhood}, {feature_set}",
            better(("all", feature_set), (neighborhood, feature_set)),
        ]
        for feature_set in SETS
        for neighborhood in ("all cylinders", "kopt")
    ]
    head = ("Finding", "Gain in kappa, mean over seeds (seeds where it holds)")
    return "The paper's findings, tested\n\n" + table(head, rows)


def run_scene(
    scene: scenes.Scene, results: Results, seeds: int, threads: int | None
) -> list[dict[str, Any]]:
    runs = []
    for seed in range(seeds):
        for feature_set in SETS:
            for hood in NEIGHBORHOODS:
                run = {"scene": scene.name, "neighborhood": hood, "set": feature_set, "seed": seed}
                tables = results.get(
                    run, lambda h=hood, f=feature_set, s=seed: experiment(scene, h, f, s, threads)
                )
                runs.append({**run, **tables})
    return runs


def main() -> None:
    options = parser(__doc__)
    scenes.add_options(options)
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
        path = None if args.cache is None else args.cache / "b16.jsonl"
        runs += run_scene(
            scene,
            Results(path, {**scenes.context(scene), "experiment": EXPERIMENT}),
            args.seeds,
            args.threads,
        )
    finish(args, runs, "[B16]'s experiments", report(runs))


if __name__ == "__main__":
    main()
