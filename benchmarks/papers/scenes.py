"""Feature tables of the airborne scenes, computed once for all experiments of [B16] and [W18]."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clouds import Cloud, read_cloud, with_height
from kit import Cache, features, fingerprint, fitted_bins, note
from pts_input import COLUMNS, read_pts

from pdal_stages.base.asprs import class_name
from pdal_stages.classifier.training_options import RECIPES
from pdal_stages.features import FeaturePlan

#: Scene -> classes trained and scored; points of other classes are neighbors only.
SCENES = {"montpellier": (2, 3, 4, 5, 6), "delft": (1, 2, 6)}
#: Scene -> names of labels that are not codes of ASPRS.
NAMES = {
    "vaihingen": {
        int(label): str(name).partition(" ")[2]
        for label, name in RECIPES["vaihingen"]["classes"].items()
    }
}
NEIGHBORHOODS = "weinmann2018"  # [B16]'s are among them


@dataclass(frozen=True, eq=False)
class Scene:
    """Train and test part: clouds, and features (n, F) of all their points."""

    name: str
    classes: tuple[int, ...]
    plan: FeaturePlan
    train: Cloud
    test: Cloud
    train_values: np.ndarray
    test_values: np.ndarray

    def columns(self, names: list[str]) -> np.ndarray:
        """Return the columns of features in the tables."""
        at = {name: number for number, name in enumerate(self.plan.names)}
        return np.array([at[name] for name in names])


class Columns:
    """Some columns of a table, row by row: the whole is never copied."""

    def __init__(self, table: np.ndarray, columns: np.ndarray) -> None:
        self.table, self.columns = table, columns
        self.shape = len(table), len(columns)

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.table[rows][:, self.columns]


def name_of(scene: str, label: int | str) -> str:
    """Return the name of a label of a scene."""
    return NAMES.get(scene.partition(",")[0], {}).get(int(label)) or class_name(int(label))


def read_scene(data: Path, scene: str, part: str, columns: str | None = None) -> Cloud:
    """A part (train, test) of one of the airborne scenes: a folder of LAZ, or ``.pts`` text (see
    pts_input)."""
    folder = data / scene
    text = sorted(folder.glob(f"{part}*.pts"))
    if text:
        return read_pts(text, f"{scene} {part}", columns or COLUMNS)
    return read_cloud(sorted(folder.glob(f"{part}*.la[sz]")), f"{scene} {part}")


def load(
    data: Path,
    name: str,
    cache: Cache,
    *,
    classes: tuple[int, ...] | None = None,
    columns: str | None = None,
    neighborhoods: str | None = None,
    threads: int | None = None,
) -> Scene:
    """Read a scene, compute its features where the cache has none.

    Shape thresholds come from the training cloud and serve both parts [B16 3.2.2]. Every point of a
    cloud is a neighbor; only points of the classes are queries.
    """
    parts = {part: with_height(read_scene(data, name, part, columns)) for part in ("train", "test")}
    if classes is None:
        classes = SCENES.get(name) or tuple(np.unique(parts["train"].labels).tolist())
    plan = FeaturePlan.parse(neighborhoods or NEIGHBORHOODS, "all", ("HeightAboveGround", "Z"))
    bins = fitted_bins(parts["train"], plan, cache, 0, threads)
    clouds, tables = [], []
    for part in parts.values():
        queries = np.flatnonzero(np.isin(part.labels, classes))
        note(f"{part.name}: {len(queries):,} of {len(part):,} points are of the classes {classes}")
        tables.append(features(part, plan, cache, bins=bins, queries=queries, threads=threads))
        clouds.append(part.only(queries))
    return Scene(name, classes, plan, *clouds, *tables)


def chequerboard(scene: Scene, size: float = 25.0) -> Scene:
    """The training part alone, cut into fields: white ones train, black ones are scored.

    Training and scored points then come from the same buildings and trees, as they do where a
    survey is classified from samples all over it; the scene's own test part is another place.
    """
    fields = np.floor(scene.train.xyz[:, :2] / size).astype(np.int64).sum(axis=1)
    white = fields % 2 == 0
    values = [np.ascontiguousarray(scene.train_values[mask]) for mask in (white, ~white)]
    clouds = [scene.train.only(mask) for mask in (white, ~white)]
    return Scene(f"{scene.name}, chequerboard", scene.classes, scene.plan, *clouds, *values)


def context(scene: Scene) -> dict:
    """Return what all runs on a scene depend on."""
    return {
        "scene": scene.name,
        "data": fingerprint(scene.train.xyz, scene.test.xyz),
        "classes": list(scene.classes),
    }


def add_options(options: argparse.ArgumentParser) -> None:
    options.add_argument(
        "--scene", nargs="+", default=list(SCENES), help="folders of DIR, with train* and test*"
    )
    options.add_argument(
        "--classes", type=int, nargs="+", help="labels to train and score; default: the scene's"
    )
    options.add_argument(
        "--chequerboard",
        action="store_true",
        help="score every other 25 m field of the training part, not the test part",
    )
    options.add_argument("--columns", help="of .pts text; see pts_input.py")
