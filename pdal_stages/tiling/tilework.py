"""One tile: cut it out with its surroundings, run the head, keep the tile's own results."""

from __future__ import annotations

import json
import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import PipelineError, StageError
from ..base.files import whole_files, write_whole
from ..pipeline.run import Pipeline
from ..stages import registry
from . import marks
from .assemble import write_tile
from .extract import Piece, cut
from .grid import Grid, inside
from .scratch import scratch
from .tileplan import MARGIN, ROW, SOURCE, given_options, later_reaches

#: How often a tile is read again with wider surroundings.
_WIDENINGS = 3


def run_tile(task: dict[str, Any]) -> dict[str, Any]:
    """Run the head on a tile; write its results, or its output.

    Parameters
    ----------
    task : dict
        ``tile``, ``size``, ``unit`` (metres per unit of the coordinates), ``buffer`` (metres), ``bounds`` (of all
        inputs), ``sources`` (path, reader, kind, key, index), ``head``, ``extra`` (metres that PDAL's filters look
        at), ``creates``, ``threads``, ``scratch`` (folder), ``most_points``; ``result`` (file to write) or ``tail``
        and ``outputs``.

    Returns
    -------
    dict
        ``points`` of the tile, ``read`` with surroundings, ``classes``, ``buffer`` used, ``short`` (True where
        the surroundings did not suffice), ``dropped``.
    """
    with scratch(task["scratch"]) as folder:
        head, keys, pieces, report = _settle(task, folder)
        report["classes"] = _class_counts(head)
        if task.get("result"):
            _save(Path(task["result"]), head, keys, pieces)
        else:
            report.update(write_tile(task, head, pieces, folder))
    if task.get("done"):
        write_whole(task["done"], json.dumps({**report, "fingerprint": task["fingerprint"]}).encode())
    return report


class Results:
    """Results of a tile's own points, by source.

    Attributes
    ----------
    rows : list of ndarray
        For each source, rows of its piece that came out, ascending.
    values : dict of str to list of ndarray
        For each dimension and source, values in the order of `rows`.
    cores : list of int
        For each source, how many own points went in.
    legacy : bool
        Whether the flag bits of LAS 1.0-1.3 sit inside `Classification`.
    """

    def __init__(
        self, rows: list[NDArray], values: dict[str, list[NDArray]], cores: list[int], legacy: bool = False
    ) -> None:
        self.rows, self.values, self.cores, self.legacy = rows, values, cores, legacy


def _settle(task: dict[str, Any], folder: str) -> tuple[Results, list[str], list[Piece], dict[str, Any]]:
    """Run the head with surroundings that suffice."""
    grid, tile, unit = Grid(task["size"]), tuple(task["tile"]), task["unit"]
    buffer = task["buffer"]
    short = False
    result: Results | None = None
    for attempt in range(_WIDENINGS + 1):
        keys, pieces, sources = _cut_all(task, grid, tile, buffer / unit, folder)
        read = sum(len(p.index) for p in pieces)
        own = sum(int(np.count_nonzero(p.margin < 0)) for p in pieces)
        everything = inside(tuple(task["bounds"]), grid.box(tile, buffer / unit))
        if not own:
            break
        result, need = _head(task, grid, tile, pieces, sources, everything)
        if everything or need <= buffer:
            break
        short = True
        estimate = read * ((task["size"] * unit + 2 * need) / (task["size"] * unit + 2 * buffer)) ** 2
        if attempt == _WIDENINGS or estimate > task["most_points"]:
            if result is None:
                raise StageError(
                    "no terrain: no point near the tile may form one", found=f"within {buffer:.0f} m"
                )
            break
        buffer, short = float(need) + 1e-6, False
    report: dict[str, Any] = {
        "points": own,
        "read": read,
        "buffer": buffer,
        "short": short,
        "widened": buffer > task["buffer"],
    }
    if not own or result is None:
        result = Results([np.empty(0, np.int64) for _ in pieces], {}, [0 for _ in pieces])
    report["dropped"] = own - sum(len(r) for r in result.rows)
    return result, keys, pieces, report


def _cut_all(task, grid: Grid, tile, margin: float, folder: str):
    keys, pieces, sources = [], [], []
    for number, source in enumerate(task["sources"]):
        path, index = source["path"], source.get("index")
        if source["kind"] == "ept":
            from .ept import fetch

            path, index = fetch(source, grid, tile, margin, os.path.join(folder, f"fetched{number}.las"))
        if not index:
            continue
        target = os.path.join(folder, f"piece{number}.las")
        core = os.path.join(folder, f"core{number}.las") if not task.get("result") else None
        piece = cut(path, index["boxes"], index["count"], grid, tile, margin, target, core)
        if piece is None:
            continue
        keys.append(source["key"])
        pieces.append(piece)
        sources.append(source)
    return keys, pieces, sources


def _head(task, grid, tile, pieces: list[Piece], sources, everything: bool) -> tuple[Results | None, float]:
    """Run the head once; its results, and the metres of surroundings it needed."""
    token = uuid.uuid4().hex
    unit = task["unit"]
    head = task["head"]
    cores = [int(np.count_nonzero(p.margin < 0)) for p in pieces]
    if not head:
        rows = [np.flatnonzero(p.margin < 0) for p in pieces]
        return Results(rows, {}, cores), 0.0
    stages: list[dict[str, Any]] = []
    inputs = []
    try:
        for number, (piece, source) in enumerate(zip(pieces, sources, strict=True)):
            metres = np.where(piece.margin < 0, -1.0, piece.margin * unit)
            reader = {**source["reader"], "type": "readers.las", "filename": piece.path, "tag": f"in{number}"}
            mark = marks.mark_stage(token, number, metres, task["creates"] is None)
            stages += [reader, {**mark, "inputs": [f"in{number}"], "tag": f"mark{number}"}]
            inputs.append(f"mark{number}")
        later = later_reaches(head, task["extra"])
        for place, stage in enumerate(head):
            stage = {k: v for k, v in stage.items() if k != "inputs"}
            if place == 0:
                stage["inputs"] = inputs
            if stage["type"] in registry.stages():
                given = int(stage.get("threads") or 0)
                stage["threads"] = min(given, task["threads"]) if given else task["threads"]
            stages.append(stage)
            if stage["type"] == "filters.hag_minima" and not everything:
                box = list(grid.box(tile))
                stages.append(marks.terrain_stage(token, place, given_options(stage), later[place], box))
        pipeline = Pipeline(stages)
        try:
            pipeline.execute(arrays=True)
        except StageError as error:
            if error.what.startswith("no terrain") and not everything:
                return None, task["size"] * unit + 2 * task["buffer"]  # look farther away
            raise
        result = _collect(pipeline.arrays, pieces, cores, task["creates"], marks.originals(token))
        need = marks.need(token)
        if not everything and any(
            _looked_far(report) for _, reports in pipeline.reports for report in reports
        ):
            need = max(need, _far_neighbors(pipeline.arrays, head, grid.box(tile), unit, task["threads"]))
        return result, need
    finally:
        marks.forget(token)


def _collect(arrays, pieces, cores, creates, before) -> Results:
    """Results of the tile's own points, sorted as their pieces are."""
    names = [n for a in arrays[:1] for n in a.dtype.names]
    legacy = not {"Synthetic", "Withheld", "ClassFlags"} & set(names) and all(
        _old_format(p.path) for p in pieces
    )
    if creates is not None:
        names = [n for n in creates if n in names]
    else:
        names = [n for n in names if n not in (ROW, SOURCE, MARGIN)]
    found: dict[int, list[tuple[NDArray, dict[str, NDArray]]]] = {k: [] for k in range(len(pieces))}
    for array in arrays:
        mine = np.flatnonzero(array[MARGIN] < 0)
        source = array[SOURCE][mine]
        for number in np.unique(source).tolist():
            at = mine[source == number]
            found[number].append((array[ROW][at].astype(np.int64), {n: array[n][at] for n in names}))
    rows: list[NDArray] = []
    values: dict[str, list[NDArray]] = {n: [] for n in names}
    for number in range(len(pieces)):
        parts = found[number]
        row = np.concatenate([p[0] for p in parts]) if parts else np.empty(0, np.int64)
        order = np.argsort(row, kind="stable")
        row = row[order]
        if row.size and (np.diff(row) == 0).any():
            raise PipelineError(
                "a stage makes new points, which have no place in the input files",
                cure="Run the pipeline without --tile",
            )
        rows.append(row)
        for name in names:
            column = np.concatenate([p[1][name] for p in parts]) if parts else np.empty(0)
            values[name].append(column[order] if parts else column)
    if creates is None:
        values = _changed(values, rows, before)
    return Results(rows, values, cores, legacy)


def _old_format(path: str) -> bool:
    with open(path, "rb") as file:
        return file.read(105)[104] & 0x3F <= 5


def _changed(values, rows, before) -> dict[str, list[NDArray]]:
    """Only the dimensions that are new, or differ from what was read."""
    old: dict[int, dict[str, NDArray]] = {}
    for kept in before:
        if len(kept[ROW]):
            old[int(kept[SOURCE][0])] = kept
    out = {}
    for name, columns in values.items():
        for number, column in enumerate(columns):
            if not len(column):
                continue
            kept = old[number]
            if name not in kept or not np.array_equal(
                kept[name][np.searchsorted(kept[ROW], rows[number])], column
            ):
                out[name] = columns
                break
    return out


def _looked_far(report: dict[str, Any]) -> bool:
    return any((report.get("beyond_halo") or {}).values())


def _far_neighbors(arrays, head, box, unit: float, threads: int) -> float:
    """Metres around the tile within which the k nearest neighbors of all its points lie."""
    from scipy.spatial import cKDTree

    most = 0
    for stage in head:
        kind = registry.stages().get(stage["type"])
        if kind is None:
            continue
        plan = getattr(kind(given_options(stage)), "plan", None)
        for one in plan.neighborhoods if plan is not None else ():
            if one.reach is None:
                most = max(most, int(one.parameters[-1] if one.kind == "knn" else one.parameters[1]))
    array = np.concatenate([a[["X", "Y", "Z", MARGIN]] for a in arrays])
    xyz = np.column_stack([array[c] for c in "XYZ"]) * unit
    mine = np.flatnonzero(array[MARGIN] < 0)
    inward = np.minimum(
        np.minimum(xyz[mine, 0] - box[0] * unit, box[2] * unit - xyz[mine, 0]),
        np.minimum(xyz[mine, 1] - box[1] * unit, box[3] * unit - xyz[mine, 1]),
    )
    if len(xyz) <= most:
        return float(2 * (box[2] - box[0]) * unit)
    far = cKDTree(xyz).query(xyz[mine], k=[most + 1], workers=threads)[0][:, 0]
    return float(max(0.0, (far - inward).max()))


def _save(path: Path, results: Results, keys: list[str], pieces: list[Piece]) -> None:
    """Write the results of a tile for the files to be put together from."""
    content: dict[str, NDArray] = {}
    for number, key in enumerate(keys):
        rows = results.rows[number]
        content[f"{key}/index"] = pieces[number].index[rows]
        content[f"{key}/core"] = np.array(results.cores[number])
        for name, columns in results.values.items():
            content[f"{key}/dim/{name}"] = columns[number]
    with whole_files(path, what="result") as (partial,):
        np.savez(partial, **content)  # type: ignore[arg-type]


def _class_counts(results: Results) -> dict[str, int]:
    counts = np.zeros(256, np.int64)
    for column in results.values.get("Classification", ()):
        if len(column):
            codes = np.asarray(column, np.uint8)
            counts += np.bincount(codes & LEGACY_LIMIT if results.legacy else codes, minlength=256)
    return {str(c): int(counts[c]) for c in np.flatnonzero(counts)}
