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

#: Points read at a time: 30 to 70 MB as LAS stores them.
PART = 1_000_000
_LASPY = {"ReturnNumber": "return_number", "NumberOfReturns": "number_of_returns"}


def can_read_chunks(path: str) -> bool:
    """Return whether parts of a file can be read: whether it is a LAS, LAZ or COPC file."""
    return named_las(path) and read_header(path) is not None


def read_columns(
    path: str, wanted: Sequence[str], only: Sequence[str] = ()
) -> Iterator[tuple[dict[str, NDArray], bool]]:
    """Yield coordinates, classes, withheld flags and the `wanted` dimensions that exist.

    The second value of each part tells whether classes hold flags. LAS and LAZ files are read in
    parts (`only`: see :func:`read_chunks`), others at once by PDAL.
    """
    always = ("X", "Y", "Z", "Classification", "Withheld")
    if can_read_chunks(path):
        for chunk in read_chunks(path, only=only):
            there = set(chunk.point_format.dimension_names)
            columns = {name: chunk[name.lower()] for name in always}
            for name in wanted:
                if (known := _LASPY.get(name, name)) in there:
                    columns[name] = chunk[known]
            yield {name: np.asarray(column) for name, column in columns.items()}, False
        return
    run = pdal_env.execute([pdal_env.reader_of(path, "input")])
    for array in run.arrays:
        names = [name for name in (*always, *wanted) if name in array.dtype.names]
        flags = pdal_env.flags_inside_classification(array.dtype.names, run.metadata)
        yield {name: np.asarray(array[name]) for name in names}, flags


def read_chunks(
    path: str, start: int = 0, end: int | None = None, most: int = PART, only: Sequence[str] = ()
) -> Iterator[Any]:
    """Yield the points of a LAS or LAZ file from one number to another, as laspy reads them.

    Parameters
    ----------
    path : str
    start, end : int
        Numbers of the first point and of the one after the last; by default all are read.
    most : int
        Points of each part.
    only : sequence of str
        Dimensions that are needed beside X, Y and the returns, by laspy's names of its selections
        (``Z``, ``CLASSIFICATION``, ...): LAZ 1.4 compresses them separately, so skipping the others
        saves time. Those are zero then.
    """
    import laspy

    options = {}
    if only:
        selection = laspy.DecompressionSelection.base()
        for name in only:
            selection |= laspy.DecompressionSelection[name]
        options["decompression_selection"] = selection
    at, what = start, "the input cannot be read"
    try:
        with open_las(path, **options) as reader:
            what = "the input is damaged"
            end = int(reader.header.point_count) if end is None else end
            if start:
                reader.seek(start)
            while at < end and len(chunk := reader.read_points(min(most, end - at))):
                at += len(chunk)
                yield chunk
    except (GeneratorExit, KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # the decompressor's panics are no Exceptions
        reason: object = f"{type(error).__name__} at point {at:,}: {error}"
        reason = error if isinstance(error, OSError) else reason
        raise StageError(what, where=path, found=reason) from None
    if at != end:
        raise StageError("the input is cut short", where=path, found=f"{at:,} of {end:,} points")


def open_las(path: str, **options: Any) -> Any:
    """Open a LAS or LAZ file with laspy, corrected where PDAL reads a corrected copy of it.

    Points that were compressed one by one are not decompressed in parallel.
    """
    import laspy

    header = read_header(path)
    with open(path, "rb") as file:
        coding = laszip_record(file, header) if header and header.compressed else b""
    if coding.startswith(POINTWISE):
        options["laz_backend"] = laspy.LazBackend.Lazrs
    return laspy.open(corrected(path) or path, **options)


def laspy_header(path: str) -> Any:
    """Return the header of a file with its records.

    Those of COPC are left out: they do not fit points in another order.
    """
    import laspy

    try:
        with open_las(path) as reader:
            header = reader.header
        header.point_format.dtype()  # of extra bytes that no array can hold
        if header.version.minor == 0:  # which laspy does not write, and PDAL writes as LAS 1.2
            header.version = laspy.header.Version(1, 2)
    except Exception as error:  # laspy raises many types
        reason = f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=reason) from None
    for keys in header.vlrs.get("GeoKeyDirectoryVlr"):  # laspy counts its padding as keys
        keys.geo_keys_header.number_of_keys = sum(key.id > 0 for key in keys.geo_keys)
    for records in filter(None, (header.vlrs, header.evlrs)):
        records[:] = [record for record in records if record.user_id != "copc"]
    return header
