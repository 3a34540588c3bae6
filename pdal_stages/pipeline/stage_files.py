"""The files that PDAL's stages read and write. Each stage has a type (:func:`.pdal.typed`)."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Mapping
from typing import Any

from ..base.files import LAS, Output

#: Writers of LAS and COPC.
LAS_WRITERS = ("writers.las", "writers.copc")
#: Readers of LAS files.
LAS_READERS = ("readers.las", "readers.copc")
#: Options of PDAL's stages that never name a file.
_NO_FILES = ("type", "tag", "inputs", "user_data", "pdalargs")


def readers_files(stages: list[dict[str, Any]], *, las: bool = False) -> list[str]:
    """Local files that PDAL's readers read, patterns filled in; only LAS and LAZ files with
    `las`.
    """
    return [name for stage in stages for name in reader_files(stage, las=las)]


def reader_files(stage: dict[str, Any], *, las: bool = False) -> list[str]:
    """The same for one stage."""
    name, is_las = stage.get("filename"), stage["type"] in LAS_READERS
    if not is_reader(stage) or not isinstance(name, str) or "://" in name or (las and not is_las):
        return []
    names = sorted(glob.glob(name)) if not os.path.exists(name) else [name]
    there = os.path.exists if is_las else os.path.isfile  # other readers may read a pipe
    return [n for n in names if there(n) and not os.path.isdir(n)]


def named_files(stages: list[dict[str, Any]]) -> list[str]:
    """Existing files named in any option of PDAL's stages: polygons, rasters, scripts."""
    found: list[str] = []
    for stage in stages:
        own = (*_NO_FILES, *(("filename",) if is_writer(stage) else ()))
        texts = _texts({name: value for name, value in stage.items() if name not in own})
        found += [text for text in texts if "\0" not in text and os.path.isfile(text)]
    return found


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def is_reader(stage: Mapping[str, Any]) -> bool:
    """Whether a stage is a reader."""
    return stage["type"].startswith("readers.")


def is_writer(stage: Mapping[str, Any]) -> bool:
    """Whether a stage writes a local file."""
    name, kind = stage.get("filename"), stage["type"]
    if not kind.startswith("writers.") or not isinstance(name, str) or "://" in name:
        return False
    return kind != "writers.text" or name.upper() != "STDOUT"  # which PDAL prints


def writes_las(stage: Mapping[str, Any]) -> bool:
    """Whether a stage writes LAS."""
    return stage["type"] in LAS_WRITERS


def writers_outputs(stages: list[dict[str, Any]]) -> list[Output]:
    """Files that PDAL's writers write."""
    return [
        Output(s["filename"], "output", LAS if writes_las(s) else "")
        for s in filter(is_writer, stages)
    ]


def with_outputs(stages: list[dict[str, Any]], names: list[Any]) -> list[dict[str, Any]]:
    """Stages whose writers write to other names."""
    waiting = iter(names)
    return [{**s, "filename": str(next(waiting))} if is_writer(s) else s for s in stages]
