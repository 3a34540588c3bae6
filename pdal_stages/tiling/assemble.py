"""Outputs: read the points of a file or tile again, put the results in, run the tail, rename."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .extract import Piece
from .inparts import write_in_parts
from .tail import gather, run_tail

#: A larger file is written in parts of so many points.
MOST_AT_ONCE = 4_000_000


def write_tile(task: dict[str, Any], results: Any, pieces: list[Piece], folder: str) -> dict[str, Any]:
    """Write one tile's own points from the pieces already cut."""
    readers, columns = [], []
    for number, (piece, source) in enumerate(zip(pieces, _sources_of(task, pieces), strict=True)):
        own = np.flatnonzero(piece.margin < 0)
        if not own.size:
            continue
        rows = np.searchsorted(own, results.rows[number])
        path = Path(piece.path)
        core = str(path.with_name(path.name.replace("piece", "core")))
        readers.append({**source["reader"], "type": "readers.las", "filename": core})
        columns.append((len(own), rows, {n: c[number] for n, c in results.values.items()}))
    if not readers:
        return {"outputs": []}
    return _write(readers, columns, task["tail"], task["outputs"])


def _sources_of(task: dict[str, Any], pieces: list[Piece]) -> list[dict[str, Any]]:
    """The source of each piece, by the number in the piece's name."""
    return [task["sources"][int(Path(p.path).stem.removeprefix("piece"))] for p in pieces]


def write_file(task: dict[str, Any]) -> dict[str, Any]:
    """Put one input file's results together and write its output.

    Parameters
    ----------
    task : dict
        ``source`` (path, reader, key), ``count``, ``results`` (files of tiles), ``tail``, ``outputs``.
    """
    count = task["count"]
    if count > MOST_AT_ONCE and all(_las(s) for s in task["tail"] if s["type"].startswith("writers.")):
        written = write_in_parts(task, MOST_AT_ONCE)
        if written is not None:
            return written
    kept, values = gather(task, 0, count)
    reader = {**task["source"]["reader"], "type": "readers.las", "filename": task["source"]["path"]}
    return run_tail([reader], [(kept, values)], task["tail"], task["outputs"])


def _las(writer: dict[str, Any]) -> bool:
    return writer["type"] == "writers.las" and Path(writer["filename"]).suffix.lower() in (".las", ".laz")


def _write(readers, columns, tail, outputs) -> dict[str, Any]:
    made = []
    for count, rows, values in columns:
        kept = np.zeros(count, bool)
        kept[rows] = True
        every = len(rows) == count
        made.append((kept, {n: (None if every else rows, v) for n, v in values.items()}))
    return run_tail(readers, made, tail, outputs)
