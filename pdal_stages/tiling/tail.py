"""What puts results into points and writes them: gathering from tiles, the pipeline's tail, checks of outputs."""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from ..base.las import supersede_copc
from ..pipeline import pdal as pdal_env
from . import marks
from .cloudindex import open_las, read_block

_PDAL_TYPES = {
    "f8": "double",
    "f4": "float",
    "u1": "uint8_t",
    "u2": "uint16_t",
    "u4": "uint32_t",
    "u8": "uint64_t",
    "i1": "int8_t",
    "i2": "int16_t",
    "i4": "int32_t",
    "i8": "int64_t",
}


def gather(task: dict[str, Any], start: int, end: int) -> tuple[NDArray[np.bool_], dict[str, Any]]:
    """Results of points `start` to `end` of a file: which of them came out, and their new values.

    Raises
    ------
    StageError
        If the tiles do not hold each of the file's points once.
    """
    source, count = task["source"], task["count"]
    prefix = f"{source['key']}/"
    kept = np.zeros(end - start, bool)
    seen = 0
    columns: dict[str, list[tuple[NDArray, NDArray]]] = {}
    for name in task["results"]:
        with np.load(name, allow_pickle=False) as tile:
            if f"{prefix}index" not in tile:
                continue
            index = tile[f"{prefix}index"]  # ascending
            seen += int(tile[f"{prefix}core"])
            first, last = np.searchsorted(index, (start, end))
            mine = index[first:last] - start
            if (index.size and index[-1] >= count) or kept[mine].any():
                raise StageError("internal: two tiles hold the same point", where=source["path"], found=name)
            kept[mine] = True
            for key in tile.files:
                if key.startswith(f"{prefix}dim/"):
                    part = tile[key][first:last].copy() if last - first < index.size else tile[key]
                    columns.setdefault(key.removeprefix(f"{prefix}dim/"), []).append((mine, part))
    if seen != count:
        raise StageError(
            "the tiles do not hold all points of the file: it changed while it was worked on",
            where=source["path"],
            found=f"{seen:,} of {count:,} points",
            cure="Start the run again with --resume",
        )
    values: dict[str, Any] = {}
    for name, parts in columns.items():
        if sum(len(i) for i, _ in parts) == end - start:
            full = np.empty(end - start, parts[0][1].dtype)
            for index, part in parts:
                full[index] = part
            values[name] = (None, full)
        else:
            values[name] = (np.concatenate([i for i, _ in parts]), np.concatenate([v for _, v in parts]))
        parts.clear()
    return kept, values


def run_tail(readers, injected, tail, outputs: list[str]) -> dict[str, Any]:
    """Run readers, results and tail; files appear under their names when all are whole."""
    token = uuid.uuid4().hex
    stages: list[dict[str, Any]] = []
    inputs = []
    for number, (reader, (kept, values)) in enumerate(zip(readers, injected, strict=True)):
        adds = {n: _PDAL_TYPES[v.dtype.str[1:]] for n, (_, v) in values.items()}
        stage = marks.inject_stage(token, number, values, kept, adds)
        stages += [
            {**reader, "tag": f"in{number}"},
            {**stage, "inputs": [f"in{number}"], "tag": f"put{number}"},
        ]
        if not kept.all():
            drop = marks.drop_stage(token, number, kept)
            stages[-1]["tag"] = f"all{number}"
            stages.append({**drop, "inputs": [f"all{number}"], "tag": f"put{number}"})
        inputs.append(f"put{number}")
    stages.append({"type": "filters.merge", "inputs": inputs, "tag": "merged"})
    finals = [Path(output) for output in outputs]

    def finish(made: Path, final: Path) -> None:
        check_whole(made, final, run.count)
        supersede_copc(made)

    try:
        with whole_files(*finals, check=finish) as partials:
            waiting = iter(partials)
            for stage in tail:
                stage = {k: v for k, v in stage.items() if k != "inputs"}
                if stage["type"].startswith("writers."):
                    stage["filename"] = str(next(waiting))
                stages.append(stage)
            run = pdal_env.execute(stages, arrays=False)
    finally:
        marks.forget(token)
    return {"outputs": [[str(final), *stamp(final)] for final in finals], "written": run.count}


def stamp(path: Path) -> list[int]:
    stat = path.stat()
    return [stat.st_size, stat.st_mtime_ns]


def check_whole(partial: Path, final: Path, count: int) -> None:
    """Refuse a file that is not whole: a writer may not notice that the disk is full.

    Raises
    ------
    StageError
        Naming the output.
    """
    with open(partial, "rb+") as file:
        os.fsync(file.fileno())  # some file systems report a full disk only here
    if final.suffix.lower() not in (".las", ".laz"):
        return
    full = "The disk may be full"
    try:
        with open_las(str(partial)) as reader:
            header = reader.header
            found = int(header.point_count)
            if found == count and count:
                read_block(reader, str(partial), count - 1, 1)
                if final.suffix.lower() == ".las":
                    needed = header.offset_to_point_data + count * header.point_format.size
                    if partial.stat().st_size < needed:
                        raise StageError("cut short")
    except StageError:
        raise StageError("the output is not whole", found=str(final), cure=full) from None
    if found != count:
        raise StageError(
            "the output is not whole", found=f"{found:,} of {count:,} points in {final}", cure=full
        )
