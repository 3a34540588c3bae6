"""Classify one file in one piece: as a copy of a LAS file, or as a pipeline of PDAL's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from ..base.json_types import StageJson
from ..base.las_check import beyond_box, check_complete
from ..base.las_copy import LasCopy
from ..base.las_points import LasColumns, Layout, layout_there
from ..base.messages import Message
from ..stages.points import RESERVED
from .classify_request import ClassifyRequest
from .copies import (
    copy_of,
    describe_selection,
    extra_dims_option,
    selection,
    write_copy,
)
from .inputs_outputs import is_las, writes_las
from .run import Pipeline
from .spatial_reference import text_of


def classify_file(
    pipeline: Pipeline, request: ClassifyRequest, source: str
) -> tuple[int, list[Message]]:
    """Run the pipeline of a request; return the number of points written, and messages.

    The pipeline's reports and metadata are those of the run afterwards.
    """
    writes = writes_las(pipeline.source.stages[-1])
    layout = None
    if is_las(source):  # others are checked when the pipeline is run
        pipeline.settle_inputs(pdal=not pipeline.copied)
        layout = Layout.of_file(source)
    if layout is not None and pipeline.is_read_here and writes:
        return _copy(pipeline, request, layout)
    if writes:
        if layout is not None:
            _refuse_lost_dimensions(layout, request)
        if listed := extra_dims_option(layout, request.extra_dims):
            pipeline.set_default(-1, extra_dims=listed)
    extra = layout.extra_by_name if layout else ()
    pipeline.select(request.where, {*request.creates} - {*extra})
    count = pipeline.execute(arrays=False)
    return count, [*pipeline.log_messages, *pipeline.messages]


def _refuse_lost_dimensions(layout: Layout, request: ClassifyRequest) -> None:
    """Refuse a LAS file with dimensions that PDAL would mix up with those of stages."""
    created = {name.lower() for name in request.creates if name not in request.extra_dims}
    for name in layout.extra_by_name:
        if name.lower() in created or name.startswith(RESERVED):
            raise StageError(
                f"a stage of the pipeline makes a dimension '{name}', as the input has one, and "
                "PDAL would write that one",
                cure="Rename it in the input, or have it made anew: --dimensions all",
            )


def _copy(
    pipeline: Pipeline, request: ClassifyRequest, layout: Layout
) -> tuple[int, list[Message]]:
    """Read a LAS file, run the stages, and write a copy of it."""
    reader, *_, writer = pipeline.source.stages
    source, target = str(reader["filename"]), str(writer["filename"])
    beside = target if pipeline.copied else ".las"
    copy = copy_of(source, layout, beside, request.extra_dims, reader)
    wkt, note = text_of(reader)
    columns = LasColumns([(layout, source)])
    known = selection(request.where, columns)
    messages = [Message(text) for text in (note, beyond_box(source, _box_of(columns))) if text]
    messages += describe_selection(request.where, known)
    seen = pipeline.run_here(columns, wkt, known)
    values = {name: seen[name] for name in ("Classification", *request.extra_dims)}
    messages += pipeline.messages
    del seen, columns, known
    if not pipeline.copied:
        messages += _write_through_pdal(copy, values, writer)
        return copy.count, messages

    def check(partial: Path, final: Path, number: int) -> None:
        check_complete(partial, final, writer, copy.count)

    with whole_files(target, check=check) as (partial,):
        write_copy(copy, partial, values)
    return copy.count, messages


def _box_of(columns: Mapping[str, NDArray]) -> tuple[float, float, float, float]:
    """Return min x, min y, max x, max y of points; zeros without any."""
    x, y = columns["X"], columns["Y"]
    if not len(x):
        return 0.0, 0.0, 0.0, 0.0
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def _write_through_pdal(
    copy: LasCopy, values: Mapping[str, NDArray], writer: StageJson
) -> list[Message]:
    """Let PDAL write what a copy would hold, by the options of a writer; return its log."""
    folder = Path(writer["filename"]).absolute().parent
    with TemporaryDirectory(prefix=".pdal-stages-copy-", dir=folder) as beside:
        path = Path(beside) / "copy.las"
        write_copy(copy, path, values)
        listed = extra_dims_option(layout_there(path), {})
        reader = {"type": "readers.las", "filename": str(path), "use_eb_vlr": True}
        extra = {"extra_dims": listed} if listed else {}
        tail = Pipeline([reader, {**extra, **writer}])
        tail.execute(arrays=False)
    return tail.log_messages
