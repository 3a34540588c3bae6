"""Flags of LAS 1.0-1.3 on their way to other formats.

PDAL before 2.6 reads them as the upper bits of the class, and writes class and flags of LAS 1.4 from two dimensions.
Written as they were read, a withheld point of class 2 would become one of class 130.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import PipelineError
from . import pdal as pdal_env
from .filenames import is_writer, writes_las
from .runtime import python_filter
from .writerlimits import las_headers, las_version

_SCRIPT = f"""\
def stage(ins, outs):
    both = ins["Classification"]
    outs["Classification"] = both & {LEGACY_LIMIT}
    outs["ClassFlags"] = both >> {LEGACY_LIMIT.bit_length()}
    return True
"""
_CONVERT = (
    'Write the older files as LAS 1.4 first: pdal-stages pipeline, with the file and {"type": "writers.las", "filename": '
    '"new.laz", "forward": "all", "extra_dims": "all", "minor_version": 4, "dataformat_id": 6} (7 with colours)'
)


def splitter(stages: list[dict[str, Any]]) -> tuple[dict[str, Any], int] | None:
    """A filter that parts classes from flags, and the number of the last reader, after which it belongs.

    None where flags come through as they are.

    Raises
    ------
    PipelineError
        Where flags would be lost or become classes, and cannot be parted.
    """
    if pdal_env.splits_class_flags():
        return None
    writers = [n for n, stage in enumerate(stages) if is_writer(stage, stages)]
    others = [n for n in range(len(stages)) if n not in writers]
    readers = [n for n in others if (stages[n].get("type") or "readers.").startswith("readers.")]
    old = [header.point_format <= 5 for header in las_headers(stages[n] for n in readers)]
    if not writers or not any(old):
        return None
    fit = [_holds_both(stages[n], stages[:n]) for n in writers]
    if all(old) and all(fit):
        return None
    if not all(old) or any(fit):
        raise PipelineError(
            "this PDAL cannot bring the flags (synthetic, key-point, withheld) of LAS 1.0-1.3 into a pipeline with LAS 1.4",
            found=f"PDAL {pdal_env.dotted_version()}, {'writers' if all(old) else 'readers'} of both",
            cure=_CONVERT,
        )
    last = readers[-1]
    tags = {str(stages[n]["tag"]) for n in readers if "tag" in stages[n]}
    if any(tags & set(_inputs(stage)) for stage in stages[last + 1 :]):
        raise PipelineError(
            "this PDAL can write the flags of LAS 1.0-1.3 as other formats only where 'inputs' names no reader",
            found=f"inputs {', '.join(sorted(tags))}",
            cure=_CONVERT,
        )
    return python_filter("pdal_stages_class_flags", _SCRIPT, {}, {"ClassFlags": "uint8_t"}), last


def _inputs(stage: Mapping[str, Any]) -> list[str]:
    names = stage.get("inputs", [])
    return [names] if isinstance(names, str) else [str(name) for name in names]


def _holds_both(writer: dict[str, Any], before: Sequence[dict[str, Any]]) -> bool:
    """Whether a writer puts class and flags into one byte, as they were read."""
    if writer.get("type") == "writers.copc" or not writes_las(writer):
        return False
    return las_version(writer, before)[1] <= 5
