"""Labeled clouds for training: cleaned, thinned, kept on disk; and their classes."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.labels import as_codes
from ..base.asprs import UNINFORMATIVE
from ..base.errors import OptionError, StageError
from ..base.hashing import hash_rows
from ..base.json_types import JsonObject
from ..base.progress import Progress
from ..base.version import __version__
from ..features.cell_means import density
from ..features.point_grid import check_xyz
from ..features.voxels import represent
from .class_map import BACKGROUND, MAX_LABEL, ClassMap
from .input_dimensions import list_values
from .model_info import ModelInfo, Priors, SampleCounts
from .training_options import TrainingOptions

#: A thinned copy is made where it would have less than this share of the points: one of nearly all
#: teaches nothing new (not tuned).
WORTH = 0.75


@dataclass(frozen=True, eq=False)
class TrainingCloud:
    """A labeled cloud."""

    xyz: npt.NDArray[np.float64]  #: (n, 3) coordinates in meters
    labels: npt.ArrayLike  #: (n,) whole numbers
    #: name to (n,) values, as the options' `dimensions` need
    dimensions: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    name: str = "cloud"  #: for messages and the model file; a path is cut to its last part
    #: (n,) bool, points samples may be drawn from; all points serve as neighbors
    mask: npt.ArrayLike | None = None
    survey: str = ""  #: the survey it belongs to; by default one of its own, called as it is
    copy: str = ""  #: which of the survey's copies it is, where there are several

    def __post_init__(self) -> None:
        """Make the coordinates float64, name the survey, and count the labels."""
        object.__setattr__(self, "xyz", np.asarray(self.xyz, dtype=np.float64))
        object.__setattr__(self, "survey", self.survey or self.name)
        if np.shape(self.labels) != (len(self.xyz),):
            numbers = f"shape {np.shape(self.labels)} of {len(self.xyz):,} points"
            raise OptionError("there must be one label per point", where=self.name, found=numbers)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.xyz)

    @property
    def codes(self) -> npt.NDArray[np.uint16]:
        """Return the labels (n,) as codes; StageError where they are not whole numbers."""
        return as_codes(self.labels, f"label of {self.name}")

    @property
    def arrays(self) -> dict[str, npt.NDArray]:
        """Return all values of the points by name; dimensions as ``d/Intensity``."""
        values = {"xyz": self.xyz, "labels": self.labels, "mask": self.mask}
        values |= {f"d/{name}": array for name, array in self.dimensions.items()}
        return {name: np.asarray(array) for name, array in values.items() if array is not None}

    def with_arrays(self, arrays: Mapping[str, npt.NDArray], **more: Any) -> TrainingCloud:
        """Return a cloud of other points, with values as of :attr:`arrays`; the rest stays."""
        dimensions = {name[2:]: values for name, values in arrays.items() if name.startswith("d/")}
        known: dict[str, Any] = {name: arrays.get(name) for name in ("xyz", "labels", "mask")}
        return replace(self, dimensions=dimensions, **known, **more)

    def part(self, rows: npt.NDArray[np.int64], copy: str = "") -> TrainingCloud:
        """Return some of the points as a cloud of the same survey."""
        arrays = {name: values[rows] for name, values in self.arrays.items()}
        name, copy = f"{self.name} {copy}".strip(), copy or self.copy
        return self.with_arrays(arrays, name=name, copy=copy)


def prepared(sources: Iterable[TrainingCloud], options: TrainingOptions) -> Iterator[TrainingCloud]:
    """Yield the clouds without ignored points, one point per voxel, and their thinned copies."""
    for source in sources:
        cloud = _cleaned(source, options)
        yield cloud
        there = density(cloud.xyz)
        for wanted in options.thin:
            if wanted < WORTH * there:
                # A point stays or goes by a hash of its coordinates: the same ones in any order.
                limit = np.uint64(wanted / there * (2.0**64 - 2048.0))
                rows = np.flatnonzero(hash_rows(cloud.xyz.T, options.seed) <= limit)
                if len(rows):
                    yield cloud.part(rows, f"thinned to {wanted:g} per m2")


def _cleaned(cloud: TrainingCloud, options: TrainingOptions) -> TrainingCloud:
    """Return a cloud without ignored points and with one point per voxel."""
    check_xyz(cloud.xyz, cloud.name)
    named: set[int] = set()
    if options.classes is not None:
        named.update(label for part in ClassMap.parse(options.classes).labels for label in part)
    labels = cloud.codes
    mask = None if cloud.mask is None else np.asarray(cloud.mask)
    if mask is not None and (mask.shape != labels.shape or mask.dtype != np.bool_):
        raise OptionError("the mask must be one true or false per point", where=cloud.name)
    ignored = [label for label in options.ignore if label not in named]
    if ignored and (gone := np.isin(labels, ignored)).any():
        cloud, labels = cloud.part(np.flatnonzero(~gone)), labels[~gone]
    values = list_values(options.inputs, cloud.dimensions, len(cloud.xyz), where=cloud.name)
    representatives = represent(cloud.xyz, options.voxel, values)
    if representatives is None:
        return cloud
    rows = representatives.rows
    part = cloud.part(rows)
    if options.base is None:
        return part
    # Labels are few, and each counts: a representative without one gets the smallest usable one
    # of its voxel.
    usable = np.isin(labels, list(named)) if named else ~np.isin(labels, _left_out(options))
    if cloud.mask is not None:
        usable &= np.asarray(cloud.mask)
    points, place = representatives.members.take(slice(None))
    good = usable[points]
    least = np.full(len(rows), MAX_LABEL + 1, np.int64)
    np.minimum.at(least, place[good], labels[points[good]])
    lent = ~usable[rows] & (least <= MAX_LABEL)
    labels = np.where(lent, least, labels[rows])
    return replace(part, labels=labels, mask=None if cloud.mask is None else usable[rows] | lent)


def _left_out(options: TrainingOptions) -> list[int]:
    """Return those of the labels 0, 1, 7, 12, 18 for which the base has no class."""
    known = () if options.base is None else options.base.codes
    return [label for label in UNINFORMATIVE if label not in known]


def spooled(clouds: Iterable[TrainingCloud], folder: Path) -> list[TrainingCloud]:
    """Return the clouds with their arrays in files of `folder`, one after the other."""
    return [_mapped(cloud, folder, number) for number, cloud in enumerate(clouds)]


def _mapped(cloud: TrainingCloud, folder: Path, number: int) -> TrainingCloud:
    kept = {}
    for place, (name, array) in enumerate(cloud.arrays.items()):
        path = folder / f"{number}.{place}.npy"
        try:
            np.save(path, array, allow_pickle=False)
            kept[name] = np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise StageError(
                "training clouds cannot be kept on disk while training lasts",
                found=f"{folder}: {error.strerror or error}",
                cure="Make room there, set TMPDIR to another disk, or write the model to one",
            ) from error
    return cloud.with_arrays(kept)


@dataclass(frozen=True, eq=False)
class Labeled:
    """Clouds with their classes: of each the coordinates and class positions, -1 where not used."""

    clouds: Sequence[TrainingCloud]
    classes: ClassMap

    def __len__(self) -> int:
        """Return the number of clouds."""
        return len(self.clouds)

    def __getitem__(self, number: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]:
        """Return coordinates (n, 3) and class positions (n,) of a cloud."""
        cloud = self.clouds[number]
        position = self.classes.index(cloud.codes)
        if cloud.mask is not None:
            position[~np.asarray(cloud.mask)] = -1
        return cloud.xyz, position

    def __iter__(self) -> Iterator[tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]]:
        """Iterate over the clouds."""
        return (self[number] for number in range(len(self)))

    def describe(
        self,
        options: TrainingOptions,
        counts: Iterable[SampleCounts],
        training: JsonObject,
        importances: Iterable[Sequence[float] | None],
        packages: Iterable[str],
        crossed: JsonObject | None = None,
        priors: Priors | None = None,
    ) -> ModelInfo:
        """Return the manifest of a model trained on the clouds.

        `counts` are those of each class's samples, `importances` those of each pass, `crossed` is
        the score of the cross-validation, `packages` are those whose versions are stored.
        """
        # Empty clouds do not count.
        positive = [each for each in (density(cloud.xyz) for cloud in self.clouds) if each]
        classes = zip(
            self.classes.codes, self.classes.names, self.classes.labels, counts, strict=True
        )
        return {
            "strategy": "multiclass" if options.target is None else "binary",
            "target": options.target,
            "background": None if options.target is None else BACKGROUND,
            "classes": [
                {"code": code, "name": name, "labels": list(labels), **counted}
                for code, name, labels, counted in classes
            ],
            "training": {
                "clouds": [
                    {"name": os.path.basename(cloud.name), "points": len(cloud)}
                    for cloud in self.clouds
                ],
                **training,
            },
            "priors": priors,
            **({"lines": sorted(options.lines)} if options.lines else {}),
            "densities": {"low": min(positive, default=0.0), "high": max(positive, default=0.0)},
            "voxel": options.voxel,
            "accuracy": {"cross_validation": crossed},
            "passes": [
                {"importances": None if each is None else list(each)} for each in importances
            ],
            "created_by": {
                "pdal_stages": __version__,
                "python": platform.python_version(),
                **{name: metadata.version(name) for name in packages},
            },
        }


def label_classes(
    clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool = False
) -> Labeled:
    """Return the clouds with the classes that their labels make."""
    number = np.zeros(MAX_LABEL + 1, np.int64)
    with Progress(sum(map(len, clouds)), "counting labels", enabled=progress) as bar:
        for cloud in clouds:
            codes = cloud.codes if cloud.mask is None else cloud.codes[np.asarray(cloud.mask)]
            number += np.bincount(codes, minlength=len(number))
            bar.update(len(cloud))
    counts = {int(label): int(number[label]) for label in np.flatnonzero(number)}
    listing = ", ".join(f"{label}: {n:,}" for label, n in sorted(counts.items())[:20])
    listing = listing or "no points"
    classes = ClassMap.parse(options.classes, counts, _left_out(options))
    if options.target is not None:
        classes = classes.binary(options.target)
    for code, name, members in zip(classes.codes, classes.names, classes.labels, strict=True):
        if not any(counts.get(label) for label in members):
            raise OptionError(
                f"class {code} ({name}) has no samples",
                found=f"none of label {' or '.join(map(str, members))}; labels {listing}",
                cure="Leave the class out of 'classes', or give clouds that have it",
            )
    if len(classes.codes) < 2:
        raise OptionError(
            "a classifier needs at least two classes",
            found=f"labels {listing}",
            cure=f"Labels {', '.join(map(str, _left_out(options)))} are left out unless 'classes' "
            "names them",
        )
    return Labeled(clouds, classes)
