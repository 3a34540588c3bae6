"""A LAS file through stages of ours into another, without PDAL's table of all its points.

The table takes 78 bytes a point, and half as many again while Python has copies of it. So PDAL runs the pipeline on the
file's first points, with numbers in place of what the stages make: what it reads and writes is how all points are read
(:mod:`.straight`) and written here. The file that it wrote must be the one that is written here, byte for byte;
otherwise, and for whatever else takes PDAL, it is PDAL that runs.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.extrabytes import plain_dimensions
from ..base.las import POINT_BYTES, LasHeader, laz_chunks, read_header
from ..base.lasrecords import RecordColumns, blocks, record_type
from . import interrupts, packing, straight
from . import pdal as pdal_env
from .callbacks import Callbacks
from .filenames import reader_files
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
    reader, *filters, writer = stages
    path = str(reader["filename"])
    header = read_header(path)
    dtype = record_type(path, header) if header is not None else None
    if header is None or dtype is None or not 0 < header.count < 2**32 or not _comes_back(header):
        raise NeedsPdal("the file")
    adds = dict(one.split("=") for stage in filters for one in stage.get("add_dimension", ()))
    try:
        (first,) = blocks(path, header, dtype, count=_TRIED)
        tried = _Trial(reader, writer, header, first, adds)
        columns = RecordColumns(path, header, dtype, [n for n in _FIELDS if n in (dtype.names or ())])
    except NeedsPdal:
        raise
    except (StageError, OSError) as error:  # no room for temporary files, say
        raise NeedsPdal(str(error)) from error
    view = View.of_file(tried.reading, columns)
    for name, kind in adds.items():  # PDAL's points have them from the beginning
        view.add(name, kind)
    tag = reader.get("tag", "input")
    straight.execute([{**reader, "tag": tag}, *filters], {tag: view})
    if others := view.changed & tried.reading.types.keys() - tried.output.holds:
        raise NeedsPdal(f"what is written to {', '.join(others)}")
    made = {name: view[name] for name in view.changed & tried.output.holds}
    del view, columns

    def points() -> Iterator[tuple[NDArray, dict[str, NDArray]]]:
        start, parts = 0, blocks(path, header, dtype)
        while start < header.count:
            interrupts.check()
            try:
                records = next(parts)
            except StageError as error:
                raise NeedsPdal(str(error)) from error
            end = start + len(records)
            yield records, {name: values[start:end] for name, values in made.items()}
            start = end

    try:
        tried.output.write(Path(tried.target), points())
    except NeedsPdal:
        os.unlink(tried.target)
        raise
    return pdal_env.Execution(header.count, tried.metadata, [], tried.reading.log)


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
            self.output = _output(target, header, first.dtype, adds, self.reading)
            if others := adds.keys() & self.reading.types.keys() - self.output.holds:
                raise NeedsPdal(f"what is written to {', '.join(others)}")
            for packed in packing.pack([Path(target)]).values():
                target = packed
            again = Path(folder, "again")
            self.output.write(again, [(first, made)])
            if again.read_bytes() != Path(target).read_bytes():
                raise NeedsPdal("other bytes")
        self.target = str(writer["filename"]).removesuffix(packing.UNPACKED)
        self.metadata = packing.renamed(ran.metadata, {tried: self.target})


@dataclass(frozen=True)
class _Output:
    """How a file is written."""

    head: bytes  #: all before its points; counts and box, where PDAL writes them, are those of other points
    header: LasHeader  #: as PDAL wrote it, before anybody compressed its points
    coding: Any  #: how lazrs compresses its points, None where they are not
    extra: list[tuple[str, np.dtype, bool]]  #: extra dimensions, and whether the input's records have them

    @property
    def holds(self) -> set[str]:
        """Dimensions that may have changed."""
        return {"Classification", *(name for name, *_ in self.extra)}

    def write(self, path: Path, points: Iterable[tuple[NDArray, Mapping[str, NDArray]]]) -> None:
        """Write a file of records and new values of dimensions, in parts."""
        totals = _Totals(self.header)
        with open(path, "x+b") as out:
            out.write(self.head)
            put, done = self._packer(out)
            for records, made in points:
                totals.add(records)
                put(self._records(records, made).view(np.uint8))
            done()
            end = out.seek(0, os.SEEK_END)
            out.seek(0)
            out.write(totals.put(self.head, end))

    def _packer(self, out: Any) -> tuple[Callable[[NDArray], Any], Callable[[], Any]]:
        if self.coding is None:
            return lambda raw: out.write(raw.data), lambda: None
        import lazrs

        packer = lazrs.ParLasZipCompressor(out, self.coding)

        def put(raw: NDArray) -> None:
            try:
                packer.compress_many(raw)
            except (ValueError, RuntimeError, lazrs.LazrsError) as error:
                raise StageError("the output file could not be compressed", found=error) from error

        def done() -> None:
            try:
                packer.done()
            except (ValueError, RuntimeError, lazrs.LazrsError) as error:
                raise StageError("the output file could not be compressed", found=error) from error

        return put, done

    def _records(self, records: NDArray, made: Mapping[str, NDArray]) -> NDArray:
        base = POINT_BYTES[self.header.point_format]
        dtype = np.dtype([("base", "V", base), *((name, kind) for name, kind, _ in self.extra)])
        out = np.empty(len(records), dtype)
        more = records.dtype.itemsize - base
        out["base"] = records.view([("base", "V", base), ("more", "V", more)])["base"]
        for name, _, _ in self.extra:
            out[name] = made[name] if name in made else records[name]
        if "Classification" in made:
            place = 16 if self.header.point_format >= 6 else 15
            out.view(np.uint8).reshape(len(out), -1)[:, place] = made["Classification"]
        return out


def _output(
    path: str, header: LasHeader, dtype: np.dtype, adds: Mapping[str, str], reading: straight.Reading
) -> _Output:
    """How PDAL wrote a file with points of a file that has `header` and records of a type."""
    there = read_header(path)
    extra = plain_dimensions(path)
    if there is None or extra is None or there.records_after or there.waveforms:
        raise NeedsPdal("the output")
    of_records = POINT_BYTES[header.point_format] + sum(np.dtype(_type(kind)).itemsize for _, kind in extra)
    alike = (there.point_format, there.scales, there.offsets, there.point_bytes)
    if alike != (header.point_format, header.scales, header.offsets, of_records):
        raise NeedsPdal("the output's points are others")
    columns: list[tuple[str, np.dtype, bool]] = []
    for name, kind in extra:
        same = np.dtype(_type(kind))
        known = name in adds and np.dtype(_type(adds[name].removesuffix("_t"))) == same
        read = name in (dtype.names or ()) and name in reading.decoded and reading.types[name] == same
        if not known and not read:
            raise NeedsPdal(f"the dimension '{name}'")
        columns.append((name, same, read))
    with open(path, "rb") as file:
        head = file.read(there.offset)
    coding: Any = None
    if path.endswith(packing.UNPACKED):
        head, coding = packing.packed_head(head, there)
    elif there.compressed:
        import lazrs

        chunks = laz_chunks(path, there)
        if chunks is None:
            raise NeedsPdal("the output's chunks")
        coding = lazrs.LazVlr(chunks.record)
    return _Output(head, there, coding, columns)


def _type(kind: str) -> str:
    return {"float": "f4", "double": "f8"}.get(kind, kind)


class _Totals:
    """What a header says of all points: their number, by return too, and their box."""

    def __init__(self, header: LasHeader) -> None:
        self._header = header
        self._count = 0
        self._returns = np.zeros(16, np.int64)
        self._least = np.full(3, 2**31, np.int64)
        self._most = np.full(3, -(2**31), np.int64)

    def add(self, records: NDArray) -> None:
        """Count points."""
        mask = 15 if self._header.point_format >= 6 else 7
        self._count += len(records)
        self._returns += np.bincount(records["bit_fields"] & mask, minlength=16)
        for axis, name in enumerate("XYZ"):
            values = records[name]
            self._least[axis] = min(self._least[axis], values.min())
            self._most[axis] = max(self._most[axis], values.max())

    def put(self, head: bytes, end: int) -> bytes:
        """The head of a file with what was counted (LAS 1.4 R15, table 3); `end`: where the file ends."""
        out = bytearray(head)
        returns = self._returns[1:].tolist()
        if any(
            head[107:131]
        ):  # the counts of older versions, which not every PDAL writes into files of LAS 1.4
            struct.pack_into("<6I", out, 107, self._count, *returns[:5])
        if self._header.minor >= 4 and any(head[235:243]):  # where records after the points would begin
            plain = self._header.offset + self._count * self._header.point_bytes
            struct.pack_into("<Q", out, 235, end if self._header.compressed else plain)
        box: list[float] = []
        for axis in range(3):
            scale, offset = self._header.scales[axis], self._header.offsets[axis]
            box += [float(ends[axis] * scale + offset) for ends in (self._most, self._least)]
        struct.pack_into("<6d", out, 179, *box)
        if self._header.minor >= 4:
            struct.pack_into("<Q15Q", out, 247, self._count, *returns)
        return bytes(out)
