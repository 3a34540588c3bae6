"""Labeled clouds to train on: prepared, kept on disk where they need not fit in memory, and the classes they have."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.asprs import UNINFORMATIVE
from ..base.errors import OptionError, StageError
from ..base.progress import Progress
from ..features.voxels import Representatives, represent
from .classes import MAX_LABEL, ClassMap, as_labels
from .dimensions import known
from .thinning import density, density_range, thinned
from .trainoptions import TrainingOptions


@dataclass(frozen=True, eq=False)
class TrainingCloud:
    """A labeled cloud.

    Attributes
    ----------
    xyz : (n, 3) float64
        Coordinates in meters.
    labels : (n,) int
    dimensions : mapping
        Name to (n,) values, as the options' `dimensions` need.
    name : str
        For messages and the model file; a path is cut to its last part.
    mask : (n,) bool, optional
        Points samples may be drawn from; all points serve as neighbors.
    survey : str, optional
        The flight it belongs to; by default it is one of its own.
    copy : str
        Which of the survey's copies it is, where there are several.
    own : (n,) bool, optional
        Of a tile its own points; the others are only neighbors.
    """

    xyz: npt.NDArray[np.float64]
    labels: npt.ArrayLike
    dimensions: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    name: str = "cloud"
    mask: npt.ArrayLike | None = None
    survey: str | None = None
    copy: str = ""
    own: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", np.asarray(self.xyz, dtype=np.float64))

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def flight(self) -> str:
        """The survey, or the cloud's own name."""
        return self.survey or self.name

    @property
    def points(self) -> int:
        """How many points are its own."""
        return len(self) if self.own is None else int(np.count_nonzero(self.own))

    @property
    def usable(self) -> npt.NDArray[np.bool_]:
        """(n,) points that samples may be drawn from."""
        good = np.ones(len(self), np.bool_) if self.mask is None else np.array(self.mask)
        return good if self.own is None else good & np.asarray(self.own)

    def part(self, rows: npt.NDArray[np.int64], copy: str = "") -> TrainingCloud:
        """Some of its points, as a cloud of the same survey."""
        return TrainingCloud(
            self.xyz[rows],
            np.asarray(self.labels)[rows],
            {name: np.asarray(values)[rows] for name, values in self.dimensions.items()},
            f"{self.name} {copy}".strip(),
            None if self.mask is None else np.asarray(self.mask)[rows],
            self.flight,
            copy or self.copy,
            None if self.own is None else np.asarray(self.own)[rows],
        )


#: A training cloud, or a function that makes it when it is its turn.
CloudSource = TrainingCloud | Callable[[], TrainingCloud]


def prepared(sources: Iterable[CloudSource], options: TrainingOptions) -> Iterator[TrainingCloud]:
    """The clouds without ignored points and with one point per voxel, each followed by its thinned copies."""
    for source in sources:
        cloud = cleaned(source() if callable(source) else source, options)
        yield cloud
        for wanted in options.thin:
            copy = thinned_copy(cloud, wanted, options.seed)
            if copy is not None:
                yield copy


def cleaned(cloud: TrainingCloud, options: TrainingOptions) -> TrainingCloud:
    """A cloud without ignored points and with one point per voxel."""
    named: set[int] = set()
    if options.classes is not None:
        named.update(label for part in ClassMap.parse(options.classes).labels for label in part)
    labels = _checked_labels(cloud)
    ignored = [label for label in options.ignore if label not in named]
    if ignored and (gone := np.isin(labels, ignored)).any():
        cloud = cloud.part(np.flatnonzero(~gone))
    values = known(options.inputs, cloud.dimensions, len(cloud.xyz), where=cloud.name)
    representatives = represent(cloud.xyz, options.voxel, values)
    if representatives is None:
        return cloud
    few = options.base is not None  # then each label counts, whichever point stands for its voxel
    return _told(cloud, representatives, named) if few else cloud.part(representatives.rows)


def thinned_copy(cloud: TrainingCloud, wanted: float, seed: int) -> TrainingCloud | None:
    """A copy with `wanted` points per square meter; None where there are hardly more."""
    rows = thinned(cloud.xyz, wanted, seed)
    if rows is None or not len(rows):
        return None
    return cloud.part(rows, f"thinned to {wanted:g} per m2")


def joined(parts: Sequence[TrainingCloud]) -> TrainingCloud:
    """Clouds of the same dimensions as one, named as the first."""
    first = parts[0]
    return replace(
        first,
        xyz=np.concatenate([one.xyz for one in parts]),
        labels=np.concatenate([np.asarray(one.labels) for one in parts]),
        dimensions={
            name: np.concatenate([np.asarray(one.dimensions[name]) for one in parts])
            for name in first.dimensions
        },
        mask=None if first.mask is None else np.concatenate([np.asarray(one.mask) for one in parts]),
    )


def _told(cloud: TrainingCloud, representatives: Representatives, named: set[int]) -> TrainingCloud:
    """The representatives, each with its own label or else the least of its voxel that may be trained on."""
    labels = as_labels(cloud.labels, cloud.name)
    usable = np.isin(labels, list(named)) if named else ~np.isin(labels, UNINFORMATIVE)
    if cloud.mask is not None:
        usable &= np.asarray(cloud.mask)
    rows = representatives.rows
    points, place = representatives.members(slice(None))
    good = usable[points]
    least = np.full(len(rows), MAX_LABEL + 1, np.int64)
    np.minimum.at(least, place[good], labels[points[good]])
    lent = ~usable[rows] & (least <= MAX_LABEL)
    part = cloud.part(rows)
    told = np.where(lent, least, labels[rows])
    return replace(part, labels=told, mask=None if cloud.mask is None else usable[rows] | lent)


def spooled(clouds: Iterable[TrainingCloud], folder: Path) -> list[TrainingCloud]:
    """The clouds with their arrays in files of `folder`, mapped when looked at: one cloud at a time is in memory."""
    return [_mapped(one, folder, number) for number, one in enumerate(clouds)]


def _mapped(cloud: TrainingCloud, folder: Path, number: int) -> TrainingCloud:
    def kept(name: str, array: npt.ArrayLike | None) -> Any:
        if array is None:
            return None
        path = folder / f"{number}.{name}.npy"
        try:
            np.save(path, np.asarray(array), allow_pickle=False)
            return np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise StageError(
                "training clouds cannot be kept in a temporary folder",
                found=f"{folder}: {error.strerror or error}",
                cure="Set TMPDIR to a folder with more room",
            ) from error

    return TrainingCloud(
        kept("xyz", cloud.xyz),
        kept("labels", cloud.labels),
        {name: kept(f"d{place}", cloud.dimensions[name]) for place, name in enumerate(cloud.dimensions)},
        cloud.name,
        kept("mask", cloud.mask),
        cloud.survey,
        cloud.copy,
        kept("own", cloud.own),
    )


@dataclass(frozen=True, eq=False)
class Labeled:
    """For each cloud its coordinates and the place of each point's class, -1 where it is not used."""

    clouds: Sequence[TrainingCloud]
    classes: ClassMap
    contradicted_below: float = 0.0  #: meters; see ``TrainingOptions``
    left_out: Mapping[str, int] = field(default_factory=dict)  #: points of each label that are so left out

    def __len__(self) -> int:
        return len(self.clouds)

    def __getitem__(self, number: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]:
        cloud = self.clouds[number]
        position = self.classes.index(as_labels(cloud.labels, cloud.name))
        position[~cloud.usable] = -1
        gone = contradicted(cloud, self.contradicted_below)
        if gone is not None:
            position[gone] = -1
        return cloud.xyz, position

    def __iter__(self) -> Iterator[tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]]:
        return (self[number] for number in range(len(self)))

    def described(self, options: TrainingOptions, counts: Iterable[Mapping[str, int]]) -> dict[str, Any]:
        """What a manifest says of the task and of each class, whose samples `counts` tells."""
        classes = zip(self.classes.codes, self.classes.names, self.classes.labels, counts, strict=True)
        return {
            "strategy": options.strategy,
            "target": options.target,
            "background": options.background if options.strategy == "binary" else None,
            "classes": [
                {"code": code, "name": name, "labels": list(labels), **counted}
                for code, name, labels, counted in classes
            ],
        }


#: Labels of what stands above the ground: vegetation from medium height on, buildings.
STANDING = (4, 5, 6)


def contradicted(cloud: TrainingCloud, below: float) -> npt.NDArray[np.bool_] | None:
    """(n,) points whose label their height contradicts: of :data:`STANDING`, but Ground and lower than `below` meters.

    None where nothing can be said.
    """
    if below == 0 or not {"Ground", "HeightAboveGround"} <= set(cloud.dimensions):
        return None
    low = np.asarray(cloud.dimensions["HeightAboveGround"]) < below
    ground = np.asarray(cloud.dimensions["Ground"]) > 0
    return np.isin(as_labels(cloud.labels, cloud.name), STANDING) & ground & low


def label_classes(
    clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool = False
) -> Labeled:
    """The classes that the clouds' labels make."""
    number, left_out = np.zeros((2, MAX_LABEL + 1), np.int64)
    for cloud in watched(clouds, "counting labels", progress):
        labels = as_labels(cloud.labels, cloud.name)
        used = cloud.usable
        gone = contradicted(cloud, options.contradicted_below)
        if gone is not None:
            left_out += np.bincount(labels[used & gone], minlength=len(number))
            used = used & ~gone
        number += np.bincount(labels[used], minlength=len(number))
    found = {int(label): int(number[label]) for label in np.flatnonzero(number)}
    listing = ", ".join(f"{label}: {n:,}" for label, n in sorted(found.items())[:20]) or "no points"
    classes = ClassMap.parse(options.classes, found)
    if options.strategy == "binary" and options.target is not None:
        classes = classes.binary(options.target, options.background)
    for code, name, members in zip(classes.codes, classes.names, classes.labels, strict=True):
        if not any(found.get(label) for label in members):
            raise OptionError(
                f"class {code} ({name}) has no samples",
                found=f"none of label {' or '.join(map(str, members))}; labels {listing}",
                cure="Leave the class out of 'classes', or give clouds that have it",
            )
    if len(classes.codes) < 2:
        raise OptionError(
            "a classifier needs at least two classes",
            found=f"labels {listing}",
            cure=f"Labels {', '.join(map(str, UNINFORMATIVE))} are left out unless 'classes' names them",
        )
    counted = {str(label): int(left_out[label]) for label in np.flatnonzero(left_out)}
    return Labeled(clouds, classes, options.contradicted_below, counted)


def watched(clouds: Sequence[TrainingCloud], what: str, progress: bool) -> Iterator[TrainingCloud]:
    """The clouds, with progress on stderr that counts their points."""
    with Progress(sum(map(len, clouds)), what, enabled=progress) as bar:
        for cloud in clouds:
            yield cloud
            bar.update(len(cloud))


def listed(clouds: Iterable[TrainingCloud]) -> list[dict[str, Any]]:
    """Names and numbers of points of clouds, the tiles of one as one, for a manifest."""
    rows: list[dict[str, Any]] = []
    for cloud in clouds:
        name, points = os.path.basename(cloud.name), cloud.points
        before = next((row for row in rows if cloud.own is not None and row["name"] == name), None)
        if before is None:
            rows.append({"name": name, "points": points})
        else:
            before["points"] += points
    return rows


def densities(clouds: Iterable[TrainingCloud]) -> dict[str, float]:
    """Smallest and largest density of some clouds, as a manifest has it; of tiles the median by their points."""
    found: dict[object, list[tuple[float, int]]] = {}
    for number, cloud in enumerate(clouds):
        key = number if cloud.own is None else (cloud.name, cloud.flight, cloud.copy)
        found.setdefault(key, []).append((density(cloud.xyz), cloud.points))
    medians = []
    for tiles in found.values():
        value, points = (np.array(column) for column in zip(*sorted(tiles), strict=True))
        medians.append(float(value[np.searchsorted(np.cumsum(points), points.sum() / 2)]))
    return density_range(medians)


def _checked_labels(cloud: TrainingCloud) -> npt.NDArray[Any]:
    labels = as_labels(cloud.labels, cloud.name)
    if len(labels) != len(cloud.xyz):
        raise OptionError(
            "labels and points differ in number",
            where=cloud.name,
            found=f"{len(labels)} and {len(cloud.xyz)}",
        )
    if cloud.mask is not None:
        mask = np.asarray(cloud.mask)
        if mask.shape != labels.shape or mask.dtype != np.bool_:
            raise OptionError("the mask must be one true or false per point", where=cloud.name)
    return labels
