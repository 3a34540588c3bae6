"""The command ``pdal-stages objects``: classified files in, one vector file out, objects across their borders whole.

Each file is read once into records of cells, which are kept until the end for ``--resume``; then objects are found in all.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..base import kinds
from ..base.errors import OptionError, StageError
from ..base.files import write_whole
from ..base.outputs import Output, check_outputs
from ..base.plain import print_messages
from ..base.progress import Progress
from ..base.stamps import stamp
from ..base.units import Units
from ..base.version import __version__
from ..objects import Cells, Objects, ObjectSettings, find_objects
from ..objects.cells import refuse_unclassified
from ..pipeline import pdal as pdal_env
from ..pipeline.inputs_outputs import input_files, outputs_of, overlooked
from ..pipeline.overrides import Override
from ..pipeline.parts import reads_in_parts, reference_and_wkt
from ..pipeline.references import check_one_reference, without_reference
from ..pipeline.workers import each_file
from ..reports.objectlayers import check_target, object_layers, target_files, write_layers
from ..stages.objectswriter import STRAIGHT, ObjectsWriter
from .pieces import open_las, read_block
from .report import FoundObjects
from .store import fingerprint, take_lock

if TYPE_CHECKING:
    from .classify import ClassifyTask

#: Whose options the commands take for objects.
OPTIONS_OF = ("writers.objects", "filters.objects")
#: What is read of LAZ 1.4 (see :func:`open_las`).
_ONLY = ("Z", "CLASSIFICATION", "FLAGS", "ALL_EXTRA_BYTES")
#: Points read at a time.
_AT_ONCE = 1_000_000
#: Larger cells are not taken by themselves: they tell no house from the next.
LARGEST = 4.0


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the flags to the parser of ``objects``."""
    takes = command.add_argument
    takes("inputs", nargs="+", metavar="input", help="Classified files PDAL can read, folders, patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes("--outlines", choices=("straight", "cells"), help="Outlines along walls (default) or along cells")
    takes(
        "--cell", type=float, metavar="METERS",
        help="Side of the grid's cells (0.5, where points are fewer than 4 or so per m2 1, 2 or 4)",
    )  # fmt: skip
    takes("--workers", type=int, default=1, metavar="N", help="Files read at the same time (1)")
    takes("--resume", action="store_true", help="Keep what an earlier run read")
    takes("--metadata", metavar="FILE", help="Write counts, verdicts and settings to a JSON file")


def run_command(options: argparse.Namespace) -> int:
    """Run ``pdal-stages objects``; the exit code."""
    given = {name: value for name in ("outlines", "cell") if (value := getattr(options, name)) is not None}
    stage = writer(options.output, options.overrides, **given)
    check_target(options.output)
    inputs = input_files(options.inputs)
    print_messages(*overlooked(options.inputs))
    more = [Output(options.metadata, "metadata", kinds.JSON)] if options.metadata else []
    check_outputs(
        [*(Output(str(file), "objects") for file in target_files(options.output)), *more],
        [*inputs, *options.inputs],
    )
    _write(inputs, stage, options.workers, options.resume, options.metadata)
    return 0


def refuse_tiles(task: ClassifyTask, output: str) -> None:
    """Refuse, before any work, what ``classify --objects`` cannot do."""
    check_target(output)
    if task.options.per == "tile" or not all(map(reads_in_parts, task.files)):
        raise OptionError(
            "classify --objects needs an output for each LAS or LAZ input",
            cure="Classify first, then: pdal-stages objects OUTPUT town.gpkg",
        )
    check_outputs([Output(output, "objects")], task.files)


def objects_of_outputs(task: ClassifyTask, stage: ObjectsWriter) -> FoundObjects:
    """What ``classify --objects`` does when all is classified."""
    workers = max(1, task.options.local_workers)
    return _write(outputs_of(task.files, task.output), stage, workers, resume=True, draw=True)


def _write(
    inputs: list[str],
    stage: ObjectsWriter,
    workers: int = 1,
    resume: bool = False,
    metadata: str | None = None,
    draw: bool = False,
) -> FoundObjects:
    """Find objects, write them, say what was found; `draw`: also a map."""
    check_target(stage.filename)
    with _own(stage.filename) as kept:
        found, reference = _objects_of_files(inputs, stage, kept, workers, resume)
        found, refused = found.without(stage.refuse)
        layers = object_layers(found, straight=stage.outlines == STRAIGHT, units=reference[0])
        files = [str(file) for file in write_layers(stage.filename, layers, reference[1])]
        shutil.rmtree(kept, ignore_errors=True)
    summary = found.summary()
    for kind, one in summary.items():
        word = kind if one["objects"] != 1 else kind.removesuffix("s")
        print(f"{one['objects']:,} {word}, {one['to_be_checked']:,} to be checked")
        for reason, count in one["reasons"].items():
            print(f"  {reason:28s} {count:>10,}")
    if stage.refuse:
        print(f"{refused:,} left out (refuse: {', '.join(stage.refuse)})")
    print("written to " + ", ".join(files))
    if metadata:
        about = {
            "version": __version__,
            "inputs": inputs,
            "files": files,
            "settings": {one.name: getattr(found.settings, one.name) for one in fields(ObjectSettings)},
            "objects": summary,
            "refused": {"reasons": list(stage.refuse), "objects": refused},
        }
        write_whole(metadata, (json.dumps(about, indent=1) + "\n").encode(), "metadata")
    picture = None
    if draw:
        from ..reports.objectmap import object_map

        picture = object_map(layers)
    return FoundObjects(files, summary, picture)


def writer(output: str, overrides: Sequence[Override] = (), **given: Any) -> ObjectsWriter:
    """The stage whose options the command follows: those of ``--writers.objects.NAME=``, or ``--filters.objects.NAME=``."""
    for one in overrides:
        if one.by_tag or one.selector not in OPTIONS_OF:
            raise OptionError(
                "objects takes options of writers.objects and filters.objects alone", found=one.flag
            )
        given[one.option] = one.value
    stage = ObjectsWriter({**given, "filename": output})
    stage.widens = "cell" not in given
    return stage


def _objects_of_files(
    inputs: Sequence[str], stage: ObjectsWriter, folder: Path, workers: int, resume: bool
) -> tuple[Objects, tuple[Units, str]]:
    """The objects of all files together; units of the coordinates and their reference (WKT)."""
    references = {path: reference_and_wkt(path, stage.horizontal_unit) for path in inputs}
    without = check_one_reference({path: one for path, (one, _) in references.items()})
    print_messages(*without_reference(without))
    units, wkt = references[inputs[0]][0].units, references[inputs[0]][1]
    if not resume:
        for file in folder.glob("*.npz"):
            file.unlink()
    cells = _all_cells(inputs, stage, wkt, folder, workers)
    size, thin = cells.size, cells.thin()
    while stage.widens and cells.thin() and cells.size < LARGEST:
        stage, cells = stage.with_cell(2 * cells.size), cells.doubled()
    if thin:
        too_few = f"cells of {size:g} m hold {thin[1]:.1f} points of {thin[0]} on average"
        print_messages(
            f"{too_few}, so cells of {cells.size:g} m are taken; --cell {size:g} keeps to them"
            if stage.widens
            else f"{too_few}, so objects may fall apart: try --cell {2 * size:g}"
        )
    return find_objects(cells, stage.settings), (units, wkt)


def _all_cells(inputs: Sequence[str], stage: ObjectsWriter, wkt: str, folder: Path, workers: int) -> Cells:
    """The records of all files; each file's are kept in a file of their own, another one when anything is another."""
    work = []
    for path in inputs:
        mark = fingerprint(__version__, stage.options, str(Path(path).resolve()), stamp(path))
        work.append((path, stage, wkt, str(folder / f"{mark}.npz")))
    failed = []
    with Progress(len(inputs), "reading", "files") as line:
        for _, answer in each_file(_keep_cells, work, workers):
            failed += [answer.reason] if answer.reason else []
            line.update()
    if failed:
        raise StageError(
            f"{len(failed)} of {len(inputs)} inputs cannot be read",
            found="; ".join(failed[:3]),
            cure="Once they can be read, --resume reads these alone",
        )
    parts: list[Cells] = []
    seen = np.zeros(256, np.int64)
    for *_, kept in work:
        with np.load(kept) as held:
            columns = {name: held[name] for name in held.files}
        seen += columns.pop("seen")
        parts.append(Cells(stage.settings.cell, columns.pop("key"), columns))
        if len(parts) == 32:  # so that overlapping files are not held apart
            parts = [Cells.join(parts)]
    cells = Cells.join(parts)
    try:
        refuse_unclassified(cells, np.flatnonzero(seen).astype(np.uint8))
    except StageError:  # nothing to go on with
        for *_, kept in work:
            Path(kept).unlink(missing_ok=True)
        raise
    return cells


def _keep_cells(path: str, stage: ObjectsWriter, wkt: str, kept: str) -> None:
    """Read a file's records and keep them in a file, with the points of each class code."""
    target = Path(kept)
    if target.exists():
        return
    seen = np.zeros(256, np.int64)
    parts = [Cells(stage.settings.cell)]
    for arrays in _points_of(path):
        points = stage.points(arrays, wkt=wkt)
        seen += np.bincount(points.class_codes, minlength=256)
        parts = [Cells.join([*parts, stage.records(points)])]
    partial = target.with_name(f"partial-{target.name}")
    np.savez(partial, key=parts[0].key, seen=seen, **parts[0].columns)  # type: ignore[arg-type]
    partial.replace(target)


def _points_of(path: str) -> Iterator[dict[str, NDArray]]:
    """The dimensions that objects read, a part of a LAS or LAZ file at a time; of others all, by PDAL."""
    if not reads_in_parts(path):
        for points in pdal_env.execute([{"filename": path}]).arrays:
            yield {name: np.asarray(points[name]) for name in points.dtype.names}
        return
    with open_las(path, _ONLY) as reader:
        total = reader.header.point_count
        extra = {"Reliability"} & set(reader.header.point_format.extra_dimension_names)
        named = {"X": "x", "Y": "y", "Z": "z", "Classification": "classification", "Withheld": "withheld"}
        for start in range(0, total, _AT_ONCE):
            points = read_block(reader, path, start, total, _AT_ONCE)
            yield {name: np.asarray(points[at]) for name, at in (named | {n: n for n in extra}).items()}


def _kept(output: str) -> Path:
    """The folder in which a run keeps what it read."""
    path = Path(output).absolute()
    return path.with_name(f".{path.name}.cells")


@contextmanager
def _own(output: str) -> Iterator[Path]:
    """The folder in which a run keeps what it read, for one run at a time."""
    folder = _kept(output)
    lock = take_lock(folder, "another run is writing these objects", "Wait for it, or name another output")
    try:
        yield folder
    finally:
        if not any(folder.glob("*.npz")):
            shutil.rmtree(folder, ignore_errors=True)
        lock.close()
