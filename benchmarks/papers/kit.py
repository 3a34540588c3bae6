"""What the commands of this folder share: cached features, forests, results that resume."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from clouds import Cloud

import pdal_stages
from pdal_stages.accuracy.measures import Accuracy
from pdal_stages.base.progress import Progress
from pdal_stages.classifier.random_forest import Forest
from pdal_stages.features import FeatureEngine, FeaturePlan, ShapeBins

#: Parts of a result that --json leaves out.
BULKY = ("clouds", "importance")


# ---- the cache ---------------------------------------------------------------------------------------------


def code_fingerprint() -> str:
    """Changes whenever code that features depend on does."""
    root = Path(pdal_stages.__file__).parent
    digest = hashlib.sha256()
    for path in sorted([*root.glob("features/*.py"), *root.glob("terrain/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def fingerprint(*arrays: np.ndarray) -> str:
    """Return a digest of the content of arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(str((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


class Cache:
    """Arrays in a folder, each keyed by everything it was made from; files appear whole or not at
    all.

    Parameters
    ----------
    folder : Path, optional
        Made where absent; ``None`` keeps nothing.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def array(self, key: Mapping[str, Any], make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of a key: read where it is there (as a map of the file), else made and kept."""
        if self.folder is None:
            return make()
        text = json.dumps({"code": code_fingerprint(), **key}, sort_keys=True)
        path = (
            self.folder
            / f"{key.get('what', 'array')}-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npy"
        )
        if not path.exists():
            value = make()
            beside = path.with_suffix(f".{os.getpid()}.tmp")
            with open(beside, "wb") as file:
                np.save(file, value)
            os.replace(beside, path)
        return np.load(path, mmap_mode="r")


def features(
    cloud: Cloud,
    plan: FeaturePlan,
    cache: Cache,
    *,
    bins: ShapeBins | None = None,
    copt_threshold: float | None = None,
    queries: np.ndarray | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> np.ndarray:
    """Features of a cloud's points (or of those at `queries`), (m, F) float32, from the cache where
    it has them."""
    rows = np.arange(len(cloud)) if queries is None else queries
    options = {
        name: np.asarray(cloud.dimensions[name])[rows]
        for name in plan.dimensions
        if name not in "XYZ"
    }
    key = {
        "what": "features",
        "plan": plan.to_dict(),
        "cloud": fingerprint(cloud.xyz),
        "queries": None if queries is None else fingerprint(queries),
        "dimensions": {name: fingerprint(value) for name, value in options.items()},
        "bins": None if bins is None else bins.to_dict(),
        "copt": copt_threshold,
        "seed": seed,
    }

    def make() -> np.ndarray:
        start = time.process_time()
        engine = FeatureEngine(
            cloud.xyz, plan, bins=bins, copt_threshold=copt_threshold, seed=seed, threads=threads
        )
        label = f"features of {cloud.name}"
        with Progress(len(rows), label) as progress:
            table = engine.table(queries, dimensions=options or None, progress=progress)
        note(
            f"{label}: {len(rows):,} x {len(plan.names)} in {time.process_time() - start:.1f} CPU s"
        )
        return table.values

    return cache.array(key, make)


def fitted_bins(
    cloud: Cloud, plan: FeaturePlan, cache: Cache, seed: int, threads: int | None
) -> ShapeBins | None:
    """Thresholds of the shape distributions, fitted to a training cloud [B16 3.2.2]."""
    if not plan.shapes:
        return None
    tokens = [columns.neighborhood.token for columns in plan.layout if columns.shapes]
    key = {"what": "bins", "cloud": fingerprint(cloud.xyz), "plan": plan.to_dict(), "seed": seed}

    def make() -> np.ndarray:
        engine = FeatureEngine(cloud.xyz, plan, seed=seed, threads=threads).fit()
        assert engine.bins is not None
        return np.stack([engine.bins.thresholds(token) for token in tokens])

    return ShapeBins(dict(zip(tokens, np.array(cache.array(key, make)), strict=True)))


# ---- forests -----------------------------------------------------------------------------------------------


def draw(labels: np.ndarray, classes: Sequence[int], count: int, seed: int) -> np.ndarray:
    """`count` random points of each class; a class that has fewer gives each of its points about
    equally often."""
    random = np.random.default_rng(seed)
    rows = []
    for code in classes:
        here = np.flatnonzero(labels == code)
        if not len(here):
            sys.exit(f"class {code} has no training points")
        share, rest = divmod(count, len(here))
        rows.append(
            np.concatenate([np.tile(here, share), random.choice(here, rest, replace=False)])
        )
    return np.concatenate(rows)


def limits(values: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """1st and 99th percentile of each shape measure, heights among them; histograms are not cut
    [B16 3.3, W18 3.2].

    Trees need no scaling, but values beyond are cut off.
    """
    low, high = np.percentile(values, [1, 99], axis=0).astype(np.float32)
    low = np.where(
        values.min(axis=0) == 0, np.float32(0), low
    )  # the absolute minimum, not the least absolute value
    histogram = np.array([name.startswith(("A3_", "D1_", "D2_", "D3_", "D4_")) for name in names])
    low[histogram], high[histogram] = -np.inf, np.inf
    return low, high


def grow_forest(
    values: np.ndarray,
    labels: np.ndarray,
    *,
    trees: int,
    seed: int,
    depth: int | None = None,
    threads: int | None = None,
):
    """A Random Forest as the papers describe it: Breiman's, sqrt(features) tried at a node."""
    from sklearn.ensemble import RandomForestClassifier

    forest = RandomForestClassifier(trees, max_depth=depth, random_state=seed, n_jobs=threads or -1)
    return forest.fit(values, labels)


def search_trees(
    values: np.ndarray,
    labels: np.ndarray,
    counts: Sequence[int],
    *,
    seed: int,
    threads: int | None = None,
):
    """The forest of as many trees as are right about the most out-of-bag samples; of equals the
    smallest."""
    from sklearn.ensemble import RandomForestClassifier

    forest = RandomForestClassifier(
        warm_start=True, oob_score=True, random_state=seed, n_jobs=threads or -1
    )
    scores = {}
    for count in sorted(counts):
        forest.n_estimators = count
        scores[count] = forest.fit(values, labels).oob_score_
    best = max(scores, key=lambda count: (scores[count], -count))
    forest.estimators_ = forest.estimators_[:best]
    return forest


def predict(
    forest, values: np.ndarray, classes: Sequence[int], low=None, high=None, chunk: int = 65_536
):
    """Class codes of rows, chunk by chunk (they may lie in a file)."""
    ours = Forest.from_sklearn(forest.estimators_, values.shape[1])
    codes = np.asarray(forest.classes_)
    assert set(codes.tolist()) <= set(classes)
    result = np.empty(len(values), codes.dtype)
    for start in range(0, len(values), chunk):
        part = np.ascontiguousarray(values[start : start + chunk], np.float32)
        if low is not None:
            part = np.clip(part, low, high)
        result[start : start + chunk] = codes[ours.predict_proba(part).argmax(axis=1)]
    return result


def figures(result: Accuracy) -> dict[str, Any]:
    """All measures in per cent, and the matrix they come from."""
    names = {
        "oa": "overall_accuracy",
        "kappa": "kappa",
        "mcr": "mean_class_recall",
        "mcp": "mean_class_precision",
        "mf1": "mean_f1",
    }
    return {
        **{short: 100 * float(getattr(result, long) or 0) for short, long in names.items()},
        "recall": {str(c.code): 100 * (c.recall or 0) for c in result.per_class},
        "precision": {str(c.code): 100 * (c.precision or 0) for c in result.per_class},
        "f1": {str(c.code): 100 * (c.f1 or 0) for c in result.per_class},
        "classes": list(result.classes),
        "matrix": np.asarray(result.matrix).tolist(),
    }


# ---- results that resume -----------------------------------------------------------------------------------


class Results:
    """Finished runs in a file of JSON lines; a run that is there is not done again.

    Parameters
    ----------
    path : Path, optional
        ``None`` keeps them in memory only.
    context : mapping
        What all runs depend on (data, code); lines of another context are ignored.
    """

    def __init__(self, path: Path | None, context: Mapping[str, Any]) -> None:
        self.path, self.context = (
            path,
            json.loads(json.dumps({"code": code_fingerprint(), **context})),
        )
        self.done: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists():
            for line in path.read_text().splitlines():
                try:
                    entry = json.loads(line)
                except json.JSONDecodeError:  # the last line of an interrupted run
                    continue
                if entry["context"] == self.context:
                    self.done[json.dumps(entry["run"], sort_keys=True)] = entry["result"]

    def get(self, run: Mapping[str, Any], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of a run, done now where it has not been."""
        key = json.dumps(run, sort_keys=True)
        if key not in self.done:
            start = time.process_time(), time.perf_counter()
            result = make()
            seconds = {
                "cpu": round(time.process_time() - start[0], 1),
                "wall": round(time.perf_counter() - start[1], 1),
            }
            self.done[key] = json.loads(json.dumps({**result, "seconds": seconds}))
            if self.path is not None:
                with open(self.path, "a") as file:
                    line = {"context": self.context, "run": dict(run), "result": self.done[key]}
                    file.write(json.dumps(line) + "\n")
            note(f"{key}: {brief(result)}, {seconds['cpu']} CPU s")
        return self.done[key]

    def runs(self) -> list[dict[str, Any]]:
        """All finished runs: what was run, and its result."""
        return [{**json.loads(key), **result} for key, result in self.done.items()]


def brief(result: Mapping[str, Any]) -> str:
    return "  ".join(f"{k} {v:.2f}" for k, v in result.items() if isinstance(v, float))


def note(text: str) -> None:
    """A line of what has been done, on stderr."""
    print(text, file=sys.stderr, flush=True)


# ---- command lines -----------------------------------------------------------------------------------------


def parser(description: str | None) -> argparse.ArgumentParser:
    """With the options all commands have."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=os.environ.get("PDAL_STAGES_DATA"), help="folder of the clouds"
    )
    parser.add_argument(
        "--cache", type=Path, help="folder for features and finished runs: makes a run resumable"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="results")
    parser.add_argument("--tables", type=Path, help="Markdown tables; printed where not given")
    return parser


def opened(
    args: argparse.Namespace, name: str, context: Mapping[str, Any]
) -> tuple[Cache, Results]:
    """The cache and results of a command."""
    cache = Cache(args.cache)
    return cache, Results(None if args.cache is None else args.cache / f"{name}.jsonl", context)


def finish(
    args: argparse.Namespace, runs: list[dict[str, Any]], title: str, text: str, **more: Any
) -> None:
    """Write results and tables where the user wants them; lists of one run stand on one line."""
    command = Path(sys.argv[0]).name
    note = f"Written by `benchmarks/papers/{command}`; figures in per cent, mean ± deviation over seeds."
    text = f"# {title}\n\n{note}\n\n{text}"
    if args.json:
        lines = ",\n".join(
            json.dumps({k: v for k, v in run.items() if k not in BULKY}) for run in runs
        )
        head = json.dumps({"machine": machine(), **more})
        args.json.write_text(f'{head[:-1]},\n"runs": [\n{lines}\n]}}\n')
    if args.tables:
        args.tables.write_text(text)
    else:
        print(text)


def machine() -> dict[str, Any]:
    import numba
    import sklearn

    return {
        "pdal_stages": pdal_stages.__version__,
        "code": code_fingerprint(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scikit-learn": sklearn.__version__,
        "numba": numba.__version__,
        "cores": len(os.sched_getaffinity(0)),
    }
