"""Find and check the inputs of a tiled run before any tile: readable, extent, unit."""

from __future__ import annotations

import glob
import hashlib
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import las, las_check
from ..base.errors import OptionError, PipelineError, StageError
from ..base.octree_check import check_ept, read_ept
from ..base.units import Units
from ..pipeline import pdal as pdal_env
from ..pipeline.expansion import stage_files
from ..pipeline.inputs_outputs import (
    LAS_READERS,
    ept_address,
    is_ept,
    is_las,
    locations,
    named_files,
)
from ..pipeline.las_output import replaced
from ..pipeline.spatial_reference import Reference, check_one_reference, reference_of
from ..stages.registry import stage_from, stage_types
from .checkpoint import fingerprint
from .options import Density, Extent, TilingOptions, block_bytes, choose_tiles, tiles_per_square
from .plan import TilePlan, outputs_for
from .tile_grid import Box, TileGrid, check_number, touching, union

#: Options of readers.tindex that select files or points, or change them.
_TINDEX_QUERIES = ("bounds", "polygon", "where", "sql", "count", "srs_column", "t_srs")


@dataclass(frozen=True)
class InputSource:
    """One input."""

    path: str  #: absolute, or an address
    reader: dict[str, Any]  #: the stage that reads it
    kind: str  #: ``las`` (LAS, LAZ, COPC) or ``ept``

    @property
    def key(self) -> str:
        """A short identifier, the same in every run."""
        return hashlib.sha1(os.fsencode(self.path)).hexdigest()[:12]

    def clip(self, box: Box) -> dict[str, Any]:
        """Return the reader of an EPT source, restricted to a box."""
        x0, y0, x1, y1 = box
        bounds = f"([{x0!r}, {x1!r}], [{y0!r}, {y1!r}])"
        return {**self.reader, "filename": self.path, "bounds": bounds}


def find_sources(readers: list[dict[str, Any]]) -> list[InputSource]:
    """Return the inputs of readers: names, patterns, EPT addresses, tile indexes.

    PipelineError where one cannot be cut.
    """
    sources: dict[str, InputSource] = {}
    for reader in readers:
        options = {k: v for k, v in reader.items() if k not in ("filename", "tag", "inputs")}
        name = reader.get("filename", "")
        paths: list[str] = name if isinstance(name, list) else [str(name)]
        kind = "ept" if reader["type"] == "readers.ept" else "las"
        if kind == "ept":
            paths = [ept_address(path) for path in paths]
        else:
            if reader["type"] == "readers.tindex":
                paths, options = _indexed_files(reader, options)
            elif reader["type"] not in LAS_READERS:
                raise PipelineError(
                    f"{reader['type']} cannot read a part of a file, so it cannot be cut into "
                    "tiles",
                    found=name,
                    cure="Convert the input first: pdal translate INPUT input.laz",
                )
            elif isinstance(name, str) and not os.path.exists(name) and glob.has_magic(name):
                paths = sorted(glob.glob(name, recursive=True))
                if not paths:
                    raise PipelineError(
                        "no file matches the reader's pattern", where=reader["type"], found=name
                    )
            paths = [os.path.abspath(path) for path in paths]
            for path in paths:
                las.refuse_pipe(path)
            options["type"] = "readers.las"
        for path in paths:
            sources.setdefault(path, InputSource(path, options, kind))
    return list(sources.values())


def _indexed_files(
    reader: dict[str, Any], options: dict[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """Return the files of a tile index, and the options for their readers."""
    if queries := [name for name in _TINDEX_QUERIES if name in reader]:
        raise PipelineError(
            "in tiles, all files of a tile index are read whole and in their own spatial reference",
            where="readers.tindex",
            found=", ".join(queries),
            cure="Leave these options out, or make an index of the files you mean",
        )
    paths = locations(str(reader["filename"]), str(options.get("tindex_name", "location")))
    return paths, {k: v for k, v in options.items() if k in ("override_srs", "default_srs")}


def read_extent(source: InputSource) -> Extent:
    """Return the number of points and the bounding box of an input, from its header.

    StageError where these cannot be read.
    """
    if source.kind != "ept":
        return las_extent(source.path)
    described = check_ept(source.path)
    x0, y0, _, x1, y1, _ = map(float, described["boundsConforming"])
    return Extent(int(described["points"]), (x0, y0, x1, y1))


def las_extent(path: str) -> Extent:
    """Return the number of points and the bounding box in the header of a LAS or LAZ file."""
    try:
        header = las.read_header(path)
    except OSError as error:
        raise StageError("the input cannot be read", where=path, found=error) from None
    if header is None:
        raise StageError("the input is not a LAS or LAZ file", where=path)
    x0, y0, x1, y1 = header.box
    if header.count and not (math.isfinite(x1 - x0 + y1 - y0) and x0 <= x1 and y0 <= y1):
        raise StageError(
            "the header has no bounding box", where=path, found=f"x {x0} to {x1}, y {y0} to {y1}"
        )
    return Extent(header.count, header.box)


# ---- EPT sources ---------------------------------------------------------------------------------


def ept_form(described: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of ``writers.las`` for an EPT source: its scales, offsets and colors."""
    axes = {dimension["name"]: dimension for dimension in described["schema"]}
    colored = 8 if "Infrared" in axes else 7 if "Red" in axes else 6
    form: dict[str, Any] = {"minor_version": 4, "dataformat_id": colored}
    for axis in "XYZ":
        form[f"scale_{axis.lower()}"] = float(axes.get(axis, {}).get("scale") or 0.001)
        form[f"offset_{axis.lower()}"] = float(axes.get(axis, {}).get("offset") or 0.0)
    return form


def fetch_ept(source: InputSource, box: Box, target: str) -> bool:
    """Read the points of an EPT source in a box into a LAS file; return whether there are any.

    Scales and offsets are the source's, so coordinates do not change; other dimensions become extra
    dimensions.
    """
    form = {**ept_form(read_ept(source.path)), "extra_dims": "all"}
    run = pdal_env.execute(
        [source.clip(box), {"type": "writers.las", "filename": target, **form}], arrays=False
    )
    return bool(run.count and las_extent(target).count)


# ---- all inputs ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class CloudIndex:
    """The location of a file's points."""

    count: int
    box: Box  #: of all points
    tiles: list[tuple[int, int, int]]  #: column, row and number of points of each tile
    #: (n, 4): column, row, index of the first point in the copy, number of points
    cells: NDArray[np.int64]
    grid: TileGrid  #: of the cells
    copy: str  #: the file with the points
    checksum: int  #: CRC-32 of the copy
    digest: str  #: SHA-256 of the input
    changed_ns: int  #: time of the input's last change of content or status, which no program sets

    @classmethod
    def parse(cls, record: dict[str, Any], copy: str) -> CloudIndex:
        """Return the index that :func:`sort_points` has described."""
        cells = np.array(record["cells"], np.int64).reshape(-1, 4)
        tiles = [(i, j, n) for i, j, n in record["tiles"]]
        sums = int(record["checksum"]), str(record["digest"]), int(record["changed_ns"])
        grid = TileGrid(*map(float, record["grid"]))
        return cls(int(record["count"]), tuple(record["box"]), tiles, cells, grid, copy, *sums)

    def is_of(self, path: str) -> bool:
        """Return whether the input still holds the bytes that were read.

        It is read again only where its status changed, as it does when a file is copied, linked or
        edited.
        """
        try:
            return os.stat(path).st_ctime_ns == self.changed_ns or digest_of(path) == self.digest
        except OSError:
            return False


#: An input with the index of its points; EPT sources have none.
IndexedSource = tuple[InputSource, CloudIndex | None]


class Survey:
    """The inputs of a run, and its options with tile size and number of workers decided."""

    def __init__(
        self, plan: TilePlan, options: TilingOptions, earlier: Mapping[str, Any] | None = None
    ) -> None:
        """Find and check the inputs, and choose tiles.

        `earlier` is the :attr:`layout` of the run that this one resumes, where the user gives no
        tile size.
        """
        self.started = time.strftime("%Y-%m-%d %H:%M")
        self.messages = list(plan.messages)
        self.unreadable: dict[str, str] = {}  #: unreadable inputs by path, and why
        self.extents: dict[str, Extent] = {}  #: of inputs by path, where the header can be read
        #: of LAS and LAZ files by path, once they were read
        self.indexes: dict[str, CloudIndex] = {}
        self.sources = find_sources(plan.readers)
        self.paths = [source.path for source in self.sources]
        self._others = files_read_by([*plan.head, *plan.tail])
        #: Sizes and times of inputs, and of other files that stages read, at the start of the run.
        self.stamps = {path: stamp(path) for path in [*self.paths, *self._others]}
        self._read_headers()
        files_of_las = [source.path for source in self.sources if source.kind == "las"]
        self.messages += replaced(files_of_las, plan.makes)
        files = all(source.kind == "las" for source in self.sources)
        if options.per == "file" and not files:
            raise OptionError("--per file needs LAS or LAZ inputs", cure="Use --per tile")
        #: ``file`` or ``tile``: what an output corresponds to.
        self.per = options.per if options.per != "auto" else "file" if files else "tile"
        #: What each of the writers writes of each input; empty where each tile is an output.
        self.outputs = outputs_for(plan, self.paths) if self.per == "file" else []
        self.unit = self._unit(plan)  #: meters per unit of the coordinates
        self.halo_units = plan.halo_m / self.unit  #: of a tile, in the unit of the coordinates
        self.place()
        self.density = Density.measure(self.extents.values())
        #: Memory of a worker for the rounds before the tiles.
        self.block_bytes = (
            block_bytes(plan.blocks, self.density.area * self.unit**2) if plan.blocks else 0.0
        )
        sized = replace(options, tile=earlier["tile"]) if earlier else options
        self.options, self.grid = choose_tiles(
            sized, self.density, self.halo_units, self.per == "file", self.block_bytes
        )
        if earlier:
            self.grid = TileGrid(self.grid.size, earlier["origin"])
        square = 1
        if len(plan.rounds) > 1:
            halo = max(part.halo_m for part in plan.rounds) / self.unit
            square = tiles_per_square(self.options, self.density, self.grid.size, halo)
        self.tiles_per_square = round(earlier["square"]) if earlier else square
        self.squares = self.grid.scaled(self.tiles_per_square)

    def _read_headers(self) -> None:
        odd: list[str] = []
        for source in self.sources:
            try:
                self.extents[source.path] = read_extent(source)
                if any("\ud800" <= character <= "\udfff" for character in source.path):
                    raise StageError(
                        "the name of the file is not UTF-8",
                        where=source.path,
                        cure="Rename the file",
                    )
                if source.kind == "las":
                    odd += filter(None, [las_check.check_readable(source.path)])
            except StageError as error:
                self.unreadable[source.path] = str(error)
        more = f" (so are those of {len(odd) - 1:,} more inputs)" if len(odd) > 1 else ""
        self.messages += [f"{message}{more}" for message in odd[:1]]
        if lost := len(self.sources) - len(self.extents):
            self.messages.append(
                f"{lost:,} of the inputs have no readable header: where they lie is not known, and "
                "tiles beside them may "
                "lack neighbors. Once they can be read, --resume runs those tiles again"
            )

    def _unit(self, plan: TilePlan) -> float:
        """Return meters per unit of the coordinates.

        Inputs that stages see together must have the same reference.
        """
        needed = bool(plan.head and plan.sees_m)
        known: dict[str, Reference] = {}  # PDAL is asked once for equal references
        references: dict[str, Reference] = {}
        for source in self.sources:
            if source.path in self.unreadable:
                continue
            ept = source.kind == "ept"
            projection = (
                read_ept(source.path).get("srs") if ept else las.projection_digest(source.path)
            )
            kind = fingerprint(source.reader, projection)
            try:
                if kind not in known:
                    known[kind] = self._reference_of(source, plan.unit)
            except PipelineError as error:
                self.unreadable[source.path] = str(error)
                continue
            except StageError:
                if needed:
                    raise
                known[kind] = Reference(Units())  # no stage needs it
            references[source.path] = known[kind]
        if not references:
            reasons = iter(self.unreadable.values())
            raise StageError("none of the inputs can be read", found=next(reasons, "no input"))
        if needed:
            messages = check_one_reference(references)
            if messages and self.per == "file":
                messages[0] += (
                    ", and the output gets none: --readers.las.default_srs=EPSG:CODE names it in "
                    "both"
                )
            self.messages += messages
        return next(iter(references.values())).units.horizontal

    def _reference_of(self, source: InputSource, horizontal: str) -> Reference:
        """Return the reference of an input, as PDAL's reader reports it after few points."""
        if source.kind == "las":
            return reference_of({**source.reader, "filename": source.path, "count": 1}, horizontal)
        x, y, _, _ = self.extents[source.path].box
        return reference_of(source.clip((x, y, x + 1, y + 1)), horizontal)

    @property
    def layout(self) -> dict[str, float]:
        """The grids, for a run that resumes this one with another amount of free memory."""
        square = self.tiles_per_square
        return {"tile": self.grid.size, "origin": self.grid.origin, "square": square}

    def place(self) -> None:
        """Collect the boxes of inputs from headers or indexes, as an array for fast comparison."""
        self.placed = [
            s for s in self.sources if s.path in self.extents and self.extents[s.path].count
        ]
        boxes = []
        for source in self.placed:
            index = self.indexes.get(source.path)
            boxes.append(index.box if index and index.count else self.extents[source.path].box)
        self._boxes = np.array(boxes, np.float64)
        self.bounds: Box = union(boxes)

    @cached_property
    def _contents(self) -> dict[str, Any]:
        """Return the digests of the files that stages read; a folder has its size and time.

        A run that is only planned (``--dry-run``) does not read them.
        """
        return {
            path: digest_of(path) if os.path.isfile(path) else stamp(path) for path in self._others
        }

    def stamps_of(self, stages: list[dict[str, Any]]) -> list[Any]:
        """Return names and contents (digests) of the models, maps and other files of stages."""
        return [[path, self._contents[path]] for path in files_read_by(stages)]

    def seen(self, sources: list[InputSource]) -> list[Any]:
        """Return names, readers and contents of inputs: digests, or sizes and times without."""
        return [
            [source.path, source.reader, self.indexes[source.path].digest]
            if source.path in self.indexes
            else [source.path, source.reader, self.stamps[source.path]]
            for source in sources
        ]

    def changed(self) -> list[str]:
        """Return the inputs and other files that changed since the run began."""
        return [path for path, before in self.stamps.items() if stamp(path) != before]

    def near(self, tile: tuple[int, int], halo_units: float) -> list[InputSource]:
        """Return the inputs that may have points in a tile or its halo."""
        return self.near_box(self.grid.box(tile, halo_units))

    def near_box(self, box: Box) -> list[InputSource]:
        """Return the inputs that may have points in a box."""
        return [self.placed[n] for n in touching(self._boxes, box)]

    def readable(self, sources: list[InputSource]) -> list[IndexedSource]:
        """Return the inputs that are readable, with the index of their points."""
        return [(s, self.indexes.get(s.path)) for s in sources if s.path not in self.unreadable]

    def tiles(self) -> dict[tuple[int, int], int]:
        """Return all tiles that may have points, row by row, with their number (0: unknown)."""
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
        """Return what the report tells about the pipeline, its models, the inputs and the tiles."""
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


def files_read_by(stages: Sequence[dict[str, Any]]) -> list[str]:
    """Return the files that stages read: models, maps and what else PDAL's options name."""
    ours = [stage_from(stage) for stage in stages if stage["type"] in stage_types()]
    files = [path for stage in ours for path in stage_files(stage) if os.path.exists(path)]
    return list(dict.fromkeys([*named_files(stages), *files]))


def digest_of(path: str | os.PathLike) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while data := file.read(1 << 24):
            digest.update(data)
    return digest.hexdigest()


def stamp(path: str | os.PathLike) -> list[int]:
    """Return the size and time of a file; -1 where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return [-1, -1]
    return [status.st_size, status.st_mtime_ns]


def one_format(paths: Sequence[str]) -> dict[str, Any]:
    """Return options of ``writers.las`` for the points of all inputs; empty for LAS of one form.

    The finest scale of each axis with its offset, and the first format of LAS 1.4 with all colors
    of the inputs: PDAL only forwards what all inputs of a tile share, and otherwise uses scales of
    a centimeter and point format 3. Unreadable inputs are reported later.
    """
    formats: set[int] = set()
    places: set[tuple[float, ...]] = set()
    for path in paths:
        try:
            if is_ept(path):
                form = ept_form(read_ept(path))
                formats.add(form["dataformat_id"])
                places.add(
                    tuple(form[f"{what}_{axis}"] for what in ("scale", "offset") for axis in "xyz")
                )
            elif is_las(path) and (header := las.read_header(path)) and header.count:
                formats.add(header.point_format)
                places.add((*header.scales, *header.offsets))
        except (OSError, StageError, ValueError, TypeError):
            continue
    options: dict[str, Any] = {}
    if len(formats) > 1 or any(map(is_ept, paths)):
        colored = 8 if 8 in formats else 7 if formats & {2, 3, 7} else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    for axis, name in enumerate("xyz"):
        along = {(place[axis], place[3 + axis]) for place in places}
        if len(along) > 1:
            scale, offset = min(along, key=lambda place: (place[0], -abs(place[1])))
            # Of newer PDAL "auto" is the tile's middle, off the grid of the coordinates: only for
            # what lies too far apart.
            far = any(abs(other - offset) > 2**30 * scale for _, other in along)
            options |= {f"scale_{name}": scale, f"offset_{name}": "auto" if far else offset}
    return options
