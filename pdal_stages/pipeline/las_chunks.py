"""Points of a file, in parts where possible."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.las import POINTWISE, laszip_record, named_las, read_header
from ..base.las_repair import corrected
from . import pdal as pdal_env
from .inputs_outputs import reader_of

#: Points read at a time.
PART = 1_000_000
_LASPY = {"ReturnNumber": "return_number", "NumberOfReturns": "number_of_returns"}


def can_read_chunks(path: str) -> bool:
    """Whether parts of a file can be read: LAS, LAZ and COPC files."""
    return named_las(path) and read_header(path) is not None


def read_columns(
    path: str, wanted: Sequence[str], only: Sequence[str] = ()
) -> Iterator[tuple[dict[str, NDArray], bool]]:
    """Coordinates, classes, withheld flags and the `wanted` dimensions that exist; and whether
    classes hold flags.

    LAS and LAZ files are read in parts (`only`: see :func:`read_chunks`), others at once by PDAL.
    """
    named = {
        "X": "x",
        "Y": "y",
        "Z": "z",
        "Classification": "classification",
        "Withheld": "withheld",
    }
    if not can_read_chunks(path):
        ran = pdal_env.execute([reader_of(path, "input")])
        for array in ran.arrays:
            names = [name for name in (*named, *wanted) if name in array.dtype.names]
            flags = pdal_env.flags_inside_classification(array.dtype.names, ran.metadata)
            yield {name: np.asarray(array[name]) for name in names}, flags
        return
    for chunk in read_chunks(path, only=only):
        there = set(chunk.point_format.dimension_names)
        more = {name: known for name in wanted if (known := _LASPY.get(name, name)) in there}
        yield {name: np.asarray(chunk[known]) for name, known in (named | more).items()}, False


def read_chunks(
    path: str, start: int = 0, end: int | None = None, most: int = PART, only: Sequence[str] = ()
) -> Iterator[Any]:
    """The points of a LAS or LAZ file from one number to another, `most` at a time, as laspy reads
    them.

    `only`: the dimensions that are needed beside X, Y and the returns, by laspy's names of its
    selections (``Z``, ``CLASSIFICATION``, ...): LAZ 1.4 compresses them separately, so skipping the
    others saves time. Those are zero then.
    """
    import laspy

    more = {}
    if only:
        wanted = laspy.DecompressionSelection.base()
        for name in only:
            wanted |= laspy.DecompressionSelection[name]
        more["decompression_selection"] = wanted
    at, what = start, "the input cannot be read"
    try:
        with open_las(path, **more) as reader:
            end, what = (
                int(reader.header.point_count) if end is None else end,
                "the input is damaged",
            )
            if start:
                reader.seek(start)
            while at < end and len(chunk := reader.read_points(min(most, end - at))):
                at += len(chunk)
                yield chunk
    except (GeneratorExit, KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # the decompressor's panics are no Exceptions
        found = (
            error
            if isinstance(error, OSError)
            else f"{type(error).__name__} at point {at:,}: {error}"
        )
        raise StageError(what, where=path, found=found) from None
    if at != end:
        raise StageError("the input is cut short", where=path, found=f"{at:,} of {end:,} points")


def open_las(path: str, **more: Any) -> Any:
    """Open a LAS or LAZ file with laspy, corrected where PDAL reads a corrected copy of it.

    Points that were compressed one by one are not decompressed in parallel.
    """
    import laspy

    header = read_header(path)
    with open(path, "rb") as file:
        coding = laszip_record(file, header) if header and header.compressed else b""
    if coding.startswith(POINTWISE):
        more["laz_backend"] = laspy.LazBackend.Lazrs
    return laspy.open(corrected(path) or path, **more)


def laspy_header(path: str) -> Any:
    """The header of a file with its records, except those of COPC, which do not fit points in
    another order.
    """
    import laspy

    try:
        with open_las(path) as reader:
            header = reader.header
        header.point_format.dtype()  # of extra bytes that no array can hold
        if header.version.minor == 0:  # which laspy does not write, and PDAL writes as LAS 1.2
            header.version = laspy.header.Version(1, 2)
    except Exception as error:  # laspy raises many types
        found = f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=found) from None
    for directory in header.vlrs.get(
        "GeoKeyDirectoryVlr"
    ):  # laspy counts what pads the record as keys
        directory.geo_keys_header.number_of_keys = sum(key.id > 0 for key in directory.geo_keys)
    for records in filter(None, (header.vlrs, header.evlrs)):
        records[:] = [record for record in records if record.user_id != "copc"]
    return header
