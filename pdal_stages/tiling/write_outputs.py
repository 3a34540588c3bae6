"""Write outputs: read points again, set the results of tiles, run the tail with its writers."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import las
from ..base.asprs import LEGACY_LIMIT
from ..base.errors import StageError
from ..base.files import whole_files
from ..base.las_check import check_complete
from ..pipeline import las_files
from ..pipeline import pdal as pdal_env
from ..pipeline.inputs_outputs import LAS_WRITERS
from ..pipeline.las_files import laspy_header, read_chunks
from ..pipeline.run import execute_whole
from ..pipeline.runtime import Callbacks
from ..stages.points import class_counts
from .inputs import InputSource
from .jobs import load_arrays, written
from .options import MOST_AT_ONCE
from .plan import TilePlan
from .sorted_points import BLOCK, Piece, write_records

#: PDAL's type names that are not NumPy's plus ``_t``.
_FLOATS = {"float64": "double", "float32": "float"}


# ---- results of tiles ----------------------------------------------------------------------------


@dataclass
class PieceResults:
    """Results of a tile's own points of one piece."""

    piece: Piece
    rows: NDArray[np.int64]  #: (n,) rows of the piece that remain, ascending
    values: dict[str, NDArray]  #: (n,) new values of dimensions


@dataclass(frozen=True)
class NewValues:
    """New values for points that are read again, in their order."""

    kept: NDArray[np.bool_]  #: (n,) which of the points remain
    #: New values of dimensions and the rows they belong to; None for all.
    values: Mapping[str, tuple[NDArray[np.int64] | None, NDArray]]


def flags_in_classes(path: str) -> bool:
    """Return whether this PDAL reads the flags of a file (LAS 1.0-1.3) as bits of the class."""
    return not pdal_env.splits_class_flags() and las.holds_flags(path)


def changed_in(
    name: str,
    read: NDArray,
    rows: NDArray[np.int64] | None,
    values: NDArray,
    holds_flags: bool,
) -> NDArray:
    """Return a dimension (n,) with new values in some or all rows; keep flags in the class."""
    out = np.array(read)
    out[slice(None) if rows is None else rows] = values
    if name == "Classification" and holds_flags:
        out |= read & ~np.uint8(LEGACY_LIMIT)
    return out


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
) -> NewValues:
    """Return the results of points `start` to `end` of a file, from the files of its tiles.

    StageError where these do not contain each of the file's points once.
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
        for field in list(points.dtype.fields or ())[1:]:
            name = field.removeprefix("dim/")
            if name not in values:
                values[name] = np.zeros(end - start, points[field].dtype)
            values[name][rows] = points[field][first:last]
    if seen != count:
        raise StageError(
            "the tiles do not hold all points of the file",
            where=source.path,
            found=f"{seen:,} of {count:,} points. Run it again without --resume",
        )
    return NewValues(kept, {name: (None, column) for name, column in values.items()})


# ---- the tail ------------------------------------------------------------------------------------


def run_tail(
    readers: list[dict[str, Any]],
    new: list[NewValues],
    tail: list[dict[str, Any]],
    outputs: Sequence[str],
    scratch: str,
    sources: Sequence[str],
) -> dict[str, Any]:
    """Run readers, their new values, and the tail with its writers; return a record.

    The readers read `sources`, or parts of them. The `outputs` get their names once all are
    complete, and only while the run with the temporary folder `scratch` exists.
    """

    def check() -> None:
        if not Path(scratch).is_dir():  # the run was killed, and another one may be writing here
            raise StageError("the run that this belonged to has ended", found=scratch)

    flags = las_files.files_with_flags_to_split([*readers, *tail])
    callbacks = Callbacks()
    stages, last = read_with(callbacks, readers, new, flags)
    stages.append({"type": "filters.merge", "inputs": [last]})
    stages += [{k: v for k, v in stage.items() if k != "inputs"} for stage in tail]
    run, _ = execute_whole(stages, outputs, sources, check, arrays=False)
    return {"outputs": written(outputs), "written": run.count}


def read_with(
    callbacks: Callbacks, readers: list[dict[str, Any]], new: list[NewValues], flags: Sequence[bool]
) -> tuple[list[dict[str, Any]], str]:
    """Return stages that read points and set new values, and the tag of the last one.

    The points of each reader stay a view of their own, in the order of the readers. One filter sets
    the values of all: the time PDAL needs grows with the third power of the number of filters that
    add dimensions. `flags`: of each reader, whether flags must be split from the class (old PDAL);
    empty for none.
    """
    stages: list[dict[str, Any]] = []
    last = []
    for number, reader in enumerate(readers):
        stages.append({**reader, "tag": f"in{number}"})
        if flags and flags[number]:
            splitter = las_files.flag_splitter([True], inputs=[f"in{number}"], tag=f"split{number}")
            stages.append(splitter)
        last.append(stages[-1]["tag"])
    stages += _put(callbacks, new, last, [flags_in_classes(each["filename"]) for each in readers])
    return stages, stages[-1]["tag"]


def _put(
    callbacks: Callbacks, new: Sequence[NewValues], inputs: list[str], holds_flags: list[bool]
) -> Iterator[dict[str, Any]]:
    """Yield filters that set new values of points, and drop some: PDAL needs two filters.

    PDAL calls each for the points of one reader after the other.
    """
    to_put, to_drop = zip(new, holds_flags, strict=True), iter(new)

    def put(module, ins, outs) -> None:
        part, has_flags = next(to_put)
        if len(ins["X"]) != len(part.kept):
            raise StageError(f"a reader gave {len(ins['X']):,} points of {len(part.kept):,}")
        for name, (rows, values) in part.values.items():
            outs[name] = changed_in(name, ins[name], rows, values, has_flags)

    def drop(module, ins, outs) -> None:
        outs["Mask"] = np.ascontiguousarray(next(to_drop).kept, bool)

    types = {name: v.dtype.name for part in new for name, (_, v) in part.values.items()}
    adds = {name: _FLOATS.get(kind, f"{kind}_t") for name, kind in types.items()}
    yield callbacks.filter(put, adds, inputs=inputs, tag="put")
    if not all(part.kept.all() for part in new):
        yield callbacks.filter(drop, inputs=["put"], tag="left")


def with_dimensions(
    tail: list[dict[str, Any]], extra_dims: Mapping[str, str] | None, paths: list[str]
) -> list[dict[str, Any]]:
    """Return a tail whose LAS writers list extra dimensions: the inputs' and `extra_dims`."""
    listed = "" if extra_dims is None else las_files.extra_dims_option(paths, extra_dims)
    return [
        {"extra_dims": listed, **stage} if listed and stage["type"] in LAS_WRITERS else stage
        for stage in tail
    ]


# ---- an output for each input file ---------------------------------------------------------------


def write_file(
    plan: TilePlan,
    source: InputSource,
    results: list[str],
    outputs: list[str],
    scratch: str,
) -> dict[str, Any]:
    """Write a file's outputs from the results of its tiles; return the record with class counts."""
    assert source.index is not None
    count = source.index.count
    tail = with_dimensions(plan.tail, plan.extra_dims, [source.path])
    writer, names = plan.writers[0], [Path(path).suffix.lower() for path in outputs]
    plain = writer["type"] == "writers.las" and "auto" not in map(str, writer.values())
    if (
        count > MOST_AT_ONCE and plain and names in ([".las"], [".laz"])
    ):  # all parts have the same header
        return _in_parts(source, count, results, tail, outputs, scratch)
    new = read_results(results, source, count, 0, count)
    if not count:  # no tile has results, so the dimensions come from the plan
        types = plan.makes.items()
        new = NewValues(
            new.kept, {name: (None, np.empty(0, las.number_type(kind))) for name, kind in types}
        )
    reader = {**source.reader, "filename": source.path}
    return run_tail([reader], [new], tail, outputs, scratch, [source.path]) | {
        "classes": _classes(new)
    }


def _in_parts(
    source: InputSource,
    points: int,
    results: list[str],
    tail: list[dict[str, Any]],
    outputs: list[str],
    scratch: str,
) -> dict[str, Any]:
    """Run the tail on each part of a file, and join the results under the first one's header."""
    import laspy

    classes: Counter[str] = Counter()
    out: Any = None
    count = 0
    tail = [{k: v for k, v in stage.items() if k != "compression"} for stage in tail]

    def check(partial: Path, final: Path, number: int) -> None:
        check_complete(partial, final, {"type": "writers.las", "filename": final}, count)

    with whole_files(*outputs, check=check) as (partial,), contextlib.ExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory(dir=scratch, ignore_cleanup_errors=True))
        piece, part = (os.path.join(folder, name) for name in ("part.las", "out.las"))
        for start in range(0, points, MOST_AT_ONCE):
            end = min(points, start + MOST_AT_ONCE)
            chunks = read_chunks(source.path, start, end, BLOCK)
            write_records(piece, laspy_header(source.path), (points.array for points in chunks))
            new = read_results(results, source, points, start, end)
            reader = {**source.reader, "filename": piece}
            run_tail([reader], [new], tail, [part], scratch, [source.path])
            classes.update(_classes(new))
            with laspy.open(part) as points_of_part:
                if out is None:
                    how = {
                        "header": points_of_part.header,
                        "do_compress": partial.suffix.lower() == ".laz",
                    }
                    out = stack.enter_context(laspy.open(partial, mode="w", **how))
                for chunk in points_of_part.chunk_iterator(BLOCK):
                    out.write_points(chunk)
                count += int(points_of_part.header.point_count)
        if out.header.evlrs:
            out.write_evlrs(out.header.evlrs)
    return {"outputs": written(outputs), "written": count, "classes": dict(classes)}


def _classes(new: NewValues) -> dict[str, int]:
    _, codes = new.values.get("Classification", (None, np.zeros(len(new.kept), np.uint8)))
    return class_counts(codes[new.kept]) if "Classification" in new.values else {}


def write_tile(
    results: list[PieceResults], plan: TilePlan, outputs: list[str], scratch: str
) -> dict[str, Any]:
    """Write the points of a tile, from the files that were cut for it; return the record."""
    results = [result for result in results if result.piece.own_rows.size]
    if not results:
        return {"outputs": []}
    sources = [result.piece.source.path for result in results]
    tail = with_dimensions(plan.tail, plan.extra_dims, sources)
    readers = [{**result.piece.reader, "filename": result.piece.path} for result in results]
    new = []
    for result in results:  # only the tile's own points remain
        kept = np.zeros(len(result.piece.index), bool)
        kept[result.rows] = True
        values = {name: (result.rows, column) for name, column in result.values.items()}
        new.append(NewValues(kept, values))
    return run_tail(readers, new, tail, outputs, scratch, sources)
