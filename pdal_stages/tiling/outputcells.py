"""Cells of the points of outputs, taken while these are written, so that finding objects need not read them again."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import las
from ..base.errors import StageError
from ..base.stamps import stamp
from ..base.version import __version__
from ..objects import Cells
from ..pipeline.runtime import points_of
from ..stages.objectswriter import ObjectsWriter

#: Dimensions that decide which points count, beside the coordinates.
_READ = ("Classification", "Reliability", "ClassFlags", "Synthetic", "KeyPoint", "Withheld", "Overlap")


def kept_name(folder: Path, path: str, stage: ObjectsWriter) -> Path:
    """The file that keeps a file's cells: another one when the file, the options or the version are others."""
    what = json.dumps({k: str(v) for k, v in sorted(stage.options.items())})
    mark = json.dumps([__version__, what, str(Path(path).resolve()), stamp(path)])
    return folder / f"{hashlib.sha256(mark.encode()).hexdigest()[:24]}.npz"


def keep_cells(target: Path, cells: Cells, seen: NDArray) -> None:
    """Keep cells, and which class codes were seen ((256,), above 0), in a file."""
    partial = target.with_name(f"partial-{target.name}")
    np.savez(partial, key=cells.key, seen=(seen > 0).astype(np.int64), **cells.columns)  # type: ignore[arg-type]
    partial.replace(target)


@dataclass(frozen=True)
class OutputCells:
    """Whose cells outputs are to leave, and in which folder."""

    stage: ObjectsWriter
    folder: str

    def begin(self, source: str) -> CellsSeen | None:
        """What looks at the points of an input's output; None for formats whose classes hold flags: these are read again."""
        header = las.read_header(source)
        if header is None or las.holds_flags(source):
            return None
        return CellsSeen(self, header)


class CellsSeen:
    """The cells of an output's points, part by part as they go to the writer."""

    def __init__(self, whose: OutputCells, header: las.LasHeader) -> None:
        self._whose, self._header = whose, header
        self.begin()

    def begin(self) -> None:
        """Begin, or begin anew."""
        self._parts = [Cells(self._whose.stage.settings.cell)]
        self._seen = np.zeros(256, np.int64)
        self._count, self._failed = 0, False

    def look(
        self,
        module: Mapping[str, Any],
        ins: Mapping[str, NDArray],
        outs: Mapping[str, NDArray],
        kept: Any = ...,
    ) -> None:
        """Take points: dimensions as a script of PDAL's gets them, those that it changes, and which points stay."""
        there = {**ins, **outs}
        arrays = {name: np.asarray(there[name])[kept] for name in _READ if name in there}
        for name, scale, offset in zip("XYZ", self._header.scales, self._header.offsets, strict=True):
            # As they will be read from the file, to the bit.
            arrays[name] = np.rint((np.asarray(there[name])[kept] - offset) / scale) * scale + offset
        self._count += len(arrays["X"])
        stage = self._whose.stage
        try:
            points = points_of(stage, module, arrays)
            self._seen += np.bincount(points.class_codes, minlength=256)
            self._parts.append(stage.records(points))
        except StageError:  # said when the file is read
            self._failed = True
        if len(self._parts) >= 8:
            self._parts = [Cells.join(self._parts)]

    def keep(self, output: str) -> None:
        """Keep the cells, now that the output has its name; not where it is not what was looked at."""
        header = las.read_header(output)
        before = self._header
        if header is None or self._failed or header.count != self._count:
            return
        if (header.scales, header.offsets) != (before.scales, before.offsets) or las.holds_flags(output):
            return
        with contextlib.suppress(OSError):  # then it is read
            folder = Path(self._whose.folder)
            folder.mkdir(exist_ok=True)
            keep_cells(kept_name(folder, output, self._whose.stage), Cells.join(self._parts), self._seen)
