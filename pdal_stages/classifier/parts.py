"""A labeled cloud in square parts, kept in files: as large as the disk allows, with one part in memory at a time.

Each point belongs to one part. What is chosen of points that lie close together, one for each voxel, is chosen with the
parts beside at hand, so that it is what would be chosen of the whole cloud; and features are computed with as much of them
around as it takes (:mod:`.surroundings`). So a model trained on parts is, to the last bit, that of the whole.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError
from ..base.progress import Progress
from .clouds import TrainingCloud, cleaned, thinned_copy
from .surroundings import Seen
from .thinning import DensityOfParts
from .trainoptions import TrainingOptions

#: Which of the points beside each other are a part's own.
_OWN = "PdalStagesOwn"
#: How far over an edge points may lie, as a share of a part's side.
_ROUNDING = 1e-6

Tile = tuple[int, int]
Box = tuple[float, float, float, float]


class CloudParts:
    """The parts of one cloud, as they are written one after the other.

    Parameters
    ----------
    folder : Path
        Made for them alone.
    side : float
        Of the squares, meters: (i, j) begins at ``i * side, j * side``. Points on an edge may belong to either.
    most_points : float
        Part and surroundings are not seen where they are more.
    """

    def __init__(self, folder: Path, side: float, most_points: float = math.inf) -> None:
        self.folder, self.side, self.most_points = folder, side, most_points
        self.counts: dict[Tile, int] = {}  #: points of each part
        self.density = 0.0  #: points per square meter; see :func:`.thinning.density`
        self._named: dict[str, Any] = {}
        folder.mkdir()

    # ---- writing -------------------------------------------------------------------------------------------

    def put(self, tile: Tile, cloud: TrainingCloud) -> None:
        """Write a part; nothing where it is empty."""
        if not len(cloud):
            return
        self._named = {"name": cloud.name, "survey": cloud.survey, "copy": cloud.copy}
        self.counts[tile] = len(cloud)
        for what, values in {"xyz": cloud.xyz, "labels": cloud.labels, "mask": cloud.mask}.items():
            if values is not None:
                self._write(tile, what, values)
        for name in cloud.dimensions:
            self._write(tile, f"d.{name}", cloud.dimensions[name])

    def _write(self, tile: Tile, what: str, values: npt.ArrayLike) -> None:
        folder = self._place(tile)
        try:
            folder.mkdir(exist_ok=True)
            np.save(folder / f"{what}.npy", np.asarray(values), allow_pickle=False)
        except OSError as error:
            raise StageError(
                "the parts of the cloud cannot be kept",
                found=f"{folder}: {error.strerror or error}",
                cure="Write the model to a disk with more room: parts are kept beside it while training lasts",
            ) from error

    def remove(self) -> None:
        """Remove all files."""
        shutil.rmtree(self.folder, ignore_errors=True)

    # ---- reading -------------------------------------------------------------------------------------------

    def _place(self, tile: Tile) -> Path:
        return self.folder / f"{tile[0]}_{tile[1]}"

    def read(self, tile: Tile, what: str) -> npt.NDArray[Any]:
        """An array of a part."""
        return np.load(self._place(tile) / f"{what}.npy", allow_pickle=False)

    def names(self, tile: Tile) -> list[str]:
        """The dimensions of a part."""
        return sorted(path.stem[2:] for path in self._place(tile).glob("d.*.npy"))

    def has(self, tile: Tile, what: str) -> bool:
        """Whether a part has an array."""
        return (self._place(tile) / f"{what}.npy").exists()

    def parts(self) -> list[TrainingCloud]:
        """All parts, row by row."""
        return [
            CloudPart(self, tile, **self._named) for tile in sorted(self.counts, key=lambda t: (t[1], t[0]))
        ]

    def box(self, tile: Tile) -> Box:
        """Where a part lies."""
        i, j = tile
        return i * self.side, j * self.side, (i + 1) * self.side, (j + 1) * self.side

    def inner_box(self, tile: Tile) -> Box:
        """Where a part lies and no other has points: coordinates on an edge may be rounded to either side of it."""
        x0, y0, x1, y1 = self.box(tile)
        wide = _ROUNDING * self.side
        return x0 + wide, y0 + wide, x1 - wide, y1 - wide

    def touched(self, box: Box) -> list[Tile]:
        """The parts that may have points in a box."""
        x0, y0, x1, y1 = (math.floor(v / self.side) for v in box)
        if (x1 - x0 + 3) * (y1 - y0 + 3) > len(self.counts):
            return [t for t in self.counts if x0 - 1 <= t[0] <= x1 + 1 and y0 - 1 <= t[1] <= y1 + 1]
        near = ((i, j) for j in range(y0 - 1, y1 + 2) for i in range(x0 - 1, x1 + 2))
        return [tile for tile in near if tile in self.counts]

    def within(self, box: Box) -> float:
        """About how many points lie in a box."""
        found = 0.0
        for tile in self.touched(box):
            own = self.box(tile)
            sides = [min(own[k + 2], box[k + 2]) - max(own[k], box[k]) for k in (0, 1)]
            found += self.counts[tile] * max(sides[0], 0.0) * max(sides[1], 0.0) / self.side**2
        return found

    def open_sides(self, box: Box) -> Box:
        """The box, infinite where there are no parts beyond."""
        out = []
        tiles = np.array(list(self.counts))
        low, high = tiles.min(axis=0), tiles.max(axis=0) + 1
        for k in range(4):
            edge = (low if k < 2 else high)[k % 2] * self.side
            beyond = box[k] < edge if k < 2 else box[k] > edge
            out.append((-math.inf if k < 2 else math.inf) if beyond else box[k])
        return out[0], out[1], out[2], out[3]


class CloudPart(TrainingCloud):
    """A part of a cloud; its arrays are read when they are asked for, and not kept."""

    def __init__(self, parts: CloudParts, tile: Tile, name: str, survey: str | None, copy: str) -> None:
        # Not the arrays that the dataclass would hold.
        for key, value in {
            "parts": parts,
            "tile": tile,
            "name": name,
            "survey": survey,
            "copy": copy,
        }.items():
            object.__setattr__(self, key, value)

    parts: CloudParts
    tile: Tile

    def __len__(self) -> int:
        return self.parts.counts[self.tile]

    @property
    def xyz(self) -> npt.NDArray[np.float64]:  # type: ignore[override]
        """(n, 3) meters."""
        return self.parts.read(self.tile, "xyz")

    @property
    def labels(self) -> npt.NDArray[Any]:  # type: ignore[override]
        """(n,)"""
        return self.parts.read(self.tile, "labels")

    @property
    def mask(self) -> npt.NDArray[np.bool_] | None:  # type: ignore[override]
        """(n,) or None"""
        return self.parts.read(self.tile, "mask") if self.parts.has(self.tile, "mask") else None

    @property
    def dimensions(self) -> Mapping[str, npt.ArrayLike]:  # type: ignore[override]
        """Name to (n,) values."""
        return _Dimensions(self.parts, self.tile)

    @property
    def whole(self) -> object:
        """The same for all parts of a cloud."""
        return id(self.parts)

    @property
    def density(self) -> float:
        """Of the whole cloud."""
        return self.parts.density

    def seen(self, rows: npt.NDArray[np.int64], reach: float) -> Seen:
        """Points of the part and those beside it, as far around `rows` as is asked."""
        xyz = self.xyz
        box = _around(xyz[rows], reach)
        columns: list[npt.NDArray[np.float64]] = []
        dimensions: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in self.dimensions}
        at = np.zeros(0, np.int64)
        for tile in [self.tile, *(other for other in self.parts.touched(box) if other != self.tile)]:
            points = xyz if tile == self.tile else self.parts.read(tile, "xyz")
            inside = np.flatnonzero(((points[:, :2] >= box[:2]) & (points[:, :2] <= box[2:])).all(axis=1))
            if tile == self.tile:
                at = np.searchsorted(inside, rows)
            if not len(inside):
                continue
            columns.append(points[inside])
            for name, found in dimensions.items():
                found.append(self.parts.read(tile, f"d.{name}")[inside])
        del xyz
        together = {name: np.concatenate(found) for name, found in dimensions.items()}
        return Seen(np.concatenate(columns), together, at, self.parts.open_sides(box))

    def can_be_seen(self, rows: npt.NDArray[np.int64], reach: float) -> bool:
        """Whether these are not too many points."""
        return self.parts.within(_around(self.xyz[rows], reach)) <= self.parts.most_points

    def holds_numbers(self, count: int) -> bool:
        """Whether these are not too many: a point that is seen takes ten times as much."""
        return count <= 10 * self.parts.most_points


class _Dimensions(Mapping[str, npt.ArrayLike]):
    """Dimensions of a part, read when they are asked for."""

    def __init__(self, parts: CloudParts, tile: Tile) -> None:
        self._parts, self._tile = parts, tile

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if name not in self:
            raise KeyError(name)
        return self._parts.read(self._tile, f"d.{name}")

    def __contains__(self, name: object) -> bool:
        return self._parts.has(self._tile, f"d.{name}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts.names(self._tile))

    def __len__(self) -> int:
        return len(self._parts.names(self._tile))


def _around(xyz: npt.NDArray[np.float64], reach: float) -> Box:
    """The box around points, so many meters wider on each side."""
    (x0, y0), (x1, y1) = xyz[:, :2].min(axis=0) - reach, xyz[:, :2].max(axis=0) + reach
    return float(x0), float(y0), float(x1), float(y1)


# ---- from points as they come to points to train on ---------------------------------------------------------


def prepared_parts(
    raw: CloudParts, options: TrainingOptions, folder: Path, progress: bool | None = None
) -> list[TrainingCloud]:
    """A cloud in parts and its thinned copies, without ignored points and with one point per voxel; `raw` is removed.

    Files are written into `folder`, which is there.
    """
    name = f"{len(list(folder.iterdir()))}.{raw.folder.name}"  # of surveys there are folders of one name
    made = CloudParts(folder / f"{name}.points", raw.side, raw.most_points)
    density = DensityOfParts()
    with Progress(sum(raw.counts.values()), "voxels", enabled=progress) as bar:
        for part in raw.parts():
            assert isinstance(part, CloudPart)
            own = _own_of(cleaned(_with_edges(part, 4.0 * options.voxel), options))
            made.put(part.tile, own)
            density.add(own.xyz, made.inner_box(part.tile))
            bar.update(len(part))
    raw.remove()
    made.density = density.density()
    copies = [made]
    for number, wanted in enumerate(options.thin):
        copy = _thinned(made, wanted, options, folder / f"{name}.thin{number}")
        copies += [copy] if copy.counts else []
    return [part for one in copies for part in one.parts()]


def _thinned(made: CloudParts, wanted: float, options: TrainingOptions, folder: Path) -> CloudParts:
    copy = CloudParts(folder, made.side, made.most_points)
    density = DensityOfParts()
    for part in made.parts():
        assert isinstance(part, CloudPart)
        thin = thinned_copy(_loaded(part, part.xyz, part.dimensions), wanted, options.seed, made.density)
        if thin is not None:
            copy.put(part.tile, thin)
            density.add(thin.xyz, copy.inner_box(part.tile))
    copy.density = density.density()
    return copy


def _with_edges(part: CloudPart, meters: float) -> TrainingCloud:
    """A part as it is, with what lies close beside it; its own points are told by a dimension."""
    pieces = [_loaded(part, part.xyz, part.dimensions)]
    own = [np.ones(len(part), bool)]
    x0, y0, x1, y1 = part.parts.box(part.tile)
    wide = meters + _ROUNDING * part.parts.side
    box = (x0 - wide, y0 - wide, x1 + wide, y1 + wide)
    for tile in part.parts.touched(box) if meters else ():
        if tile == part.tile:
            continue
        beside = CloudPart(part.parts, tile, part.name, part.survey, part.copy)
        xyz = beside.xyz
        near = np.flatnonzero(((xyz[:, :2] >= box[:2]) & (xyz[:, :2] <= box[2:])).all(axis=1))
        if len(near):
            pieces.append(_loaded(beside, xyz, beside.dimensions).part(near))
            own.append(np.zeros(len(near), bool))
    return _joined(pieces, np.concatenate(own))


def _loaded(
    part: CloudPart, xyz: npt.NDArray[np.float64], dimensions: Mapping[str, npt.ArrayLike]
) -> TrainingCloud:
    return TrainingCloud(xyz, part.labels, dict(dimensions), part.name, part.mask, part.survey, part.copy)


def _joined(pieces: Sequence[TrainingCloud], own: npt.NDArray[np.bool_]) -> TrainingCloud:
    first = pieces[0]
    dimensions = {name: np.concatenate([one.dimensions[name] for one in pieces]) for name in first.dimensions}
    mask = None if first.mask is None else np.concatenate([np.asarray(one.mask) for one in pieces])
    return TrainingCloud(
        np.concatenate([one.xyz for one in pieces]),
        np.concatenate([np.asarray(one.labels) for one in pieces]),
        {**dimensions, _OWN: own},
        first.name,
        mask,
        first.survey,
        first.copy,
    )


def _own_of(cloud: TrainingCloud) -> TrainingCloud:
    """The points of a cloud that are the part's own."""
    own = cloud.part(np.flatnonzero(np.asarray(cloud.dimensions[_OWN])))
    dimensions = {name: values for name, values in own.dimensions.items() if name != _OWN}
    return TrainingCloud(own.xyz, own.labels, dimensions, own.name, own.mask, cloud.survey, own.copy)
