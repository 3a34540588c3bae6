"""How much worse a survey may be flown: each one made noisier and its strips moved apart, by the model that has not seen it.

    python benchmarks/surveys/worse.py --data DIR --models MODELS

MODELS is what ``leave_one_out.py --save`` filled. OA over ground, vegetation and building, percent: as published, with
Gaussian noise of the heights, and as if every other point, drawn at random, were of a strip that lies higher or to the side.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from clouds import SURVEYS, Cloud, load, slug
from leave_one_out import score

from pdal_stages import load_model

#: (n, 3) meters added to the points, of their number and a generator.
Move = Callable[[int, np.random.Generator], np.ndarray]


def noise(sigma: float) -> Move:
    """Heights scatter by that many meters."""
    return lambda n, random: np.column_stack([np.zeros((n, 2)), random.normal(0.0, sigma, n)])


def strips(aside: float, up: float) -> Move:
    """One of two strips lies so many meters to the side and higher."""
    return lambda n, random: np.outer(random.random(n) < 0.5, [aside, 0.0, up])


KINDS = {
    "noise of 3 cm": noise(0.03),
    "6 cm": noise(0.06),
    "10 cm": noise(0.1),
    "strips 10 cm apart in height": strips(0.0, 0.1),
    "30 cm aside, 5 cm in height": strips(0.3, 0.05),
}


def worse(cloud: Cloud) -> Iterator[Cloud]:
    """The survey, then as each of KINDS has it."""
    yield cloud
    for name, move in KINDS.items():
        moved = cloud.xyz + move(len(cloud.xyz), np.random.default_rng(7))
        yield cloud.part(np.arange(len(moved)), f"{cloud.name}, {name}", np.round(moved, 3))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    options.add_argument("--models", type=Path, required=True, help="folder of leave_one_out.py --save")
    options.add_argument("--surveys", nargs="+", default=list(SURVEYS), choices=list(SURVEYS))
    args = options.parse_args()
    print("| survey left out | as published | " + " | ".join(KINDS) + " |")
    print("|---|" + "---:|" * (1 + len(KINDS)))
    for survey in args.surveys:
        model = load_model(args.models / f"{slug(survey)}.model")
        found = [score(model, one)["oa"] for one in worse(load(args.data, survey))]
        print(f"| {survey} | " + " | ".join(f"{oa:.1f}" for oa in found) + " |", flush=True)


if __name__ == "__main__":
    main()
