"""What PDAL gets wrong of LAS files, by version: such a pipeline is refused before any work.

Nothing is repaired around PDAL: `classify` copies LAS files without it (:mod:`.copies`), and for
pipelines one table says which files the PDAL that runs would misread, and the cure. One repair is
kept, since COPC files are usual inputs: see :func:`..base.las.supersede_copc`.
"""

from __future__ import annotations

import glob
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, OptionError, PipelineError, StageError
from ..base.json_types import StageJson
from ..base.las import (
    WAVES,
    LasHeader,
    header_there,
    named_copc,
    records,
    records_of,
)
from ..base.las_points import (
    MOST_ENTRIES,
    Layout,
    entries_of,
    layout_there,
    read_records,
    size_of_entry,
)
from ..base.units import Units
from ..stages.points import CodeLimit
from ..stages.registry import stage_types
from . import pdal as pdal_env
from .inputs_outputs import is_writer, readers_files, writes_las
from .pdal_errors import COPIES, FLAGS_CURE, FLAGS_IN_CLASSES
from .runtime import ExpandedStage
from .spatial_reference import MOVING, projection_records, reference_of

_AS_LAS_14 = '"minor_version": 4 and "dataformat_id": 6 (7 with colors, 8 with near infrared)'


def _unread_keys(path: str, header: LasHeader) -> str:
    numbers = [number for number, data in projection_records(path) if len(data) >= 8]
    return f"LAS 1.{header.minor}" if header.minor >= 4 and 34735 in numbers else ""


def _waveforms(path: str, header: LasHeader) -> str:
    return f"point format {header.point_format}" if header.point_format in WAVES else ""


def _overwritten(path: str, header: LasHeader) -> str:
    return ", ".join(overwritten_names(Layout.of_file(path)))


def _odd_text(path: str, header: LasHeader) -> str:
    with open(path, "rb") as file:
        texts = [file.read(90)[26:90], *(part for r in records(file, header) for part in r[1:4:2])]
    wrong = next((text for text in texts if text.decode(errors="ignore").encode() != text), b"")
    return repr(wrong.rstrip(b"\0"))[1:] if wrong else ""


def _undescribed(path: str, header: LasHeader) -> str:
    data = [data for r, data in records_of(path, b"LASF_Spec") if r.number == 4]
    named = sum(size_of_entry(each) for each in entries_of(data[0]) if each[2]) if data else 0
    room = header.extra_bytes - named
    return f"{room:,} bytes of a point" if room > 0 else ""


def _runs_python(stages: Sequence[StageJson]) -> bool:
    return any(stage["type"] in ("filters.python", *stage_types()) for stage in stages)


def _writes_extra(stages: Sequence[StageJson]) -> bool:
    return any(writes_las(stage) and "extra_dims" in stage for stage in stages)


class Fact(NamedTuple):
    """Something that PDAL gets wrong of a file."""

    what: str
    #: Takes a file's path and header; returns the value that shows the fault, and an empty text
    #: where the file does not have it.
    shows: Callable[[str, LasHeader], str]
    cure: str
    until: tuple[int, int, int] | None = None  #: the first version that does not; None: all do
    unless: Collection[str] = ()  #: options of the reader with which it does not
    #: Takes all stages of the pipeline; returns whether it matters to them. By default it does.
    matters: Callable[[Sequence[StageJson]], bool] = bool


_NAMES_EXTRA = ("extra_dims", "ignore_vlr")
#: Facts of inputs, in the order in which they are looked for.
FACTS = (
    Fact(
        "PDAL takes the name of this file for a pattern, and reads others",
        lambda path, _: path if glob.has_magic(path) else "",
        f"Rename it, or run it with {COPIES}, which takes names as they are",
    ),
    Fact(
        "PDAL does not read points with waveforms",
        _waveforms,
        "Convert the file to the format without them: laspy.convert(laspy.read(IN), "
        "point_format_id=N).write(OUT) with N 1 for 4, 3 for 5, 6 for 9, 8 for 10; or run it with "
        f"{COPIES}, which keeps them",
    ),
    Fact(
        "this PDAL reads no spatial reference of LAS 1.4 with GeoTIFF keys",
        _unread_keys,
        'Name it: "default_srs": "EPSG:CODE" of the reader (--readers.las.default_srs); or run it '
        f"with {COPIES}, which reads them",
        until=(2, 4, 0),
        unless=("override_srs", "default_srs", "spatialreference"),
    ),
    Fact(
        "extra bytes are named like dimensions of LAS, so PDAL would overwrite these",
        _overwritten,
        'Read them under other names: readers.las with "ignore_vlr": "LASF_Spec/4" and '
        f'"extra_dims": "Name=type,..."; or run it with {COPIES}, which keeps both',
        unless=_NAMES_EXTRA,
    ),
    Fact(
        "PDAL leaves out extra bytes that the first record of their descriptions does not name",
        _undescribed,
        'Name them: "extra_dims": "Name=type,..." of the reader, or leave "extra_dims" of the '
        f"writer out to drop all; or run it with {COPIES}, which keeps them",
        unless=_NAMES_EXTRA,
        matters=_writes_extra,
    ),
    Fact(
        "filters.python, in which the stages run, takes only texts in UTF-8 from a LAS file",
        _odd_text,
        f"Write the file anew without it, or run it with {COPIES}, which keeps it",
        matters=_runs_python,
    ),
)


def check_inputs(stages: Sequence[StageJson]) -> None:
    """Refuse LAS files that readers among stages would misread.

    Raises
    ------
    PipelineError
        Naming the file, what is wrong and the cure.
    """
    facts = [fact for fact in FACTS if fact.matters(stages)]
    types: dict[str, tuple[str, str]] = {}
    for stage in stages:
        for path in readers_files([stage], las=True):
            if (header := header_there(path)) is None:
                continue  # which reading it reports
            for fact in facts:
                seen = "" if stage.keys() & {*fact.unless} else fact.shows(path, header)
                if seen and (fact.until is None or pdal_env.version() < fact.until):
                    raise PipelineError(fact.what, where=path, found=seen, cure=fact.cure)
            _compare_types(path, layout_there(path), types)


def _compare_types(path: str, layout: Layout | None, types: dict[str, tuple[str, str]]) -> None:
    """Refuse an extra dimension of two types: PDAL takes the first for all values."""
    for name, each in layout.extra_by_name.items() if layout else ():
        kind = each.kind.name
        first, other = types.setdefault(name.lower(), (kind, path))
        if first != kind:
            raise PipelineError(
                f"the extra dimension '{name}' has two types, of which PDAL takes the first",
                found=f"{first} in {other}, {kind} in {path}",
                cure="Give it one type, or write one output per input",
            )


def overwritten_names(layout: Layout) -> list[str]:
    """Return extra dimensions that are named like those of the point format, as PDAL compares.

    But for ClassFlags, the copy of the flags that PDAL before 2.3 itself writes with ``all``.
    """
    names = layout.fields.keys() - layout.extra_by_name.keys() - {"ClassFlags"}
    taken = {"class", "cls", *map(_plain, names)}
    return [each.name for each in layout.extra if _plain(each.name) in taken]


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace(" ", "")


# ---- what is written -----------------------------------------------------------------------------


def las_version(writer: StageJson, before: Sequence[StageJson]) -> tuple[int, int]:
    """Return (minor_version, dataformat_id) that a writer will use.

    They come from its options, the forwarded header, or PDAL's defaults.
    """
    values: list[int | None] = []
    forward, files = str(writer.get("forward", "")), readers_files(before, las=True)
    headers = [header for path in files if (header := header_there(path)) is not None]
    forwards = any(word in forward for word in ("all", "header", "minor_version"))
    for option, of_headers in (
        ("minor_version", {header.minor for header in headers}),
        ("dataformat_id", {header.point_format for header in headers}),
    ):
        try:
            values.append(int(writer[option]))
        except (KeyError, TypeError, ValueError, OverflowError):  # PDAL reports wrong ones
            values.append(of_headers.pop() if forwards and len(of_headers) == 1 else None)
    # PDAL is asked only then: it is another process
    defaults = pdal_env.las_writer_defaults() if None in values else (0, 0)
    minor, format_id = (d if v is None else v for v, d in zip(values, defaults, strict=True))
    return minor, format_id


def check_class_codes(
    stages: list[StageJson], ours: Collection[ExpandedStage], copied: bool = False
) -> None:
    """Refuse class codes and numbers of extra dimensions that a later LAS writer cannot hold.

    Codes that only a run shows are refused then: the last stage that changes classes gets the limit
    in its context (`code_limit`). `copied`: PDAL does not write.
    """
    last = [each for each in ours if "Classification" in each.stage.creates()][-1:]
    for each in ours:
        stage, extra = each.stage, len(each.stage.creates())
        before = stages[: each.index]
        for writer in filter(writes_las, stages[each.index + 1 :]):
            if (limit := _code_limit(writer, before, copied)) is not None:
                each.update_context(code_limit=limit if each in last else None)
                if (largest := max(stage.written_classes(), default=0)) > LEGACY_LIMIT:
                    code = f"code {largest}"
                    raise OptionError(limit[0], where=stage.place, found=code, cure=limit[1])
            if extra > MOST_ENTRIES and str(writer.get("extra_dims", "")).strip() == "all":
                raise DimensionError(
                    "LAS cannot hold so many extra dimensions: one record describes "
                    f"{MOST_ENTRIES} of them",
                    where=stage.place,
                    found=f"{extra} features",
                    cure="Take fewer neighborhoods or features, write to a format without the "
                    "limit (writers.text, writers.tiledb), or use writers.classifiermodel and "
                    "filters.modelclassifier, which need no dimensions",
                )


def _code_limit(writer: StageJson, before: list[StageJson], copied: bool) -> CodeLimit | None:
    """Return why codes above 31 do not fit; None where all do."""
    if writer["type"] == "writers.copc":
        return None
    minor, format_id = las_version(writer, before)
    if format_id <= 5:
        what = (
            f"class codes above {LEGACY_LIMIT} do not fit the LAS file that writers.las would "
            f"write (LAS 1.{minor}, dataformat_id {format_id})"
        )
        return CodeLimit(what, f"Give writers.las {_AS_LAS_14}")
    if copied or not _compresses(writer) or pdal_env.compresses_las_14():
        return None
    what = f"this PDAL cannot compress LAS 1.4 with class codes above {LEGACY_LIMIT}"
    return CodeLimit(what, "Name the output .las, use PDAL 2.3, or run pdal-stages classify")


def _compresses(writer: StageJson) -> bool:
    named = str(writer.get("filename", "")).lower().endswith(".laz")
    return named or str(writer.get("compression", "")).lower() not in ("", "none", "false")


#: Writers that write no classes of points.
_NO_CLASSES = ("writers.gdal", "writers.null", "writers.raster", *stage_types())


def check_flags(stages: Sequence[StageJson]) -> None:
    """Refuse flags of LAS 1.0-1.3 that PDAL before 2.6 would make parts of classes.

    It does where the points come together with those of LAS 1.4, or are written to another format.
    """
    writers = [s for s in stages if is_writer(s) and s["type"] not in _NO_CLASSES]
    if not writers and not any(stage["type"] in stage_types() for stage in stages):
        return
    formats = {
        path: header.point_format
        for path in readers_files(stages, las=True)
        if (header := header_there(path)) is not None
    }
    old = [path for path, number in formats.items() if number <= 5]
    if not old or pdal_env.splits_class_flags():
        return
    apart = [w for w in writers if not (writes_las(w) and las_version(w, stages)[1] <= 5)]
    for path in old if apart or len(old) < len(formats) else ():
        layout = Layout.of_file(path)
        for part in read_records(path, layout, only=["Classification"]):
            if (layout.fields["Classification"].numbers(part) > LEGACY_LIMIT).any():
                raise PipelineError(FLAGS_IN_CLASSES, where=path, cure=FLAGS_CURE)


def check_copc_outputs(stages: Iterable[StageJson]) -> None:
    """Refuse a plain LAZ file under the name of a COPC file."""
    for stage in stages:
        name = str(stage.get("filename", ""))
        if stage["type"] == "writers.las" and named_copc(name):
            cure = 'Use "type": "writers.copc" of PDAL 2.4 or later, or name the output .laz'
            raise PipelineError("writers.las writes plain LAZ, not COPC", found=name, cure=cure)


def check_units(stages: Sequence[StageJson]) -> None:
    """Refuse LAS 1.0-1.3 whose units across and upward differ: GDAL's keys have one of them.

    Where a stage moves points, or the writer names a reference, nothing is known.
    """
    if any(stage["type"] in MOVING or "a_srs" in stage for stage in stages):
        return
    writers = [stage for stage in stages if stage["type"] == "writers.las"]
    versions = [las_version(writer, stages)[0] for writer in writers]
    if min(versions, default=4) >= 4:
        return
    for stage, path in [(s, p) for s in stages for p in readers_files([s], las=True)[:1]]:
        units = Units()
        with suppress(StageError):  # which stages that need units report
            units = reference_of({**stage, "filename": path}).units
        if units.horizontal != units.vertical:
            raise PipelineError(
                f"PDAL would write the unit of z as that of x and y into LAS 1.{min(versions)}",
                where=path,
                found=f"{units.horizontal:g} m across, {units.vertical:g} m upward",
                cure='Give writers.las "minor_version": 4, or run pdal-stages classify',
            )
