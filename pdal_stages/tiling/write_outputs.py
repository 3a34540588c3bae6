"""Write outputs: copies of inputs with the results of tiles, or what stages make of these."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from ..base.json_types import StageJson
from ..base.las import pdal_type
from ..base.las_check import check_complete
from ..base.las_copy import LasCopy
from ..base.las_points import Layout, read_records
from ..pipeline.copies import copy_of, named_types
from ..pipeline.inputs_outputs import LAS_WRITERS
from ..pipeline.run import execute_whole
from ..stages.points import class_counts
from .inputs import InputSource
from .jobs import load_arrays
from .options import MOST_AT_ONCE
from .plan import TilePlan
from .records import OutputRecord, describe_written
from .sorted_points import Piece

# ---- results of tiles ----------------------------------------------------------------------------


@dataclass
class PieceResults:
    """Results of a tile's own points of one piece."""

    piece: Piece
    rows: NDArray[np.int64]  #: (n,) rows of the piece that remain, ascending
    values: dict[str, NDArray]  #: (n,) new values of dimensions


#: Records (n,) of an input that are written, and new values (n,) of their dimensions.
Part = tuple[NDArray, Mapping[str, NDArray]]


def arrays_of(results: Iterable[PieceResults]) -> dict[str, NDArray]:
    """Return the results of a tile as arrays to be saved.

    Each input has one record array (n,) under its key: the ``index`` of each point in the input,
    ascending, and the new values ``dim/NAME``. ``own`` holds the keys with the number of points in
    the tile, dropped ones included.
    """
    content: dict[str, NDArray] = {}
    counts: list[tuple[str, int]] = []
    for result in results:
        piece = result.piece
        if not len(piece.own_rows):
            continue
        columns = {f"dim/{name}": values for name, values in result.values.items()}
        columns = {"index": piece.index[result.rows], **columns}
        records = np.empty(len(result.rows), [(name, c.dtype) for name, c in columns.items()])
        for name, column in columns.items():
            records[name] = column
        content[piece.source.key] = records
        counts.append((piece.source.key, len(piece.own_rows)))
    return {**content, "own": np.array(counts, [("key", "<U12"), ("count", "<i8")])}


def read_results(
    tiles: Iterable[str], source: InputSource, count: int, start: int, end: int
) -> tuple[NDArray[np.bool_], dict[str, NDArray]]:
    """Return which of the points `start` to `end` of a file remain (n,), and their new values (n,).

    They are in the files of its tiles. StageError where these do not contain each of the file's
    points once.
    """
    kept = np.zeros(end - start, bool)
    seen = 0
    values: dict[str, NDArray] = {}
    for path in tiles:
        arrays = load_arrays(path, [source.key, "own"])
        if source.key not in arrays:
            continue
        points, index = arrays[source.key], arrays[source.key]["index"]
        seen += dict(arrays["own"].tolist())[source.key]
        first, last = np.searchsorted(index, (start, end))
        rows = index[first:last] - start
        kept[rows] = True
        for column in list(points.dtype.fields or ())[1:]:
            name = column.removeprefix("dim/")
            if name not in values:
                values[name] = np.zeros(end - start, points[column].dtype)
            values[name][rows] = points[column][first:last]
    if seen != count:
        raise StageError(
            "the tiles do not hold all points of the file",
            where=source.path,
            found=f"{seen:,} of {count:,} points. Run it again without --resume",
        )
    return kept, values


def result_types(tiles: Iterable[str], source: InputSource) -> dict[str, np.dtype]:
    """Return the types of the dimensions that tiles have new values of, for points of a file."""
    for path in tiles:
        points = load_arrays(path, [source.key]).get(source.key)
        if points is not None:
            names = (points.dtype.names or ())[1:]
            return {name.removeprefix("dim/"): points.dtype[name] for name in names}
    return {}


# ---- copies with new values, and stages per output -----------------------------------------------


def run_tail(
    copies: Sequence[tuple[InputSource, LasCopy, Iterable[Part]]],
    plan: TilePlan,
    outputs: Sequence[str],
    scratch: str,
) -> OutputRecord:
    """Write copies of inputs, in one output or through the stages per output; return a record.

    Each input comes with its copy and the parts that are written into it. The `outputs` get their
    names once all are complete, and only while the run with the temporary folder `scratch` exists.
    """
    classes: Counter[str] = Counter()

    def write(copy: LasCopy, target: Path, parts: Iterable[Part]) -> None:
        with copy.writing_to(target):
            for records, values in parts:
                copy.write(records, values)
                if "Classification" in values:
                    classes.update(class_counts(values["Classification"]))

    def check() -> None:
        if not Path(scratch).is_dir():  # the run was killed, and another one may be writing here
            raise StageError("the run that this belonged to has ended", found=scratch)

    def complete(partial: Path, final: Path, number: int) -> None:
        check_complete(partial, final, plan.writers[0], copies[0][1].count)
        check()

    if plan.copied:
        with whole_files(*outputs, check=complete) as (partial,):
            write(copies[0][1], partial, copies[0][2])
        return OutputRecord(describe_written(outputs), copies[0][1].count, classes)
    with TemporaryDirectory(dir=scratch, ignore_cleanup_errors=True) as folder:
        stages: list[StageJson] = []
        listed: dict[str, str] = {}
        for number, (source, copy, parts) in enumerate(copies):
            path = Path(folder) / f"{number}.las"
            write(copy, path, parts)
            stages.append({**source.reader_of_copy, "filename": str(path), "tag": f"in{number}"})
            listed |= named_types(Layout.of_file(path))
        stages.append({"type": "filters.merge", "inputs": [stage["tag"] for stage in stages]})
        dimensions = ",".join(f"{name}={kind}" for name, kind in listed.items())
        for stage in plan.per_output:
            plain = {name: value for name, value in stage.items() if name != "inputs"}
            named = plan.extra_dims is not None and stage["type"] in LAS_WRITERS and dimensions
            stages.append({"extra_dims": dimensions, **plain} if named else plain)
        run, _ = execute_whole(stages, outputs, check, arrays=False)
    return OutputRecord(describe_written(outputs), run.count, classes)


def plan_copy(
    plan: TilePlan, source: InputSource, layout: Layout, target: str, types: Mapping[str, np.dtype]
) -> LasCopy:
    """Return a copy of an input with the dimensions of a plan; `types` are those of new values."""
    added = dict(plan.makes if plan.extra_dims is None else plan.extra_dims)
    if plan.creates is None:  # PDAL's filters may have made others, in between
        others = {n: pdal_type(kind) for n, kind in types.items() if n not in layout.fields}
        added = others | added
    added.pop("Classification", None)
    return copy_of(source.path, layout, target, added, source.reader)


# ---- an output for each input file ---------------------------------------------------------------


def write_file(
    plan: TilePlan, source: InputSource, results: list[str], outputs: list[str], scratch: str
) -> OutputRecord:
    """Write the outputs of a file from the results of its tiles; return the record."""
    assert source.index is not None
    count, layout = source.index.count, source.layout

    def parts() -> Iterator[Part]:
        for start in range(0, count, MOST_AT_ONCE):
            end = min(count, start + MOST_AT_ONCE)
            (kept, values), at = read_results(results, source, count, start, end), 0
            for records in read_records(source.path, layout, start, end):
                inside = np.flatnonzero(kept[at : at + len(records)])
                new = {name: column[at + inside] for name, column in values.items()}
                yield records[inside], new
                at += len(records)

    types = result_types(results, source)
    copy = plan_copy(plan, source, layout, outputs[0] if plan.copied else ".las", types)
    return run_tail([(source, copy, parts())], plan, outputs, scratch)


def write_tile(
    results: list[PieceResults], plan: TilePlan, outputs: list[str], scratch: str
) -> OutputRecord:
    """Write the points of a tile, from the files that were cut for it; return the record."""
    copies = []
    for piece, rows, values in ((r.piece, r.rows, r.values) for r in results):
        if piece.own_rows.size:  # only the tile's own points remain
            types = {name: column.dtype for name, column in values.items()}
            copy = plan_copy(plan, piece.source, piece.layout, ".las", types)
            copies.append((piece.source, copy, [(piece.records[rows], values)]))
    return run_tail(copies, plan, outputs, scratch) if copies else OutputRecord([])
