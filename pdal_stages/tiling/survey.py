"""What is known of a run's inputs before any tile: which can be read, where they lie, in what unit."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from ..base import las, lascheck
from ..base.errors import OptionError, PipelineError, StageError
from ..base.stamps import stamp
from ..base.units import Units
from ..pipeline.filenames import named_files
from ..pipeline.inputs_outputs import in_folders
from ..pipeline.references import Reference, check_one_reference, reference_of, without_reference
from .grid import Box, TileGrid, check_number, touching, union
from .pieces import CloudIndex
from .plan import TilePlan
from .settings import Density, TilingOptions, block_bytes, settled
from .sources import Extent, InputSource, find_sources, read_ept, read_extent
from .store import fingerprint

#: Inputs with odd headers that are named.
_ODD = 5


class Survey:
    """The inputs of a run, and its options with the tiles' side and the workers settled."""

    def __init__(self, plan: TilePlan, options: TilingOptions) -> None:
        self.started = time.strftime("%Y-%m-%d %H:%M")
        self.messages = list(plan.messages)
        self._whole_names = plan.whole_names
        self.unreadable: dict[str, str] = {}  #: inputs by path that cannot be read, and why
        self.extents: dict[str, Extent] = {}  #: of inputs by path, where the header can be read
        self.indexes: dict[str, CloudIndex] = {}  #: of LAS and LAZ files by path, once they were read
        self.sources = find_sources(plan.readers)
        others = named_files([*plan.head, *plan.tail])
        #: What inputs, and other files that stages read, were like when the run began.
        self.stamps = {path: stamp(path) for path in [*self.paths, *others]}
        if any("t_srs" in reader for reader in plan.readers):
            self.messages.append(
                "readers.tindex: in tiles points keep the reference of their file, t_srs is left out"
            )
        self._read_headers()
        files = all(source.kind == "las" for source in self.sources)
        if options.per == "file" and not files:
            raise OptionError("--per file needs LAS or LAZ inputs", cure="Use --per tile")
        #: ``file`` or ``tile``: what one output is made of.
        self.per = options.per if options.per != "auto" else "file" if files else "tile"
        self.unit = self._unit(plan)  #: meters per unit of the coordinates
        self.halo_units = plan.halo_m / self.unit  #: of a tile, in the unit of the coordinates
        self.place()
        self.density = Density.of(self.extents.values())
        #: Memory of a worker for what is made before the tiles.
        self.block_bytes = (
            block_bytes(plan.first.blocks, self.density.area * self.unit**2) if plan.first else 0.0
        )
        self.options = settled(options, self.density, self.halo_units, self.per == "file", self.block_bytes)
        assert self.options.tile is not None
        self.grid = TileGrid(self.options.tile)

    def _read_headers(self) -> None:
        odd: list[str] = []
        for source in self.sources:
            try:
                self.extents[source.path] = read_extent(source)
                if any("\ud800" <= character <= "\udfff" for character in source.path):
                    raise StageError(
                        "the name of the file is not UTF-8", where=source.path, cure="Rename the file"
                    )
                if source.kind == "las" and (said := lascheck.check_readable(source.path)):
                    odd.append(said)
            except StageError as error:
                self.unreadable[source.path] = str(error)
        self.messages += odd[:_ODD]
        if len(odd) > _ODD:
            self.messages.append(f"so it is with {len(odd) - _ODD:,} more inputs: their headers are odd, too")
        if len(self.unreadable) == len(self.sources):
            raise self._none_readable()
        if lost := len(self.sources) - len(self.extents):
            self.messages.append(
                f"{lost:,} of the inputs without a readable header: where they lie is not known, and tiles beside them may "
                "lack neighbors. Once they can be read, --resume runs those tiles again"
            )

    def _none_readable(self) -> StageError:
        return StageError(
            "none of the inputs can be read", found=next(iter(self.unreadable.values()), "no input")
        )

    def _unit(self, plan: TilePlan) -> float:
        """Meters per unit of the coordinates, whose reference must be one for all inputs that stages see together."""
        needed = bool(plan.head and plan.halo_m)
        groups: dict[str, list[InputSource]] = {}
        for source in self.sources:
            if source.path not in self.unreadable:
                own = (
                    read_ept(source.path).get("srs") if source.kind == "ept" else las.projection(source.path)
                )
                groups.setdefault(fingerprint(source.reader, own), []).append(source)
        found: dict[str, Reference] = {}
        for group in groups.values():
            for source in group:
                try:
                    found[source.path] = self._reference_of(source, plan.unit)
                    break
                except PipelineError as error:
                    self.unreadable[source.path] = str(error)
                except StageError:
                    if needed:
                        raise
                    found[source.path] = Reference(Units())  # nobody asks
                    break
        if not found:
            raise self._none_readable()
        if needed:
            without = set(check_one_reference(found))
            alike = [[source.path for source in group] for group in groups.values()]
            self.messages += without_reference(
                [path for each in alike if without & set(each) for path in each]
            )
        return next(iter(found.values())).units.horizontal

    def _reference_of(self, source: InputSource, horizontal: str) -> Reference:
        """What PDAL's reader says of an input, with as few points read as it can."""
        if source.kind == "las":
            return reference_of({**source.reader, "filename": source.path, "count": 1}, horizontal)
        x, y, _, _ = self.extents[source.path].box
        return reference_of(source.within((x, y, x + 1, y + 1)), horizontal)

    def place(self) -> None:
        """Note where inputs lie, as headers or indexes say; thousands of them are compared at once."""
        self.placed = [s for s in self.sources if s.path in self.extents and self.extents[s.path].count]
        boxes = []
        for source in self.placed:
            index = self.indexes.get(source.path)
            boxes.append(index.box if index and index.count else self.extents[source.path].box)
        self._boxes = np.array(boxes, np.float64)
        self.bounds: Box = union(boxes)

    @property
    def paths(self) -> list[str]:
        """Of all inputs."""
        return [source.path for source in self.sources]

    @property
    def names(self) -> list[str]:
        """What outputs of files are called, in place of '#'."""
        if self._whole_names:
            return in_folders(self.paths, [source.plain_name for source in self.sources])
        return [source.stem for source in self.sources]

    def stamps_of(self, stages: list[dict[str, Any]]) -> list[Any]:
        """Names and stamps of the files that stages read."""
        return [[path, self.stamps.get(path)] for path in named_files(stages)]

    def seen(self, sources: list[InputSource]) -> list[Any]:
        """Names, stamps and readers of inputs."""
        return [[source.path, self.stamps[source.path], source.reader] for source in sources]

    def changed(self) -> list[str]:
        """Inputs and other files that are not what they were when the run began."""
        return [path for path, then in self.stamps.items() if stamp(path) != then]

    def near(self, tile: tuple[int, int], halo_units: float) -> list[InputSource]:
        """Inputs that may hold points of a tile or its halo."""
        return [self.placed[n] for n in touching(self._boxes, self.grid.box(tile, halo_units))]

    def readable(self, sources: list[InputSource]) -> list[tuple[InputSource, CloudIndex | None]]:
        """Those that can be read, with what tasks need to know of where their points lie."""
        return [(s, self.indexes.get(s.path)) for s in sources if s.path not in self.unreadable]

    def tiles(self) -> dict[tuple[int, int], int]:
        """Every tile that may have points of its own, row by row, and how many where that is known (else 0)."""
        counts: dict[tuple[int, int], int] = {}
        for path, header in self.extents.items():
            if path in self.indexes:
                for i, j, n in self.indexes[path].tiles:
                    counts[i, j] = counts.get((i, j), 0) + n
            elif header.count:
                for tile in self.grid.covering(header.box):
                    counts.setdefault(tile, 0)
        check_number(len(counts), f"tiles of {self.grid.size:g}")
        return dict(sorted(counts.items(), key=lambda item: (item[0][1], item[0][0])))

    def figures(self, plan: TilePlan) -> dict[str, Any]:
        """What a report says of the pipeline, its models, the inputs and the tiles' size."""
        return {
            "pipeline": plan.name,
            "models": [str(stage["model"]) for stage in plan.head if "model" in stage],
            "started": self.started,
            "tile": self.grid.size,
            "halo_m": plan.halo_m,
            "meters_per_unit": self.unit,
            "per": self.per,
            "inputs": len(self.sources),
            "bounds": list(self.bounds) if math.isfinite(self.bounds[0]) else None,
        }
