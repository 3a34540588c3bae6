"""Find objects in classified files, whole across file borders, and write one vector file.

Each file is read once into records of cells; then objects are found in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.distinct import DistinctPoints
from ..base.errors import OptionError
from ..base.files import JSON, Output, check_outputs, write_json
from ..base.json_types import JsonObject
from ..base.messages import one_line, print_messages
from ..base.units import Units
from ..base.version import __version__
from ..objects.cells import Cells, refuse_unclassified
from ..objects.detect import find_objects
from ..objects.results import Objects
from ..pipeline.distinct_files import DistinctFiles
from ..pipeline.expansion import stage_files
from ..pipeline.inputs_outputs import input_files
from ..pipeline.json_source import Override
from ..pipeline.point_files import read_columns
from ..pipeline.spatial_reference import check_one_reference, reference_of_file
from ..reports.object_layers import write_objects
from ..stages.write_objects import STRAIGHT, WriteObjects

#: Stages whose options the commands accept for objects.
OPTIONS_OF = ("writers.objects", "filters.objects")
#: Meters; cells are not enlarged beyond this automatically: neighboring houses would merge.
LARGEST_CELL = 4.0


def objects_of_files(
    names: Sequence[str], stage: WriteObjects, workers: int = 1, metadata: str | None = None
) -> JsonObject:
    """Find objects in classified files, write and print them; return the files, counts by kind."""
    inputs = input_files(names)
    more = [Output(metadata, "metadata", JSON)] if metadata else []
    check_outputs([*stage.outputs(), *more], [*inputs, *names, *stage_files(stage)])
    objects, units, wkt = _find_in_files(inputs, stage, workers)
    files = write_objects(stage.filename, objects, stage.outlines == STRAIGHT, units, wkt)["files"]
    summary = objects.summary()
    for kind, counts in summary.items():
        word = kind if counts["objects"] != 1 else kind.removesuffix("s")
        print(f"{counts['objects']:,} {word}, {counts['to_be_checked']:,} to be checked")
        for reason, count in counts["reasons"].items():
            print(f"  {reason:28s} {count:>10,}")
    print(one_line("written to " + ", ".join(files)))
    if metadata:
        about = {
            "version": __version__,
            "inputs": inputs,
            "files": files,
            "settings": asdict(objects.settings),
            "objects": summary,
        }
        write_json(metadata, about, "metadata")
    return {"files": files, **summary}


def objects_stage(output: str, overrides: Sequence[Override] = (), **options: Any) -> WriteObjects:
    """Return the stage with the options of the command, ``--writers.objects.NAME=VALUE``."""
    for override in overrides:
        if override.by_tag or override.selector not in OPTIONS_OF:
            raise OptionError(
                "objects takes only options of writers.objects and filters.objects",
                found=override.flag,
            )
        options[override.option] = override.value
    return WriteObjects({**options, "filename": output})


def _find_in_files(
    inputs: Sequence[str], stage: WriteObjects, workers: int
) -> tuple[Objects, Units, str]:
    """Return the objects of all files together, units of the coordinates, and reference (WKT)."""
    units = (stage.horizontal_unit, stage.vertical_unit)
    references = {path: reference_of_file(path, *units) for path in inputs}
    print_messages(*check_one_reference(references))
    wkt = references[inputs[0]].wkt
    cells = _all_cells(inputs, stage, wkt, workers)
    if sparse := cells.sparse_kind():
        size, is_set = cells.size, "cell" in stage.set_options
        while not is_set and cells.sparse_kind() and cells.size < LARGEST_CELL:
            cells = cells.doubled()
        print_messages(
            f"cells of {size:g} m hold {sparse[1]:.1f} points of {sparse[0]} on average, where "
            f"objects fall apart: cells of {cells.size:g} m are used, others with --cell"
        )
    objects = find_objects(cells, replace(stage.settings, cell=cells.size))
    return objects, references[inputs[0]].units, wkt


def _all_cells(inputs: Sequence[str], stage: WriteObjects, wkt: str, workers: int) -> Cells:
    """Return the cells of all files."""
    seen = np.zeros(256, np.int64)
    cells = Cells(stage.settings.cell)
    files = DistinctFiles(inputs)
    work = [(path, stage, wkt) for path in inputs]
    for part, codes in files.results(_cells_of, work, workers):
        cells = Cells.join([cells, part])
        seen += codes
    print_messages(*files.messages)
    refuse_unclassified(cells, np.flatnonzero(seen).astype(np.uint8))
    return cells


def _cells_of(
    path: str, stage: WriteObjects, wkt: str, distinct: DistinctPoints
) -> tuple[Cells, NDArray[np.int64]]:
    """Return the cells of a file, and its numbers of points (256,) by class code."""
    seen = np.zeros(256, np.int64)
    cells = Cells(stage.settings.cell)
    for columns, flags in read_columns(path, ("Reliability", "GpsTime")):
        first = distinct.first(columns)
        arrays = {name: values[first] for name, values in columns.items()}
        points = stage.points(arrays, wkt=wkt, legacy_flags=flags)
        seen += np.bincount(points.class_codes, minlength=256)
        cells = Cells.join([cells, stage.records(points)])
    return cells, seen
