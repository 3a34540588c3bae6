"""Read dimensions of point files in parts: LAS and LAZ here, other formats at once by PDAL."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.las import named_las, read_header
from ..base.las_points import Layout, read_records
from . import pdal as pdal_env

_ALWAYS = ("X", "Y", "Z", "Classification", "Withheld")


def can_read_chunks(path: str) -> bool:
    """Return whether parts of a file can be read: whether it is a LAS, LAZ or COPC file."""
    return named_las(path) and read_header(path) is not None


def read_columns(
    path: str, wanted: Sequence[str] = ()
) -> Iterator[tuple[dict[str, NDArray], bool]]:
    """Yield coordinates, classes, withheld flags and the `wanted` dimensions that exist.

    The second value of each part tells whether classes hold flags.
    """
    if can_read_chunks(path):
        layout = Layout.of_file(path)
        names = [name for name in (*_ALWAYS, *wanted) if name in layout.fields]
        for records in read_records(path, layout, only=names):
            yield {name: layout.fields[name].read(records) for name in names}, False
        return
    run = pdal_env.execute([pdal_env.reader_of(path, "input")])
    for array in run.arrays:
        names = [name for name in (*_ALWAYS, *wanted) if name in array.dtype.names]
        flags = pdal_env.flags_inside_classification(array.dtype.names, run.metadata)
        yield {name: np.asarray(array[name]) for name in names}, flags
