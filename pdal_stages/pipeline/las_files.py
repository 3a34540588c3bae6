"""LAS files: points in parts, limits of outputs, and workarounds where old PDAL writes wrongly.

PDAL before 2.3 cannot compress LAS 1.4 with class codes above 31. PDAL before 2.6 reads the flags
of LAS 1.0-1.3 (synthetic, key-point, withheld) as the upper bits of the class: written as LAS 1.4,
a withheld point of class 2 would become one of class 130.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, OptionError, PipelineError, StageError
from ..base.las import (
    POINTWISE,
    LasHeader,
    header_there,
    laszip_record,
    named_copc,
    named_las,
    read_header,
    set_geotiff_unit,
    supersede_copc,
)
from ..base.las_repair import (
    MOST_ENTRIES,
    corrected,
    extra_dimensions,
    restore_titles,
)
from ..stages.registry import stage_types
from . import pdal as pdal_env
from .inputs_outputs import is_reader, is_writer, readers_files, writes_las
from .runtime import ExpandedStage, python_filter

_AS_LAS_14 = '"minor_version": 4 and "dataformat_id": 6 (7 with colors, 8 with near infrared)'


def las_version(writer: Mapping[str, Any], before: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Return (minor_version, dataformat_id) that a writer will use.

    They come from its options, the forwarded header, or PDAL's defaults.
    """
    values: list[int | None] = []
    forward, headers = str(writer.get("forward", "")), las_headers(before)
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


def las_headers(readers: Sequence[Mapping[str, Any]]) -> list[LasHeader]:
    """Return the headers of the LAS files that stages read, where they can be read."""
    return [h for h in map(header_there, readers_files(readers, las=True)) if h is not None]


def extra_dims_option(sources: Sequence[str], created: Mapping[str, str]) -> str:
    """Return the writers' option: the inputs' extra dimensions and those `created`.

    `created` maps names to PDAL types. The option is ``all`` where an input is no LAS file.
    """
    if not all(map(named_las, sources)):
        return "all"
    dimensions: dict[str, str] = {}
    for source in sources:
        dimensions |= extra_dimensions(source)
    return ",".join(f"{name}={kind}" for name, kind in {**dimensions, **created}.items())


def finish(output: Path, sources: Iterable[str], unit: float | None = None) -> None:
    """Correct in a LAS output what PDAL forwards wrongly; other outputs stay as they are.

    Parameters
    ----------
    output : Path
    sources : iterable of str
        The files it was made from.
    unit : float, optional
        The unit of its x and y in meters, where it is that of the sources.
    """
    supersede_copc(output)
    if named_las(output):
        sources = list(sources)
        restore_titles(output, sources)
        if unit is not None:
            set_geotiff_unit(output, unit)


# ---- limits, checked before any work -------------------------------------------------------------


def check_las_limits(stages: list[dict[str, Any]], ours: Collection[ExpandedStage]) -> None:
    """Refuse class codes and numbers of extra dimensions that a later LAS writer cannot hold.

    Codes that only a run shows are refused then: the last stage that changes classes gets the limit
    in its context (`code_limit`).
    """
    last = [each for each in ours if "Classification" in each.stage.creates()][-1:]
    for each in ours:
        stage, extra = each.stage, len(each.stage.creates())
        for writer in filter(writes_las, stages[each.index + 1 :]):
            if (limit := _code_limit(writer, stages[: each.index])) is not None:
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


def _code_limit(writer: dict[str, Any], before: list[dict[str, Any]]) -> tuple[str, str] | None:
    """Return the message for codes above 31, and the cure; None where all codes fit."""
    if writer["type"] == "writers.copc":
        return None
    minor, format_id = las_version(writer, before)
    if format_id > 5:
        return None
    what = (
        f"class codes above {LEGACY_LIMIT} do not fit the LAS file that writers.las would write "
        f"(LAS 1.{minor}, dataformat_id {format_id})"
    )
    return what, f"Give writers.las {_AS_LAS_14}"


def check_copc_outputs(stages: list[dict[str, Any]]) -> None:
    """Refuse a plain LAZ file under the name of a COPC file."""
    for stage in stages:
        name = str(stage.get("filename", ""))
        if stage["type"] == "writers.las" and named_copc(name):
            cure = 'Use "type": "writers.copc" of PDAL 2.4 or later, or name the output .laz'
            raise PipelineError("writers.las writes plain LAZ, not COPC", found=name, cure=cure)


# ---- flags of LAS 1.0-1.3, before PDAL 2.6 -------------------------------------------------------

# PDAL calls this for the points of one file after the other.
_SPLIT = f"""\
files = iter(())
def stage(ins, outs):
    global files
    old = next(files, None)
    if old is None:
        files = iter(pdalargs["old"])
        old = next(files)
    both = ins["Classification"]
    if old:
        outs["Classification"] = both & {LEGACY_LIMIT}
        outs["ClassFlags"] = both >> {LEGACY_LIMIT.bit_length()}
    return True
"""


def files_with_flags_to_split(
    stages: Sequence[dict[str, Any]], with_ours: bool = True
) -> list[bool]:
    """Return for each input file whether flags must be split from the class; empty for none.

    A writer of LAS 1.0-1.3 writes both into one byte, as they were read. `with_ours`: our stages
    are involved; without them, text and rasters come out as PDAL makes them.
    """
    if pdal_env.splits_class_flags():
        return []
    readers = filter(is_reader, stages)
    formats = [[header.point_format for header in las_headers([reader])] for reader in readers]
    old = [number <= 5 for numbers in formats for number in numbers or [6]]
    if True not in old:
        return []
    mixed = any(number > 5 for numbers in formats for number in numbers)
    writers = [s for s in stages if is_writer(s) and s["type"] not in stage_types()]
    written = [las_version(writer, stages)[1] > 5 for writer in filter(writes_las, writers)]
    together, apart = False in written, True in written
    if together and (apart or mixed):
        raise PipelineError(
            "this PDAL cannot carry the flags (synthetic, key-point, withheld) of LAS 1.0-1.3 into "
            "a pipeline with LAS 1.4",
            found=f"PDAL {pdal_env.dotted_version()}",
            cure=f"Give all LAS writers {_AS_LAS_14}, or use PDAL 2.6",
        )
    needed = apart or (with_ours and (writers or mixed))
    return old if needed and not together else []


def flag_splitter(old: Sequence[bool], **wiring: Any) -> dict[str, Any]:
    """Return a filter that moves flags to the dimension that they have in LAS 1.4.

    `old`: see :func:`files_with_flags_to_split`; `wiring`: the filter's tag and inputs.
    """
    adds = {"ClassFlags": "uint8_t"}
    return {**python_filter("pdal_stages_class_flags", _SPLIT, {"old": list(old)}, adds), **wiring}


# ---- LAZ with class codes above 31, before PDAL 2.3 ----------------------------------------------

UNCOMPRESSED = ".uncompressed.las"
_BLOCK = 1_000_000  #: points that are compressed at a time


def uncompressed_writer(writer: dict[str, Any], before: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the writer, or where PDAL would fail to compress an uncompressed one.

    :func:`compress` follows it.
    """
    if pdal_env.compresses_las_14() or writer["type"] != "writers.las":
        return writer
    named = str(writer.get("filename", "")).lower().endswith(".laz")
    compresses = named or str(writer.get("compression", "")).lower() not in ("", "none", "false")
    if not compresses or las_version(writer, before)[1] <= 5:
        return writer
    plain = {key: value for key, value in writer.items() if key != "compression"}
    return {**plain, "filename": f"{writer['filename']}{UNCOMPRESSED}"}


def compress(partials: Iterable[Path]) -> dict[str, str]:
    """Compress files that were left uncompressed; return their old names -> their new names."""
    names: dict[str, str] = {}
    folders = {partial.parent for partial in partials}
    for path in [path for folder in folders for path in sorted(folder.glob(f"*{UNCOMPRESSED}"))]:
        target = path.with_name(path.name.removesuffix(UNCOMPRESSED))
        import laspy  # which takes a moment

        supersede_copc(path)  # of a COPC file that was read, whose record laspy does not write
        try:
            with laspy.open(path) as source:
                header = source.header
                with laspy.open(target, "w", header=header, do_compress=True) as out:
                    for points in source.chunk_iterator(_BLOCK):
                        out.write_points(points)
                    if header.evlrs:
                        out.write_evlrs(header.evlrs)
        except Exception as error:  # laspy and lazrs raise many types
            what = "the output file could not be compressed"
            raise StageError(what, found=f"{target}: {error}") from error
        path.unlink()
        names[str(path)] = str(target)
    return names


# ---- points in parts -----------------------------------------------------------------------------

#: Points read at a time: 30 to 70 MB as LAS stores them.
PART = 1_000_000
_LASPY = {
    "ReturnNumber": "return_number",
    "NumberOfReturns": "number_of_returns",
    "GpsTime": "gps_time",
}


def can_read_chunks(path: str) -> bool:
    """Return whether parts of a file can be read: whether it is a LAS, LAZ or COPC file."""
    return named_las(path) and read_header(path) is not None


def read_columns(
    path: str, wanted: Sequence[str], only: Sequence[str] = ()
) -> Iterator[tuple[dict[str, NDArray], bool]]:
    """Yield coordinates, classes, withheld flags and the `wanted` dimensions that exist.

    The second value of each part tells whether classes hold flags. LAS and LAZ files are read in
    parts (`only`: see :func:`read_chunks`), others at once by PDAL.
    """
    always = ("X", "Y", "Z", "Classification", "Withheld")
    if can_read_chunks(path):
        for chunk in read_chunks(path, only=only):
            there = set(chunk.point_format.dimension_names)
            columns = {name: chunk[name.lower()] for name in always}
            for name in wanted:
                if (known := _LASPY.get(name, name)) in there:
                    columns[name] = chunk[known]
            yield {name: np.asarray(column) for name, column in columns.items()}, False
        return
    run = pdal_env.execute([pdal_env.reader_of(path, "input")])
    for array in run.arrays:
        names = [name for name in (*always, *wanted) if name in array.dtype.names]
        flags = pdal_env.flags_inside_classification(array.dtype.names, run.metadata)
        yield {name: np.asarray(array[name]) for name in names}, flags


def read_chunks(
    path: str, start: int = 0, end: int | None = None, most: int = PART, only: Sequence[str] = ()
) -> Iterator[Any]:
    """Yield the points of a LAS or LAZ file from one number to another, as laspy reads them.

    Parameters
    ----------
    path : str
    start, end : int
        Numbers of the first point and of the one after the last; by default all are read.
    most : int
        Points of each part.
    only : sequence of str
        Dimensions that are needed beside X, Y and the returns, by laspy's names of its selections
        (``Z``, ``CLASSIFICATION``, ...): LAZ 1.4 compresses them separately, so skipping the others
        saves time. Those are zero then.
    """
    import laspy

    options = {}
    if only:
        selection = laspy.DecompressionSelection.base()
        for name in only:
            selection |= laspy.DecompressionSelection[name]
        options["decompression_selection"] = selection
    at, what = start, "the input cannot be read"
    try:
        with open_las(path, **options) as reader:
            what = "the input is damaged"
            end = int(reader.header.point_count) if end is None else end
            if start:
                reader.seek(start)
            while at < end and len(chunk := reader.read_points(min(most, end - at))):
                at += len(chunk)
                yield chunk
    except (GeneratorExit, KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # the decompressor's panics are no Exceptions
        reason: object = f"{type(error).__name__} at point {at:,}: {error}"
        reason = error if isinstance(error, OSError) else reason
        raise StageError(what, where=path, found=reason) from None
    if at != end:
        raise StageError("the input is cut short", where=path, found=f"{at:,} of {end:,} points")


def open_las(path: str, **options: Any) -> Any:
    """Open a LAS or LAZ file with laspy, corrected where PDAL reads a corrected copy of it.

    Points that were compressed one by one are not decompressed in parallel.
    """
    import laspy

    header = read_header(path)
    with open(path, "rb") as file:
        coding = laszip_record(file, header) if header and header.compressed else b""
    if coding.startswith(POINTWISE):
        options["laz_backend"] = laspy.LazBackend.Lazrs
    return laspy.open(corrected(path) or path, **options)


def laspy_header(path: str) -> Any:
    """Return the header of a file with its records.

    Those of COPC are left out: they do not fit points in another order.
    """
    import laspy

    try:
        with open_las(path) as reader:
            header = reader.header
        header.point_format.dtype()  # of extra bytes that no array can hold
        if header.version.minor == 0:  # which laspy does not write, and PDAL writes as LAS 1.2
            header.version = laspy.header.Version(1, 2)
    except Exception as error:  # laspy raises many types
        reason = f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=reason) from None
    for keys in header.vlrs.get("GeoKeyDirectoryVlr"):  # laspy counts its padding as keys
        keys.geo_keys_header.number_of_keys = sum(key.id > 0 for key in keys.geo_keys)
    for records in filter(None, (header.vlrs, header.evlrs)):
        records[:] = [record for record in records if record.user_id != "copc"]
    return header
