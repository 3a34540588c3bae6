"""What would fail in every tile, found before the first: PDAL prepares the pipeline on one input, without reading points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..base.errors import DependencyError
from ..pipeline.read import PipelineSource
from ..pipeline.run import Pipeline
from .sources import InputSource


def rehearse(source: PipelineSource, sources: list[InputSource], readers: int) -> None:
    """Refuse a pipeline whose stages lack dimensions, or whose options PDAL does not take; its first stages are `readers`.

    Raises
    ------
    StageError
        That names the user's own stage.
    """
    first = next((one for one in sources if one.kind == "las"), None)
    if first is None:
        return  # EPT, which would have to be fetched
    reader: dict[str, Any] = {**first.reader, "type": "readers.las", "filename": first.path}
    tags = [stage.get("tag") if isinstance(stage, dict) else None for stage in source.stages[:readers]]
    stages = [{**reader, "tag": tag} if tag else dict(reader) for tag in tags]
    pipeline = Pipeline(replace(source, stages=[*stages, *source.stages[readers:]]), whole=False)
    try:
        pipeline.prepare()
    except DependencyError:
        return  # the program pdal is not there to ask
