"""The files that a pipeline reads and writes."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from typing import Any

from ..base.files import LAS, Output
from ..classifier.modelfile import find
from ..stages.base import Stage

#: Writers of LAS and what is made of it.
LAS_WRITERS = ("writers.las", "writers.copc")
#: Readers of LAS files.
LAS_READERS = ("readers.las", "readers.copc")
#: What stages of PDAL have that never names a file.
_NO_FILES = ("type", "tag", "inputs", "user_data", "pdalargs")


def readers_files(stages: list[dict[str, Any]], *, las: bool = False) -> list[str]:
    """Local files that PDAL's readers read, patterns filled in; only LAS and LAZ files with `las`."""
    reading = [stage for stage in stages if not is_writer(stage, stages)]
    return [name for stage in reading for name in reader_files(stage, las=las)]


def reader_files(stage: dict[str, Any], *, las: bool = False) -> list[str]:
    """Those of one stage, which is a reader where it has no type."""
    name, kind = stage.get("filename"), stage.get("type", "")
    if not isinstance(name, str) or "://" in name:
        return []
    is_las = kind in LAS_READERS or (not kind and name.lower().endswith((".las", ".laz")))
    if not is_las and (las or (kind and not kind.startswith("readers."))):
        return []
    names = sorted(glob.glob(name)) if not os.path.exists(name) else [name]
    return [n for n in names if os.path.isfile(n)]


def named_files(stages: list[dict[str, Any]]) -> list[str]:
    """Files there are that options of PDAL's stages name, whichever the options: polygons, rasters, scripts."""
    found: list[str] = []
    for stage in stages:
        own = (*_NO_FILES, *(("filename",) if is_writer(stage, stages) else ()))
        texts = _texts({name: value for name, value in stage.items() if name not in own})
        found += [text for text in texts if "\0" not in text and os.path.isfile(text)]
    return found


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def stage_files(stage: Stage) -> list[str]:
    """Files that a stage of ours reads."""
    written = {output.path for output in stage.outputs()}
    if stage.type.startswith("writers."):  # whose outputs may be named after it
        written.add(stage.options["filename"])
    given = [(o.kind, stage.options[o.name]) for o in stage.all_options() if o.kind in ("filename", "model")]
    found = [find(name) if kind == "model" else name for kind, name in given if name]
    return [name for name in [*found, *stage.inputs()] if name not in written]


def is_reader(stages: Sequence[dict[str, Any]], number: int) -> bool:
    """Whether a stage is a reader: without a type, one that is not the last of several."""
    kind = stages[number].get("type", "")
    return kind.startswith("readers.") or (not kind and (number == 0 or number < len(stages) - 1))


def is_writer(stage: dict[str, Any], stages: list[dict[str, Any]]) -> bool:
    """Whether a stage writes a local file."""
    name, kind = stage.get("filename"), stage.get("type", "")
    if not isinstance(name, str) or "://" in name:
        return False
    if not kind.startswith("writers.") and (kind or len(stages) == 1 or stage is not stages[-1]):
        return False
    return kind not in ("", "writers.text") or name.upper() != "STDOUT"  # which PDAL prints


def writes_las(writer: dict[str, Any]) -> bool:
    """Whether a writer, or a stage without a type, writes LAS."""
    kind, name = writer.get("type", ""), str(writer.get("filename", ""))
    return kind in LAS_WRITERS or (not kind and name.lower().endswith((".las", ".laz")))


def writers_outputs(stages: list[dict[str, Any]]) -> list[Output]:
    """Files that PDAL's writers write."""
    writers = [stage for stage in stages if is_writer(stage, stages)]
    return [Output(s["filename"], "output", LAS if writes_las(s) else "") for s in writers]


def with_outputs(stages: list[dict[str, Any]], names: list[Any]) -> list[dict[str, Any]]:
    """Stages whose writers write to other names."""
    waiting = iter(names)
    return [{**s, "filename": str(next(waiting))} if is_writer(s, stages) else s for s in stages]
