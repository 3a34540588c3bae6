"""A labeled cloud in square tiles on disk: each is trained on with the points around it at hand."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError
from .clouds import TrainingCloud, joined

#: Column and row of a tile, from the origin of the coordinates.
Tile = tuple[int, int]


class TiledCloud:
    """The tiles of one cloud, written one after the other.

    Parameters
    ----------
    folder : Path
        Made for them alone.
    side : float
        Of the squares, meters: (i, j) begins at ``i * side, j * side``. Points on an edge may belong to either.
    """

    def __init__(self, folder: Path, side: float) -> None:
        self.folder, self.side = folder, side
        self.tiles: dict[Tile, TrainingCloud] = {}  #: without arrays
        folder.mkdir()

    def put(self, tile: Tile, cloud: TrainingCloud) -> None:
        """Write a tile; nothing where it is empty."""
        if not len(cloud):
            return
        self.tiles[tile] = replace(cloud, xyz=np.zeros((0, 3)), labels=(), dimensions={}, mask=None)
        arrays = {"xyz": cloud.xyz, "labels": cloud.labels, "mask": cloud.mask}
        arrays |= {f"d.{name}": values for name, values in cloud.dimensions.items()}
        try:
            kept: dict[str, Any] = {k: np.asarray(v) for k, v in arrays.items() if v is not None}
            np.savez(self._file(tile), **kept)
        except OSError as error:
            raise StageError(
                "the tiles of the cloud cannot be kept",
                found=f"{self.folder}: {error.strerror or error}",
                cure="Write the model to a disk with more room: tiles are kept beside it while training lasts",
            ) from error

    def clouds(self, halo: float) -> Iterator[TrainingCloud]:
        """Each tile with the points up to `halo` meters around it, row by row; the files are gone in the end."""
        for tile in sorted(self.tiles, key=lambda t: (t[1], t[0])):
            yield self._with_halo(tile, halo)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _with_halo(self, tile: Tile, halo: float) -> TrainingCloud:
        i, j = tile
        low = np.array(tile) * self.side - halo
        high = np.array(tile) * self.side + self.side + halo
        steps = math.ceil(halo * (1 + 1e-6) / self.side)
        parts, own = [], []
        for b in range(j - steps, j + steps + 1):
            for a in range(i - steps, i + steps + 1):
                if (a, b) not in self.tiles:
                    continue
                part = self._read((a, b))
                if (a, b) != tile:
                    near = (part.xyz[:, :2] >= low) & (part.xyz[:, :2] <= high)
                    part = part.part(np.flatnonzero(near.all(axis=1)))
                parts.append(part)
                own.append(np.full(len(part), (a, b) == tile))
        return replace(joined(parts), own=np.concatenate(own))

    def _read(self, tile: Tile) -> TrainingCloud:
        with np.load(self._file(tile), allow_pickle=False) as arrays:
            found: dict[str, npt.NDArray] = dict(arrays)
        dimensions = {name[2:]: found[name] for name in sorted(found) if name.startswith("d.")}
        return replace(
            self.tiles[tile],
            xyz=found["xyz"],
            labels=found["labels"],
            dimensions=dimensions,
            mask=found.get("mask"),
        )

    def _file(self, tile: Tile) -> Path:
        return self.folder / f"{tile[0]}_{tile[1]}.npz"
