"""What else could use a point's surroundings, beside today's second pass: on parts of clouds that no model has seen.

    python benchmarks/beside_context.py --data DIR                    # every row
    python benchmarks/beside_context.py --data DIR --rows segments

The parts are those of ``defaults.py``. All rows share the first pass; probabilities of training points come from forests
that have not seen them. ``segments``: a second pass that also reads the size, height, flatness and mean probabilities of the
connected cells of one class that a point lies in. ``boosting``: scikit-learn's histogram gradient boosting in place of a
forest, in one pass or as the second. ``smoothing`` and ``graph`` act after the second pass: a mean over a sphere, and the
least Potts energy on the graph of six nearest neighbors by alpha expansion (needs ``gco-wrapper``). One thread, CPU seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from defaults import CODES, held_out, options
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pdal_stages.accuracy import Accuracy
from pdal_stages.classifier import Forest, TrainingCloud
from pdal_stages.classifier.context import Context
from pdal_stages.classifier.dimensions import gather, known, with_returns
from pdal_stages.classifier.foresttraining import feature_plan
from pdal_stages.classifier.growing import TreeOptions, grow
from pdal_stages.classifier.smoothing import count_shares, smooth
from pdal_stages.classifier.trainoptions import DEFAULT_CONTEXT, TrainingOptions
from pdal_stages.classifier.trees import Ranked
from pdal_stages.features import FeatureEngine
from pdal_stages.features.voxels import represent

TREES, FOLDS, SEED = 50, 5, 0
#: Meters: side of the cells of segments, and the distance at which the graph's edges count 1/e.
CELL, REACH = 0.5, 0.5

Table = npt.NDArray[np.float32]


@dataclass(eq=False)
class Part:
    """A cloud's representatives, their features, and what the first pass says of them."""

    xyz: npt.NDArray[np.float64]
    height: npt.NDArray[np.floating]
    position: npt.NDArray[np.int64]  # of the class; -1 is not trained on
    values: Table
    of: npt.NDArray[np.int64]  # representative of every point
    shares: npt.NDArray[np.uint16] | None = None

    @classmethod
    def made(cls, cloud: TrainingCloud, given: TrainingOptions, codes: tuple[int, ...]) -> Part:
        """Features of a cloud."""
        few = represent(cloud.xyz, given.voxel, known(given.inputs, cloud.dimensions, len(cloud.xyz)))
        rows, of = np.arange(len(cloud.xyz)), np.arange(len(cloud.xyz))
        if few is not None:
            points, place = few.members(np.arange(len(few.rows)))
            rows = few.rows
            of[points] = place
        part, plan = cloud.part(rows), feature_plan(given)
        dimensions = with_returns(plan.dimensions, part.xyz, part.dimensions)
        own, _ = gather(plan.dimensions, dimensions, len(rows))
        values = np.empty((len(rows), len(plan.names)), np.float32)
        for at, block in FeatureEngine(part.xyz, plan, threads=1).blocks(None, dimensions=own, threads=1):
            values[at] = block
        label = np.searchsorted(codes, part.labels).clip(0, len(codes) - 1)
        position = np.where(np.isin(part.labels, codes), label, -1)
        return cls(part.xyz, np.asarray(own["HeightAboveGround"]), position, values, of)


@dataclass(eq=False)
class Scene:
    """What is trained on, its samples, and what is classified."""

    rest: Part
    held: Part
    rows: npt.NDArray[np.int64]
    weight: npt.NDArray[np.int64]
    factors: npt.NDArray[np.float64]
    first: npt.NDArray[np.float64]

    @classmethod
    def made(cls, rest: Part, held: Part, classes: int, count: int, weight: float) -> Scene:
        """Samples and the first pass: out of strips for `rest`, whole for `held`."""
        random = np.random.default_rng(SEED)
        rows, times = [], []
        for label in range(classes):
            at = np.flatnonzero(rest.position == label)
            if len(at) >= count:
                rows.append(random.choice(at, count, replace=False))
                times.append(np.ones(count, np.int64))
            elif len(at):
                rows.append(at)
                times.append(np.bincount(random.integers(0, len(at), count), minlength=len(at)))
        picked, number = np.concatenate(rows), np.concatenate(times)
        picked, number = picked[number > 0], number[number > 0]
        label = rest.position[picked]
        strip = np.floor(rest.xyz[:, :2].sum(axis=1) / np.sqrt(2.0) / 10.0).astype(np.int64) % FOLDS
        rest.shares = np.empty((len(rest.xyz), classes), np.uint16)
        for fold in range(FOLDS):
            one = forest(rest.values[picked], label, number * (strip[picked] != fold), TREES // 4 + 1)
            at = np.flatnonzero(strip == fold)
            rest.shares[at] = count_shares(one.predict_proba(rest.values[at]))
        first = forest(rest.values[picked], label, number, TREES).predict_proba(held.values)
        held.shares = count_shares(first)
        there = np.bincount(rest.position[rest.position >= 0], minlength=classes)
        drawn = np.bincount(label, number, classes)
        return cls(rest, held, picked, number, (there / drawn) ** weight, first)

    def both(self, more: Callable[[Part], Table]) -> tuple[Table, Table]:
        """Features with further columns: of the samples, and of what is held out."""
        rest, held = self.rest, self.held
        return (
            np.concatenate([rest.values[self.rows], more(rest)[self.rows]], axis=1),
            np.concatenate([held.values, more(held)], axis=1),
        )


def forest(values: Table, label: Any, weight: Any, trees: int) -> Forest:
    """As training grows it."""
    setting = TreeOptions(None, 3, 1.0, "auto")
    grown = grow(Ranked.of(values, 1), label, weight, trees, setting, SEED, threads=1)
    return Forest.from_trees([tree for tree, _, _ in grown], values.shape[1])


def context(part: Part) -> Table:
    """The default context of every point."""
    wanted = Context(DEFAULT_CONTEXT)
    out = np.empty((len(part.xyz), len(wanted.tokens) * part.shares.shape[1]), np.float32)
    wanted.tables(part.xyz, part.shares, 1).fill(np.arange(len(out)), out)
    return out


def segments(part: Part) -> Table:
    """Of a point's connected cells of one class: area, number, height range and spread, height, slimness, probabilities."""
    shares, classes = part.shares, part.shares.shape[1]
    cell = np.floor((part.xyz - part.xyz.min(axis=0)) / CELL).astype(np.int64) + 1
    size = cell.max(axis=0) + 2
    column = cell[:, 0] * size[1] + cell[:, 1]
    key = (column * size[2] + cell[:, 2]) * classes + shares.argmax(axis=1)
    unique, inverse = np.unique(key, return_inverse=True)
    pairs = []
    for step in np.ndindex(3, 3, 3):
        dx, dy, dz = (k - 1 for k in step)
        if (dx, dy, dz) > (0, 0, 0):
            wanted = unique + ((dx * size[1] + dy) * size[2] + dz) * classes
            at = np.searchsorted(unique, wanted).clip(0, len(unique) - 1)
            there = np.flatnonzero(unique[at] == wanted)
            pairs.append(np.stack([there, at[there]]))
    row, col = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(row), np.int8), (row, col)), shape=(len(unique), len(unique)))
    n, part_of = connected_components(graph, directed=False)
    segment = part_of[inverse].astype(np.int64)
    count = np.bincount(segment, minlength=n)

    def mean(values: Any) -> npt.NDArray[np.float64]:
        return np.bincount(segment, values, n) / count

    z = part.xyz[:, 2]
    top, bottom = np.full(n, -np.inf), np.full(n, np.inf)
    np.maximum.at(top, segment, z)
    np.minimum.at(bottom, segment, z)
    area = np.bincount(np.unique((segment << 40) + column) >> 40, minlength=n) * CELL**2
    found = [
        np.log1p(area),
        np.log1p(np.bincount(part_of, minlength=n)),
        top - bottom,
        np.sqrt(np.maximum(mean(z**2) - mean(z) ** 2, 0.0)),
        mean(part.height),
        (top - bottom) / np.sqrt(area),
        *(mean(shares[:, c].astype(float)) for c in range(classes)),
    ]
    return np.stack(found, axis=1).astype(np.float32)[segment]


def boosted(values: Table, scene: Scene, asked: Table) -> npt.NDArray[np.float64]:
    """Probabilities by gradient boosting."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    made = HistGradientBoostingClassifier(max_iter=150, l2_regularization=1.0, random_state=SEED)
    return made.fit(values, scene.rest.position[scene.rows], scene.weight).predict_proba(asked)


def least_energy(xyz: npt.NDArray[np.float64], p: npt.NDArray[np.float64], weight: float) -> npt.NDArray[Any]:
    """The labelling of least Potts energy."""
    import gco

    distance, near = cKDTree(xyz).query(xyz, 7)
    ends = np.sort(np.stack([np.repeat(np.arange(len(xyz)), 6), near[:, 1:].ravel()], axis=1), axis=1)
    edges, first = np.unique(ends, axis=0, return_index=True)
    worth = weight * np.exp(-distance[:, 1:].ravel()[first] / REACH)
    unlike = 1.0 - np.eye(p.shape[1])
    return gco.cut_general_graph(edges, worth, -np.log(p.clip(1e-3)), unlike, n_iter=3, algorithm="expansion")


def after(act: Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], Any]) -> Callable[[Scene], Any]:
    """A row that acts on what the second pass says."""

    def row(scene: Scene) -> Any:
        p = second(scene) * scene.factors
        return act(scene.held.xyz, p / p.sum(axis=1, keepdims=True))

    return row


def second(scene: Scene, more: Callable[[Part], Table] = context) -> npt.NDArray[np.float64]:
    """Probabilities of the second pass."""
    values, asked = scene.both(more)
    return forest(values, scene.rest.position[scene.rows], scene.weight, TREES).predict_proba(asked)


ROWS: dict[str, Callable[[Scene], Any]] = {
    "one pass": lambda scene: scene.first * scene.factors,
    "two passes": lambda scene: second(scene) * scene.factors,
    "segments": lambda scene: (
        second(scene, lambda part: np.concatenate([context(part), segments(part)], axis=1)) * scene.factors
    ),
    "boosting, one pass": lambda scene: (
        boosted(scene.rest.values[scene.rows], scene, scene.held.values) * scene.factors
    ),
    "boosting, second pass": lambda scene: (
        boosted((both := scene.both(context))[0], scene, both[1]) * scene.factors
    ),
    "smoothing, 0.5 m": after(lambda xyz, p: smooth(xyz, count_shares(p), 0.5, 1)),
    "smoothing, 1 m": after(lambda xyz, p: smooth(xyz, count_shares(p), 1.0, 1)),
    "graph, 0.3": after(lambda xyz, p: least_energy(xyz, p, 0.3)),
    "graph, 1": after(lambda xyz, p: least_energy(xyz, p, 1.0)),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the clouds")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--count", type=int, default=2500, help="samples of each class")
    given = parser.parse_args()
    found: dict[str, dict[str, Any]] = {row: {} for row in given.rows}
    seconds = dict.fromkeys(given.rows, 0.0)
    for name, rest, held in held_out(given.data):
        codes = CODES[name]
        how = options({}, codes, given.count)
        scene = Scene.made(
            Part.made(rest, how, codes),
            Part.made(held, how, codes),
            len(codes),
            given.count,
            how.prior_weight,
        )
        usable = np.isin(held.labels, codes)
        for row in given.rows:
            began = time.process_time()
            answer = np.asarray(ROWS[row](scene))
            seconds[row] += time.process_time() - began
            best = (answer.argmax(axis=1) if answer.ndim == 2 else answer)[scene.held.of]
            matrix = found[row].setdefault(name, np.zeros((len(codes), len(codes)), np.int64))
            np.add.at(matrix, (np.searchsorted(codes, held.labels[usable]), best[usable].astype(int)), 1)
        print(f"{name}: a part held out", flush=True)
    print(f"| | {' | '.join(CODES)} | CPU s |\n|---|" + "---:|" * (len(CODES) + 1))
    for row in given.rows:
        cells = []
        for name, matrix in found[row].items():
            score = Accuracy.from_confusion(matrix, CODES[name])
            low = f" / {100 * score.f1[3]:.1f}" if 3 in CODES[name] else ""
            cells.append(f"{100 * score.overall_accuracy:.1f} / {100 * score.mean_f1:.1f}{low}")
        print(f"| {row} | {' | '.join(cells)} | {seconds[row]:.0f} |")


if __name__ == "__main__":
    main()
