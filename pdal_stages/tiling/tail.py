"""The pipeline's tail: points read again, results put into them, writers run, outputs checked before they get their name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..base.files import whole_files
from ..base.las import supersede_copc
from ..base.lascheck import check_complete
from ..pipeline import las_output
from ..pipeline import pdal as pdal_env
from ..pipeline.callbacks import Callbacks
from .results import NewValues
from .store import check_run

#: PDAL's names of types that are not NumPy's with ``_t``.
_FLOATS = {"float64": "double", "float32": "float"}


def run_tail(
    readers: list[dict[str, Any]],
    new: list[NewValues],
    tail: list[dict[str, Any]],
    outputs: Sequence[str],
    scratch: str,
) -> dict[str, Any]:
    """Run readers, the new values of each, and the tail with its writers; what they have :func:`written`.

    The files, `outputs`, appear under their names when all are whole, and the run goes on whose folder for temporary files
    is `scratch`.
    """
    writers = [stage for stage in tail if stage["type"].startswith("writers.")]

    def finish(made: Path, final: Path, number: int) -> None:
        check_run(scratch)
        check_complete(made, final, writers[number], None if "where" in writers[number] else run.count)
        supersede_copc(made)

    flags = las_output.files_with_flags_to_split([*readers, *tail])
    with Callbacks() as callbacks:
        stages = merged(callbacks, readers, new, flags)
        tail = [{k: v for k, v in stage.items() if k != "inputs"} for stage in tail]
        with whole_files(*outputs, check=finish) as partials:
            waiting = iter(partials)
            for stage in tail:
                if stage["type"].startswith("writers."):
                    stage = las_output.uncompressed_writer({**stage, "filename": str(next(waiting))}, readers)
                stages.append(stage)
            run = pdal_env.execute(stages, arrays=False)
            las_output.compress(partials)
    return written(outputs, run.count)


def merged(
    callbacks: Callbacks,
    readers: list[dict[str, Any]],
    new: list[NewValues],
    flags: Sequence[bool],
) -> list[dict[str, Any]]:
    """Stages that read points, give them their new values, and merge them."""
    stages: list[dict[str, Any]] = []
    inputs = []
    for number, (reader, values) in enumerate(zip(readers, new, strict=True)):
        stages.append({**reader, "tag": f"in{number}"})
        stages += _put(callbacks, values, f"in{number}", f"put{number}")
        inputs.append(f"put{number}")
        if flags and flags[number]:
            stages.append(las_output.flag_splitter([True], inputs=[f"put{number}"], tag=f"split{number}"))
            inputs[-1] = f"split{number}"
    return [*stages, {"type": "filters.merge", "inputs": inputs}]


def _put(callbacks: Callbacks, new: NewValues, after: str, tag: str) -> list[dict[str, Any]]:
    """Filters that give a reader's points their new values, and drop some; PDAL wants the two apart."""

    def put(module, ins, outs) -> None:
        if len(ins["X"]) != len(new.kept):
            raise StageError(f"the reader gave {len(ins['X']):,} points of {len(new.kept):,}")
        for name, (rows, values) in new.values.items():
            if rows is None:
                outs[name] = np.ascontiguousarray(values, ins[name].dtype)
            else:
                outs[name] = np.array(ins[name])
                outs[name][rows] = values

    def drop(module, ins, outs) -> None:
        outs["Mask"] = np.ascontiguousarray(new.kept, bool)

    types = {name: values.dtype.name for name, (_, values) in new.values.items()}
    adds = {name: _FLOATS.get(kind, f"{kind}_t") for name, kind in types.items()}
    if new.kept.all():
        return [callbacks.filter(put, adds, inputs=[after], tag=tag)]
    return [
        callbacks.filter(put, adds, inputs=[after], tag=f"all_{tag}"),
        callbacks.filter(drop, inputs=[f"all_{tag}"], tag=tag),
    ]


def written(outputs: Sequence[str], count: int) -> dict[str, Any]:
    """What a record says of files just written: their size and time of change, and the points that came out."""
    found = [(path, os.stat(path)) for path in outputs]
    return {"outputs": [[path, s.st_size, s.st_mtime_ns] for path, s in found], "written": count}
