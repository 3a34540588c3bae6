"""One forest, applied by scikit-learn and by the package: what ``features.py`` times as its case ``forest``."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pdal_stages.base.threads import map_blocks
from pdal_stages.classifier.forest import Forest
from pdal_stages.classifier.trainoptions import TrainingOptions
from pdal_stages.features import compute_features

#: Training samples of each class, and rows that are handed over at a time.
SAMPLES, ROWS = 10_000, 32_768


def default_features(xyz: np.ndarray, threads: int | None) -> np.ndarray:
    """The neighborhoods' features that training uses by default, (n, 48) float32."""
    options = TrainingOptions()
    wanted = [name for name in options.feature_set if name != "HeightAboveLowest"]
    return compute_features(xyz, None, options.neighborhoods, wanted, threads=threads).values


class Forests:
    """A forest of default size over default features, grown once for each cloud.

    Parameters
    ----------
    threads : int
        For both.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._grown: dict[int, tuple] = {}

    def of(self, xyz: np.ndarray, labels: np.ndarray) -> tuple:
        """(features, scikit-learn's forest, ours) of a cloud."""
        if len(xyz) not in self._grown:
            from sklearn.ensemble import RandomForestClassifier

            options, random = TrainingOptions(), np.random.default_rng(0)
            values = default_features(xyz, self._threads)
            rows = [np.flatnonzero(labels == code) for code in np.unique(labels)]
            some = np.concatenate([random.permutation(here)[:SAMPLES] for here in rows])
            theirs = RandomForestClassifier(
                options.trees,
                min_samples_leaf=options.min_samples_leaf,
                random_state=0,
                n_jobs=self._threads,
            )
            theirs.fit(values[some], labels[some])
            self._grown[len(xyz)] = values, theirs, Forest.from_sklearn(theirs.estimators_, values.shape[1])
        return self._grown[len(xyz)]

    def ours(self, xyz: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
        """CPU and wall seconds of the package's forest for all points."""
        values, _, forest = self.of(xyz, labels)
        blocks = [values[start : start + ROWS] for start in range(0, len(values), ROWS)]
        return clocked(lambda: list(map_blocks(forest.predict_proba, blocks, self._threads)))

    def scikit_learn(self, xyz: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
        """The same of scikit-learn's ``predict_proba``."""
        values, forest, _ = self.of(xyz, labels)
        return clocked(lambda: forest.predict_proba(values))


def clocked(work: Callable[[], object]) -> tuple[float, float]:
    """CPU seconds of all threads, and wall seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall
