"""A LAS file through stages of ours into another, without PDAL's table of all its points.

The table takes 78 bytes a point, and half as many again while Python has copies of it. So PDAL runs the pipeline on the
file's first points, with numbers in place of what the stages make: what it reads and writes is how all points are read
(:mod:`.straight`) and written here. The file that it wrote must be the one that is written here, byte for byte;
otherwise, and for whatever else takes PDAL, it is PDAL that runs.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.extrabytes import number_type
from ..base.las import LasHeader, read_header
from ..base.lasrecords import DamagedError, RecordColumns, blocks, record_type
from . import interrupts, packing, straight
from . import pdal as pdal_env
from .callbacks import Callbacks
from .filenames import reader_files
from .likefile import Extra, LikeFile, Some
from .runtime import TRAMPOLINE
from .straight import FirstSeen, NeedsPdal, View

#: Options of a writer that do not look at points.
_PLAIN = {
    *(
        "type",
        "tag",
        "filename",
        "forward",
        "extra_dims",
        "compression",
        "minor_version",
        "dataformat_id",
        "a_srs",
    ),
    *(
        "system_id",
        "software_id",
        "creation_doy",
        "creation_year",
        "filesource_id",
        "global_encoding",
        "project_id",
    ),
}
#: Points on which PDAL is tried.
_TRIED = 256
#: Fields that most stages look at.
_FIELDS = ("X", "Y", "Z", "bit_fields", "classification_flags", "classification", "raw_classification")


def may_run(stages: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a lowered pipeline may be run so, as far as its stages tell: a reader, stages of ours, a writer."""
    if len(stages) < 3:
        return False
    reader, *filters, writer = stages
    target = str(writer.get("filename", ""))
    return (
        reader.get("type") == "readers.las"
        and straight.may_run([reader])
        and reader_files(dict(reader), las=True) == [reader.get("filename")]
        and writer.get("type") == "writers.las"
        and set(writer) <= _PLAIN
        and "#" not in target
        and target.lower().endswith((".las", ".laz"))
        and all(_is_ours(stage) for stage in filters)
    )


def _is_ours(stage: Mapping[str, Any]) -> bool:
    known = stage.get("source") == TRAMPOLINE or str(stage.get("module", "")).startswith(
        "pdal_stages_callback_"
    )
    return (
        stage.get("type") == "filters.python"
        and known
        and not {"inputs", "where", "user_data", "log"} & set(stage)
    )


def execute(stages: Sequence[dict[str, Any]]) -> pdal_env.Execution:
    """Run such a pipeline.

    Raises
    ------
    NeedsPdal
        Where it takes PDAL.
    StageError
        Of a stage, or where the output cannot be written.
    """
    reader, *filters, _ = stages
    path = str(reader["filename"])
    header, dtype, tried = _tried(stages)
    try:
        columns = RecordColumns(path, header, dtype, [n for n in _FIELDS if n in (dtype.names or ())])
    except DamagedError:
        raise  # newer PDAL takes them for points
    except (StageError, OSError) as error:
        raise NeedsPdal(str(error)) from error
    view = View.of_file(tried.reading, columns)
    for name, kind in _added(filters).items():  # PDAL's points have them from the beginning
        view.add(name, kind)
    tag = reader.get("tag", "input")
    straight.execute([{**reader, "tag": tag}, *filters], {tag: view})
    if others := view.changed & tried.reading.types.keys() - tried.output.holds:
        raise NeedsPdal(f"what is written to {', '.join(others)}")
    made = {name: view[name] for name in view.changed & tried.output.holds}
    del view, columns

    def points() -> Iterator[Some]:
        start, parts = 0, blocks(path, header, dtype)
        while start < header.count:
            interrupts.check()
            try:
                records = next(parts)
            except DamagedError:
                raise
            except StageError as error:
                raise NeedsPdal(str(error)) from error
            end = start + len(records)
            yield _some(records, {name: values[start:end] for name, values in made.items()})
            start = end

    try:
        with open(tried.target, "x+b") as out:
            tried.output.write(out, points(), tried.given)
    except NeedsPdal:
        os.unlink(tried.target)
        raise
    return pdal_env.Execution(header.count, tried.metadata, [], tried.reading.log)


def goes(stages: Sequence[dict[str, Any]]) -> bool:
    """Whether such a pipeline is run so, as far as PDAL tells on the first points."""
    try:
        _tried(stages)
    except NeedsPdal:
        return False
    return True


def _tried(stages: Sequence[dict[str, Any]]) -> tuple[LasHeader, np.dtype, _Trial]:
    """The file and its records, and what PDAL made of the first of them; NeedsPdal where it takes PDAL."""
    reader, *filters, writer = stages
    path = str(reader["filename"])
    header = read_header(path)
    dtype = record_type(path, header) if header is not None else None
    if header is None or dtype is None or not 0 < header.count < 2**32 or not _comes_back(header):
        raise NeedsPdal("the file")
    try:
        (first,) = blocks(path, header, dtype, count=_TRIED)
        return header, dtype, _Trial(reader, writer, header, first, _added(filters))
    except (NeedsPdal, DamagedError):
        raise
    except (StageError, OSError) as error:  # no room for temporary files, say
        raise NeedsPdal(str(error)) from error


def _added(filters: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Dimensions that filters make, and their types."""
    return dict(one.split("=") for stage in filters for one in stage.get("add_dimension", ()))


def _comes_back(header: LasHeader) -> bool:
    """Whether coordinates that were scaled to floats and back are the whole numbers that they were."""
    for scale, offset in zip(header.scales, header.offsets, strict=True):
        if (2.0**31 * abs(scale) + abs(offset)) * 2.0**-50 > 0.25 * abs(scale):
            return False
    return True


class _Trial:
    """The pipeline's ends run by PDAL on the first points of a file."""

    def __init__(
        self,
        reader: dict[str, Any],
        writer: dict[str, Any],
        header: LasHeader,
        first: NDArray,
        adds: Mapping[str, str],
    ) -> None:
        seen = FirstSeen()
        made: dict[str, NDArray] = {}

        def look(module: dict[str, Any], ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
            seen.look(module, ins, outs)
            for number, name in enumerate(adds):
                values = np.arange(len(ins[name])) * (number + 3) % 101 % 32
                made[name] = outs[name] = np.ascontiguousarray(values, ins[name].dtype)

        with TemporaryDirectory(prefix="pdal-stages-") as folder, Callbacks() as called:
            target = tried = os.path.join(folder, os.path.basename(str(writer["filename"])))
            run = [{**reader, "count": len(first)}, called.filter(look, adds), {**writer, "filename": target}]
            ran = pdal_env.execute(run, arrays=False)
            self.reading = seen.reading(first, str(reader["filename"]), ran.log, adds)
            self.output, self.given = _output(target, header, first.dtype, adds, self.reading)
            if others := adds.keys() & self.reading.types.keys() - self.output.holds:
                raise NeedsPdal(f"what is written to {', '.join(others)}")
            for packed in packing.pack([Path(target)]).values():
                target = packed
            made = {name: values for name, values in made.items() if name in self.output.holds}
            again = io.BytesIO()
            self.output.write(again, [_some(first, made)], self.given)
            if again.getvalue() != Path(target).read_bytes():
                raise NeedsPdal("other bytes")
        self.target = str(writer["filename"]).removesuffix(packing.UNPACKED)
        self.metadata = packing.renamed(ran.metadata, {tried: self.target})


def _output(
    path: str, header: LasHeader, dtype: np.dtype, adds: Mapping[str, str], reading: straight.Reading
) -> tuple[LikeFile, dict[str, Extra]]:
    """How PDAL wrote a file with points of a file that has `header` and records of a type, and what comes out of these."""
    like = LikeFile.of(path)
    if like is None:
        raise NeedsPdal("the output")
    there = like.header
    if (there.point_format, there.scales, there.offsets) != (
        header.point_format,
        header.scales,
        header.offsets,
    ):
        raise NeedsPdal("the output's points are others")
    given: dict[str, Extra] = {}
    for name, (_, same) in like.extra.items():
        known = name in adds and number_type(adds[name]) == same
        read = name in (dtype.names or ()) and name in reading.decoded and reading.types[name] == same
        if not known and not read:
            raise NeedsPdal(f"the dimension '{name}'")
        if read:
            given[name] = Extra(dtype.fields[name][1], same)  # type: ignore[index]
    return like, given


def _some(records: NDArray, made: Mapping[str, NDArray]) -> Some:
    raw = records.view(np.uint8).reshape(len(records), -1)
    return Some(raw, {name: (None, values) for name, values in made.items()})
