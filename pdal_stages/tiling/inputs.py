"""Find and check the inputs of a tiled run before any tile: readable, extent, unit."""

from __future__ import annotations

import glob
import hashlib
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..base import las, las_check
from ..base.errors import PipelineError, StageError
from ..base.grid import cell_keys, key_offset, places_among
from ..base.hashing import digest_of_file, fingerprint
from ..base.json_types import JsonObject, StageJson
from ..base.las_points import Layout
from ..base.messages import Message, Topic
from ..base.units import Units
from ..pipeline.copies import layout_read_by, reader_of_copy
from ..pipeline.inputs_outputs import LAS_READERS, locations
from ..pipeline.spatial_reference import Reference, check_one_reference, reference_of
from .options import (
    Box,
    Density,
    Extent,
    TileGrid,
    TilingOptions,
    block_bytes,
    check_number,
    choose_tiles,
    tiles_per_square,
    touching,
    union,
)
from .plan import TilePlan, outputs_for
from .records import JobRecord, RunGrids

#: Side of a square in meters: ground points in squares that do not touch make no triangle whose
#: circle has a radius of at most 100 m, the default of terrain models.
LONE_M = 250.0
#: Points that make a triangle: fewer within a square and those around are alone.
_COMPANY = 3


def sum_points(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (m, 3) squares with their points, each square once, ascending: column, row, points."""
    squares, which = np.unique(rows[:, :2], axis=0, return_inverse=True)
    points = np.bincount(which.reshape(-1), rows[:, 2], len(squares))
    return np.column_stack([squares, points.astype(np.int64)])


@dataclass(frozen=True)
class CloudIndex(JobRecord):
    """The location of a file's points."""

    count: int
    box: Box  #: of all points
    tiles: list[tuple[int, int, int]]  #: column, row and number of points of each tile
    #: (n, 4): column, row, index of the first point in the copy, number of points
    cells: NDArray[np.int64]
    grid: TileGrid  #: of the cells
    digest: str  #: SHA-256 of the input
    changed_ns: int  #: time of the input's last change of content or status, which no program sets
    squares: NDArray[np.int64]  #: (k, 3): column and row in :attr:`Survey.lone_grid`, points
    warning: str = ""  #: about points outside the box in the header
    copy: str = ""  #: the file with the points; empty where an earlier run had it

    def to_json(self) -> JsonObject:
        """Return all but the copy, which goes with the run."""
        arrays = {"cells": self.cells.tolist(), "squares": self.squares.tolist()}
        values = {**vars(self), **arrays, "grid": [self.grid.size, self.grid.origin]}
        del values["copy"]
        return values

    @classmethod
    def from_json(cls, saved: JsonObject) -> CloudIndex:
        """Return the index that was saved, without its copy."""
        cells = np.array(saved["cells"], np.int64).reshape(-1, 4)
        tiles = [(i, j, n) for i, j, n in saved["tiles"]]
        grid = TileGrid(*map(float, saved["grid"]))
        squares = np.array(saved["squares"], np.int64).reshape(-1, 3)
        arrays = {"box": tuple(saved["box"]), "tiles": tiles, "cells": cells, "squares": squares}
        return super().from_json({**saved, **arrays, "grid": grid})

    def is_of(self, path: str) -> bool:
        """Return whether the input still holds the bytes that were read.

        It is read again only where its status changed, as it does when a file is copied, linked or
        edited.
        """
        try:
            return (
                os.stat(path).st_ctime_ns == self.changed_ns or digest_of_file(path) == self.digest
            )
        except OSError:
            return False


@dataclass(frozen=True)
class LonePoints:
    """Points that have fewer than two others in the same square and the eight around it."""

    grid: TileGrid  #: of the squares
    keys: NDArray[np.int64]  #: (k,) their squares, sorted
    others: Box  #: box of the other points, or of their squares where that is narrower

    def among(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points (n,) are lone ones."""
        if not len(self.keys):
            return np.zeros(len(x), bool)
        return places_among(self.keys, cell_keys(self.grid.index(x), self.grid.index(y)))[1]


@dataclass
class InputSource:
    """One input, a LAS, LAZ or COPC file, and what is known of it."""

    path: str  #: absolute
    reader: StageJson  #: the stage that reads it, without the file's name
    extent: Extent | None = None  #: None where the header cannot be read
    stamp: Sequence[int] = ()  #: size and time at the start of the run
    fault: str = ""  #: why it cannot be read, without its path
    index: CloudIndex | None = None  #: once it was read

    def blame(self, reason: object) -> None:
        """Keep why it cannot be read."""
        self.fault = str(reason).removeprefix(f"{self.path}: ")

    @property
    def layout(self) -> Layout:
        """The layout of its points, as its reader names extra bytes."""
        return layout_read_by(self.reader, self.path)

    @property
    def reader_of_copy(self) -> StageJson:
        """The stage that reads copies of its points, without the file's name."""
        return reader_of_copy(self.reader)

    @property
    def key(self) -> str:
        """A short identifier, the same in every run."""
        return hashlib.sha1(os.fsencode(self.path)).hexdigest()[:12]

    @property
    def box(self) -> Box | None:
        """The box of its points, as far as they are known; None where it has none."""
        if self.extent is None or not self.extent.count:
            return None
        return self.index.box if self.index and self.index.count else self.extent.box

    @property
    def content(self) -> list[object]:
        """Its name, reader and digest; size and time before it was read."""
        return [self.path, self.reader, self.index.digest if self.index else self.stamp]


def find_sources(readers: list[StageJson]) -> list[InputSource]:
    """Return the inputs of readers: names, patterns, tile indexes; refuse other readers."""
    sources: dict[str, InputSource] = {}
    for reader in readers:
        options = {k: v for k, v in reader.items() if k not in ("filename", "tag", "inputs")}
        name = reader.get("filename", "")
        if reader["type"] == "readers.tindex":
            paths = locations(str(name), str(options.get("tindex_name", "location")))
            options = {k: v for k, v in options.items() if k in ("override_srs", "default_srs")}
        elif reader["type"] not in LAS_READERS:
            raise PipelineError(
                f"{reader['type']} cannot read a part of a file, so it cannot be cut into tiles",
                found=name,
                cure="Convert the input first: pdal translate INPUT input.laz (of EPT a part, "
                "with --readers.ept.bounds)",
            )
        elif isinstance(name, list):
            paths = name
        else:
            there = os.path.exists(name) or not glob.has_magic(name)
            paths = [name] if there else sorted(glob.glob(name, recursive=True))
            if not paths:
                raise PipelineError(
                    "no file matches the reader's pattern", where=reader["type"], found=name
                )
        for path in map(os.path.abspath, paths):
            las.refuse_pipe(path)
            sources.setdefault(path, InputSource(path, {**options, "type": "readers.las"}))
    return list(sources.values())


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


class Survey:
    """The inputs of a run, and its options with tile size and number of workers decided."""

    def __init__(
        self, plan: TilePlan, options: TilingOptions, earlier: RunGrids | None = None
    ) -> None:
        """Find and check the inputs, and choose tiles.

        `earlier` are the grids of the run that this one resumes, where the user gives no tile size.
        """
        self.started = time.strftime("%Y-%m-%d %H:%M")
        self.messages = list(plan.messages)
        self.sources = find_sources(plan.readers)
        self.paths = [source.path for source in self.sources]
        #: Sizes and times of the files that stages read, at the start of the run.
        self._others = {path: stamp(path) for files in plan.files for path in files}
        self._read_headers()
        #: What each of the writers writes of each input; empty where each tile is an output.
        self.outputs = outputs_for(plan, self.paths) if options.per == "file" else []
        #: of the first input that has one
        self.reference = self._reference(plan, options.per)
        self.unit = self.reference.units.horizontal  #: meters per unit of the coordinates
        self.halo_units = plan.halo_m / self.unit  #: of a tile, in the unit of the coordinates
        self.place()
        self.density = self.measure_density()
        #: Memory of a worker for the rounds before the tiles.
        self.block_bytes = (
            block_bytes(plan.blocks, self.density.area * self.unit**2) if plan.blocks else 0.0
        )
        sized = replace(options, tile=earlier.tile) if earlier else options
        self.options, self.grid = choose_tiles(
            sized, self.density, self.halo_units, self.block_bytes
        )
        if earlier:
            self.grid = TileGrid(self.grid.size, earlier.origin)
        square = 1
        if len(plan.rounds) > 1:
            halo = max(part.halo_m for part in plan.rounds) / self.unit
            square = tiles_per_square(self.options, self.density, self.grid.size, halo)
        self.tiles_per_square = earlier.square if earlier else square
        self.squares = self.grid.scaled(self.tiles_per_square)

    def _read_headers(self) -> None:
        odd: list[str] = []
        for source in self.sources:
            source.stamp = stamp(source.path)
            try:
                source.extent = las_extent(source.path)
                if any("\ud800" <= character <= "\udfff" for character in source.path):
                    raise StageError("the name of the file is not UTF-8", cure="Rename the file")
                odd += filter(None, [las_check.check_readable(source.path)])
            except StageError as error:
                source.blame(error)
        self.messages += map(Message, copies_among(self.sources))
        more = f" (so are those of {len(odd) - 1:,} more inputs)" if len(odd) > 1 else ""
        self.messages += [Message(f"{text}{more}", Topic.INPUT) for text in odd[:1]]

    @property
    def system(self) -> list[object]:
        """Return the units and the projection of the coordinates, however a file words them."""
        return [vars(self.reference.units), sorted(self.reference.plane)]

    def warnings_of_boxes(self) -> list[Message]:
        """Return warnings about inputs with points outside the box in their header."""
        indexes = [source.index for source in self.sources if source.index]
        return [Message(index.warning) for index in indexes if index.warning]

    def measure_density(self) -> Density:
        """Return the density of the inputs, by which tiles are chosen."""
        return Density.measure(filter(None, (source.extent for source in self.sources)))

    def _reference(self, plan: TilePlan, per: str) -> Reference:
        """Return the reference of the inputs, that of the first where no stage needs one.

        Inputs that stages see together must have the same.
        """
        known: dict[str, Reference] = {}  # PDAL is asked once for equal references
        references: dict[str, Reference] = {}
        for source in self.readable():
            kind = fingerprint(source.reader, las.projection_digest(source.path))
            try:
                if kind not in known:  # as PDAL's reader reports it after one point
                    reader = {**source.reader, "filename": source.path}
                    known[kind] = reference_of(reader, plan.unit)
            except PipelineError as error:
                source.blame(error)
                continue
            except StageError:
                if plan.one_reference:
                    raise
                known[kind] = Reference(Units())  # no stage needs it
            references[source.path] = known[kind]
        if not references:
            reasons = (f"{source.path}: {source.fault}" for source in self.sources)
            raise StageError("none of the inputs can be read", found=next(reasons, "no input"))
        if plan.one_reference:
            messages = check_one_reference(references)
            name_it = "--readers.las.default_srs=EPSG:CODE names it in both"
            more = f", and the output gets none: {name_it}" if per == "file" else ""
            self.messages += [replace(each, text=f"{each.text}{more}") for each in messages]
        notes = dict.fromkeys(each.note for each in references.values())
        self.messages += map(Message, filter(None, notes))
        first, *others = references.values()
        return next((each for each in others if each.name and not first.name), first)

    @property
    def lone_grid(self) -> TileGrid:
        """Return the squares in which it is counted whether points are alone."""
        return TileGrid(LONE_M / self.unit)

    def find_lone_points(self) -> LonePoints:
        """Return the points that are alone, all inputs together; none if all are.

        They follow from the points alone, whatever the tiles.
        """
        held = [source.index.squares for source in self.readable() if source.index]
        squares = sum_points(np.concatenate([np.empty((0, 3), np.int64), *held]))
        squares = squares[np.lexsort(squares.T[:2])]  # as keys ascend
        key, points = cell_keys(squares[:, 0], squares[:, 1]), squares[:, 2]
        few = np.flatnonzero(points < _COMPANY)
        company = np.zeros(len(few), np.int64)
        for columns, rows in product((-1, 0, 1), repeat=2) if len(few) else ():
            place, there = places_among(key, key[few] + key_offset(columns, rows))
            company += np.where(there, points[place], 0)
        lone = key[few[company < _COMPANY]]
        if not len(lone) or len(lone) == len(key):
            return LonePoints(self.lone_grid, lone[:0], self.bounds)
        column, row, _ = squares[~np.isin(key, lone)].T
        west, south = self.lone_grid.box((int(column.min()), int(row.min())))[:2]
        east, north = self.lone_grid.box((int(column.max()), int(row.max())))[2:]
        x0, y0, x1, y1 = self.bounds
        box = max(x0, west), max(y0, south), min(x1, east), min(y1, north)
        return LonePoints(self.lone_grid, lone, box)

    @property
    def grids(self) -> RunGrids:
        """Return the grids of the run."""
        return RunGrids(self.grid.size, self.grid.origin, self.tiles_per_square)

    def place(self) -> None:
        """Collect the boxes of inputs from headers or indexes, as an array for fast comparison."""
        self.placed = [source for source in self.sources if source.box]
        self._boxes = np.array([source.box for source in self.placed], np.float64)
        self.bounds: Box = union(self._boxes)

    @cached_property
    def _contents(self) -> JsonObject:
        """Return the digests of the files that stages read; a folder has its size and time.

        A run that is only planned (``--dry-run``) does not read them.
        """
        return {
            path: digest_of_file(path) if os.path.isfile(path) else before
            for path, before in self._others.items()
        }

    def stamps_of(self, files: Sequence[Sequence[str]]) -> list[object]:
        """Return names and contents (digests) of files that stages read."""
        return [[path, self._contents[path]] for each in files for path in each]

    def changed(self) -> list[str]:
        """Return the inputs and other files that changed since the run began."""
        stamps = {source.path: source.stamp for source in self.sources} | self._others
        return [path for path, before in stamps.items() if stamp(path) != before]

    def near(self, tile: tuple[int, int], halo_units: float) -> list[InputSource]:
        """Return the inputs that may have points in a tile or its halo."""
        return self.near_box(self.grid.box(tile, halo_units))

    def near_box(self, box: Box) -> list[InputSource]:
        """Return the inputs that may have points in a box."""
        return [self.placed[n] for n in touching(self._boxes, box)]

    @property
    def faults(self) -> dict[str, str]:
        """Return the inputs that cannot be read, and why."""
        return {source.path: source.fault for source in self.sources if source.fault}

    def readable(self) -> list[InputSource]:
        """Return the inputs without faults."""
        return [source for source in self.sources if not source.fault]

    def tiles(self) -> dict[tuple[int, int], int]:
        """Return all tiles that may have points, row by row, with their number (0: unknown)."""
        counts: dict[tuple[int, int], int] = {}
        for source in self.sources:
            if source.index is not None:
                for i, j, n in source.index.tiles:
                    counts[i, j] = counts.get((i, j), 0) + n
            elif source.box is not None:
                for tile in self.grid.covering(source.box):
                    counts.setdefault(tile, 0)
        check_number(len(counts), f"tiles of {self.grid.size:g}")
        return dict(sorted(counts.items(), key=lambda item: (item[0][1], item[0][0])))

    def figures(self, plan: TilePlan) -> JsonObject:
        """Return what the report tells about the pipeline, its models, the inputs and the tiles."""
        models = dict.fromkeys(str(stage["model"]) for stage in plan.in_tiles if "model" in stage)
        return {
            "pipeline": plan.name,
            "models": list(models),
            "started": self.started,
            "tile": self.grid.size,
            "halo_m": plan.halo_m,
            "meters_per_unit": self.unit,
            "per": self.options.per,
            "inputs": len(self.sources),
            "bounds": list(self.bounds) if math.isfinite(self.bounds[0]) else None,
        }


def copies_among(sources: Sequence[InputSource]) -> list[str]:
    """Return a message about the first pair of inputs that seem to hold the same points."""
    first: dict[tuple, str] = {}
    pairs = []
    for source in sources:
        if source.extent is not None and source.extent.count:
            key = source.extent.count, *np.round(source.extent.box, 6).tolist()
            if (other := first.setdefault(key, source.path)) is not source.path:
                pairs.append(f"{other} and {source.path}")
    more = f" (and {len(pairs) - 1:,} more pairs)" if len(pairs) > 1 else ""
    return [
        f"{pair} have the same number of points within the same bounds{more}: if one is a copy of "
        "the other, leave it out, as all points are there twice"
        for pair in pairs[:1]
    ]


def stamp(path: str | os.PathLike) -> list[int]:
    """Return the size and time of a file; -1 where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return [-1, -1]
    return [status.st_size, status.st_mtime_ns]


def one_format(paths: Sequence[str]) -> StageJson:
    """Return options of ``writers.las`` for the points of all inputs; empty for LAS of one form.

    The finest scale of each axis with its offset, and the first format of LAS 1.4 with all colors
    of the inputs: PDAL only forwards what all inputs of a tile share, and otherwise uses scales of
    a centimeter and point format 3. Unreadable inputs are reported later.
    """
    headers = [header for path in paths if (header := las.header_there(path)) and header.count]
    options: StageJson = {}
    formats = {header.point_format for header in headers}
    if len(formats) > 1:
        colored = 8 if 8 in formats else 7 if formats & {2, 3, 7} else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    for axis, name in enumerate("xyz"):
        along = {(header.scales[axis], header.offsets[axis]) for header in headers}
        if len(along) > 1:
            scale, offset = min(along, key=lambda place: (place[0], -abs(place[1])))
            # Of newer PDAL "auto" is the tile's middle, off the grid of the coordinates: only for
            # what lies too far apart.
            far = any(abs(other - offset) > 2**30 * scale for _, other in along)
            options |= {f"scale_{name}": scale, f"offset_{name}": "auto" if far else offset}
    return options
