"""Classify LAS files without PDAL: dimensions are read, stages run on them, and a copy is written.

The copy is the input, byte for byte, but for what :data:`..base.las_copy.CHANGES` lists. A pipeline
that is more than a LAS file, stages of ours and a LAS file is PDAL's (:mod:`.run`).
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.json_types import StageJson
from ..base.las import named_copc, number_type, pdal_type
from ..base.las_copy import LasCopy
from ..base.las_points import PART, Layout, describe, read_records
from ..base.messages import Message
from ..stages.points import SELECTED, warning_of_no_match
from ..stages.registry import stage_types
from ..stages.where_expression import Expression
from . import pdal as pdal_env
from .inputs_outputs import LAS_READERS, is_las
from .runtime import ExpandedStage
from .spatial_reference import records_for, reference_of_las

#: Options of a reader that are applied here; others are PDAL's.
_READER = {"type", "filename", "tag", "use_eb_vlr", "override_srs", "default_srs"}
#: Options of a writer that keeps everything.
_WRITER = {"type", "filename", "tag", "forward"}


def read_here(stages: Sequence[StageJson]) -> bool:
    """Return whether a pipeline reads LAS files that need no PDAL, and all its filters are ours."""
    for stage in stages:
        kind, names = stage["type"], stage.get("filename")
        if kind.startswith("readers."):
            listed = names if isinstance(names, list) else [names]
            plain = kind in LAS_READERS and stage.keys() <= _READER
            if not (plain and all(is_las(str(name)) for name in listed)):
                return False
        elif kind.startswith("filters.") and kind not in (*stage_types(), "filters.merge"):
            return False
    return True


def written_here(stages: Sequence[StageJson]) -> bool:
    """Return whether a pipeline writes a LAS file that keeps everything, and nothing else."""
    writers = [stage for stage in stages if stage["type"].startswith("writers.")]
    if len(writers) != 1 or writers[0]["type"] != "writers.las" or not writers[0].keys() <= _WRITER:
        return False
    name = str(writers[0]["filename"])
    named = is_las(name) or Path(name).name == "#"  # which takes the name of the input
    return named and not named_copc(name) and writers[0].get("forward") == "all"


def run_stages(
    ours: Iterable[ExpandedStage],
    columns: Mapping[str, NDArray],
    wkt: str,
    known: Mapping[str, NDArray] | None = None,
    after: Callable[[ExpandedStage, Mapping[str, NDArray]], None] | None = None,
) -> ChainMap[str, NDArray]:
    """Run stages on dimensions, one after the other; return these with what the stages changed.

    Parameters
    ----------
    ours : iterable of ExpandedStage
    columns : mapping
        The dimensions of the input.
    wkt : str
        Its spatial reference.
    known : mapping, optional
        Dimensions that stand before those of the input.
    after : callable, optional
        Called after each stage with it and the dimensions.
    """
    new: dict[str, NDArray] = dict(known or {})
    seen: ChainMap[str, NDArray] = ChainMap(new, columns)  # type: ignore[arg-type]
    for each in ours:
        for name, kind in each.stage.creates().items():
            if name not in new and name != "Classification":
                values = np.zeros(len(seen["X"]), number_type(kind))
                if name in columns:  # what the input has counts as a result of an earlier run
                    values[:] = columns[name]
                new[name] = values
        each.function({"spatialreference": {"wkt": wkt}}, seen, new)
        if after is not None:
            after(each, seen)
    return seen


def selection(where: str | None, columns: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the dimension that marks points for which a condition holds, as they come in."""
    if not where:
        return {}
    return {SELECTED: Expression(where).evaluate(columns).astype(np.uint8)}


def describe_selection(where: str | None, known: Mapping[str, NDArray]) -> list[Message]:
    """Return a message where a condition selects no point."""
    chosen = known.get(SELECTED)
    nothing = chosen is not None and len(chosen) and not chosen.any()
    return [warning_of_no_match(str(where))] if nothing else []


def copy_of(
    source: str, layout: Layout, target: str, added: Mapping[str, str], reader: StageJson
) -> LasCopy:
    """Return a copy that is to be written; `added` maps names of dimensions to PDAL types.

    The reader's ``override_srs`` replaces the reference system, ``default_srs`` a missing one.
    """
    named = reader.get("override_srs")
    if not named and reader.get("default_srs") and not reference_of_las(source)[0]:
        named = reader["default_srs"]
    projection = records_for(str(named), source) if named else None
    kinds = {name: number_type(kind) for name, kind in added.items()}
    return LasCopy(source, layout, target.lower().endswith(".laz"), kinds, projection)


def write_copy(copy: LasCopy, target: Path, values: Mapping[str, NDArray]) -> None:
    """Write all points of a file with new values (n,), in parts."""
    names = ["Classification", *copy.replaced, *copy.added]
    at = 0
    with copy.writing_to(target):
        for records in read_records(copy.source, copy.layout, most=PART):
            end = at + len(records)
            copy.write(records, {n: values[n][at:end] for n in names if n in values})
            at = end


#: The first version of PDAL whose option ``extra_dims`` counts before a record.
_OPTION_FIRST = (2, 9, 0)


def layout_read_by(reader: StageJson, path: str) -> Layout:
    """Return the layout of a file with the names that its reader gives to extra bytes, as PDAL.

    ``extra_dims`` names those that no record describes, and from PDAL 2.9 on all; ``ignore_vlr``
    may leave that record out, which in LAS 1.0 to 1.3 counts with ``use_eb_vlr`` alone.
    """
    layout = Layout.of_file(path)
    named = str(reader.get("extra_dims", "")).strip()
    is_read = layout.header.minor >= 4 or str(reader.get("use_eb_vlr", "")).lower() == "true"
    is_read = is_read and bool(layout.described) and _DESCRIPTIONS not in _ignored(reader)
    if not named or (is_read and pdal_env.version() < _OPTION_FIRST):
        return layout
    pairs = (part.split("=") for part in named.replace(" ", "").split(","))
    data = b"".join(describe(name, number_type(kind)) for name, kind in pairs)
    return Layout.of_file(path, data)


def reader_of_copy(reader: StageJson) -> StageJson:
    """Return a reader for copies, whose record describes all extra bytes."""
    plain = {name: value for name, value in reader.items() if name != "extra_dims"}
    if "ignore_vlr" in plain:
        plain["ignore_vlr"] = ",".join(_ignored(reader) - {_DESCRIPTIONS})
        if not plain["ignore_vlr"]:
            del plain["ignore_vlr"]
    return {**plain, "use_eb_vlr": True}


_DESCRIPTIONS = "LASF_Spec/4"


def _ignored(reader: StageJson) -> set[str]:
    """Return the records that a reader leaves out, as ``USER/NUMBER``."""
    listed = reader.get("ignore_vlr", ())
    words = listed.split(",") if isinstance(listed, str) else map(str, listed)
    return {word.strip() for word in words} - {""}


def named_types(layout: Layout) -> dict[str, str]:
    """Return the extra dimensions of a file with PDAL's names of their types."""
    return {name: pdal_type(each.kind) for name, each in layout.extra_by_name.items()}


def extra_dims_option(layout: Layout | None, added: Mapping[str, str]) -> str:
    """Return the option of ``writers.las``: an input's extra dimensions and those that are added.

    Before PDAL 2.3 ``all`` adds the flags of LAS 1.4. It is ``all`` where the input is no LAS file.
    """
    if layout is None:
        return "all"
    return ",".join(f"{name}={kind}" for name, kind in {**named_types(layout), **added}.items())
