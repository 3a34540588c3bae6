"""Labeled ``.pts`` text, the format of clouds that may not be passed on (ISPRS Vaihingen, GML).

One point a line, no header: X Y Z intensity return-number number-of-returns label, separated by
blanks. Whoever holds such files puts them in DIR/NAME/train*.pts and test*.pts and runs

    python benchmarks/papers/b16_experiments.py --data DIR --scene NAME
    python benchmarks/papers/w18.py --data DIR --scene NAME --target LABEL

or gives them to PDAL, whose readers.text needs the names of the columns:

    pdal-stages pipeline benchmarks/papers/vaihingen-train.json --stage.input.filename=train.pts
    pdal-stages pipeline benchmarks/papers/vaihingen-evaluate.json --stage.input.filename=test.pts

Files of other columns (GML: X Y Z label) are read where --columns names them.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from clouds import Cloud

from pdal_stages.base.errors import StageError

COLUMNS = "X Y Z Intensity ReturnNumber NumberOfReturns Classification"


def read_pts(paths: Iterable[Path], name: str, columns: str = COLUMNS) -> Cloud:
    """Text files as one cloud.

    Raises
    ------
    StageError
        Where a line does not have the columns, or a value is not a number; it names the file.
    """
    words = columns.split()
    if words.count("Classification") != 1 or not {"X", "Y", "Z"} <= set(words):
        raise StageError("the columns must name X, Y, Z and Classification", found=columns)
    tables = []
    for path in paths:
        try:
            table = np.loadtxt(path, dtype=np.float64, ndmin=2)
        except ValueError as error:
            raise StageError(f"'{path}' is not a table of numbers", found=str(error)) from error
        if table.shape[1] != len(words):
            raise StageError(
                f"'{path}' has {table.shape[1]} columns, not {len(words)}",
                cure=f"Name them with --columns; now: {columns}",
            )
        tables.append(table)
    if not tables:
        raise StageError("no .pts files were given", found=name)
    whole = np.concatenate(tables)
    by_name = dict(zip(words, whole.T, strict=True))
    labels = by_name.pop("Classification")
    if not (np.isfinite(whole).all() and (labels == np.floor(labels)).all() and labels.min() >= 0):
        raise StageError(
            "labels must be whole numbers of 0 or more, and all values finite", found=name
        )
    xyz = np.column_stack([by_name.pop(axis) for axis in "XYZ"])
    return Cloud(
        name, xyz, labels.astype(np.int64), {k: np.ascontiguousarray(v) for k, v in by_name.items()}
    )


def write_pts(path: Path, cloud: Cloud) -> None:
    """A cloud in this format; columns it lacks are 1."""
    ones = np.ones(len(cloud))
    dimensions = {
        **cloud.dimensions,
        **dict(zip("XYZ", cloud.xyz.T, strict=True)),
        "Classification": cloud.labels,
    }
    words = COLUMNS.split()
    form = ["%.3f" if word in "XYZ" else "%d" for word in words]
    np.savetxt(path, np.column_stack([dimensions.get(word, ones) for word in words]), fmt=form)
