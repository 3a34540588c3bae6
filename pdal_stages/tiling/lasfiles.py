"""LAS and LAZ files read in blocks of points by laspy, and written uncompressed with another file's header."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from ..base.errors import StageError

if TYPE_CHECKING:  # its import takes 0.15 CPU seconds, which a single file in one piece need not wait for
    import laspy

#: Points of a block: LAZ is compressed in pieces of so many.
BLOCK = 50_000


def open_las(path: str, only: Sequence[str] = ()):
    """The file, for reading; StageError with the reason where it cannot be.

    `only`: the dimensions that are needed beside X, Y and the returns, by laspy's names of its selections (``Z``,
    ``CLASSIFICATION``, ...): LAZ 1.4 holds them apart, so the others take no time. They hold nothing then.
    """
    import laspy

    more = {}
    if only:
        wanted = laspy.DecompressionSelection.base()
        for name in only:
            wanted |= laspy.DecompressionSelection[name]
        more["decompression_selection"] = wanted
    try:
        return laspy.open(path, **more)
    except Exception as error:  # laspy and the decompressor raise many types
        found = error if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=found) from None


def read_block(reader: Any, path: str, start: int, end: int, most: int = BLOCK):
    """Points from number `start` to `end`, `most` at most; StageError where the file is cut short or damaged."""
    count = min(most, end - start)
    try:
        if reader.points_read != start:  # seeking to where one is costs, and forgets what is wanted
            reader.seek(start)
        points = reader.read_points(count)
    except BaseException as error:  # the decompressor's panics are no Exceptions
        if isinstance(error, KeyboardInterrupt | MemoryError):
            raise
        raise StageError(
            "the input is damaged", where=path, found=f"{type(error).__name__} at point {start:,}: {error}"
        ) from None
    if len(points) != count:
        raise StageError(
            "the input is cut short", where=path, found=f"it ends before point {start + count:,}"
        )
    return points


def record_blocks(path: str, start: int = 0, end: int | None = None, most: int = BLOCK) -> Iterator[NDArray]:
    """Records of the points from one number to another, in blocks, with laspy's names of their fields.

    Raises
    ------
    StageError
        If any of it cannot be read.
    """
    with open_las(path) as reader:
        end = int(reader.header.point_count) if end is None else end
        for first in range(start, end, most):
            yield read_block(reader, path, first, end, most).array


def header_of(path: str) -> laspy.LasHeader:
    """The header of a file, with its records."""
    with open_las(path) as reader:
        header = reader.header
    # Points in another order have no octree
    header.vlrs[:] = [record for record in header.vlrs if record.user_id != "copc"]
    if header.evlrs:
        header.evlrs[:] = [record for record in header.evlrs if record.user_id != "copc"]
    return header


def write_records(path: str, header: laspy.LasHeader, records: Iterable[NDArray]) -> None:
    """Write points uncompressed, with the header of the file that they are from."""
    import laspy

    try:
        with laspy.open(path, mode="w", header=copy.deepcopy(header), do_compress=False) as writer:
            for block in records:
                writer.write_points(laspy.PackedPointRecord(block, header.point_format))
    except OSError as error:
        raise StageError("a temporary file could not be written", where=path, found=error) from error
