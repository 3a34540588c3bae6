"""LAZ 1.4 with class codes above 31, which PDAL 2.2 fails to compress at the end of its work.

It writes them well without compression. So it writes LAS, which lazrs then packs, in the hidden folder of the output.
"""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from ..base.errors import StageError
from ..base.las import POINT_BYTES, LasHeader, read_header
from . import pdal as pdal_env
from .filenames import is_writer, with_outputs
from .writerlimits import compresses, las_version

UNPACKED = ".unpacked.las"
#: Points that are packed at a time.
_BLOCK = 1_000_000


def unpacked(stages: list[dict[str, Any]], partials: Sequence[Path]) -> list[dict[str, Any]]:
    """Stages whose writers write to hidden files, some of them for :func:`pack`."""
    out = with_outputs(stages, list(partials))
    return [
        unpacked_writer(stage, stages[:number]) if is_writer(stage, out) else stage
        for number, stage in enumerate(out)
    ]


def unpacked_writer(writer: dict[str, Any], before: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """A writer that leaves compressing to :func:`pack`, where PDAL would fail in it."""
    if (
        pdal_env.writes_extended_classes_to_laz()
        or writer.get("type") not in ("writers.las", None)
        or not compresses(writer)
        or las_version(writer, before)[1] <= 5
    ):
        return writer
    plain = {key: value for key, value in writer.items() if key != "compression"}
    return {**plain, "filename": f"{writer['filename']}{UNPACKED}"}


def pack(partials: Iterable[Path]) -> dict[str, str]:
    """Compress what was left to be compressed; the names that files had -> those that they have now.

    Raises
    ------
    StageError
        If a file cannot be written.
    """
    names: dict[str, str] = {}
    for folder in {partial.parent for partial in partials}:
        for made in sorted(folder.glob(f"*{UNPACKED}")):
            target = made.with_name(made.name.removesuffix(UNPACKED))
            _pack(made, target)
            names[str(made)] = str(target)
    return names


def packed_head(head: bytes, header: LasHeader) -> tuple[bytes, Any]:
    """All before the points of a file that is not compressed, as one has it that is, and how lazrs compresses its points."""
    import lazrs

    more = header.point_bytes - POINT_BYTES[header.point_format]
    coding = lazrs.LazVlr.new_for_compression(header.point_format, more)
    data = bytes(coding.record_data())
    # As PDAL writes it (LAS 1.4 R15, table 4): two bytes, whose, number, length, title.
    record = struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(data), b"http://laszip.org") + data
    first = bytearray(head[: header.header_bytes])
    struct.pack_into("<II", first, 96, header.offset + len(record), header.records + 1)
    first[104] |= 0x80
    return bytes(first) + record + head[header.header_bytes :], coding


def compress(out: BinaryIO, coding: Any, blocks: Iterable[Any]) -> None:
    """Write points, as bytes or arrays of bytes, compressed as `coding` of lazrs says, where a file stands.

    Raises
    ------
    StageError
        If they cannot be compressed.
    OSError
        If the file cannot be written.
    """
    import lazrs

    try:
        packer = lazrs.ParLasZipCompressor(out, coding)
        for block in blocks:
            packer.compress_many(block)
        packer.done()
    except (ValueError, RuntimeError, lazrs.LazrsError) as error:
        raise StageError(
            "the output file could not be compressed", found=f"{getattr(out, 'name', '')}: {error}"
        ) from error


def _blocks(source: BinaryIO, header: LasHeader) -> Iterator[bytes]:
    left = header.count * header.point_bytes
    while left > 0:
        block = source.read(min(left, _BLOCK * header.point_bytes))
        if not block:
            raise ValueError("it ends before its last point")
        yield block
        left -= len(block)


def _pack(made: Path, target: Path) -> None:
    """The file with its points compressed; header and records stay as PDAL wrote them, and one record is added."""
    import lazrs

    header = read_header(made)
    if header is None:
        raise StageError("the output file could not be written completely", found=str(target))
    try:
        with open(made, "rb") as source, open(target, "x+b") as out:
            head, coding = packed_head(source.read(header.offset), header)
            out.write(head)
            compress(out, coding, _blocks(source, header))
            if header.records_after:
                out.seek(0, os.SEEK_END)
                place = out.tell()
                source.seek(header.after)
                shutil.copyfileobj(source, out)
                out.seek(235)
                out.write(struct.pack("<Q", place))
        os.unlink(made)
    except (OSError, ValueError, RuntimeError, lazrs.LazrsError) as error:
        raise StageError("the output file could not be compressed", found=f"{target}: {error}") from error


def renamed(node: Any, names: dict[str, str]) -> Any:
    """Metadata with the names that files have in the end."""
    if isinstance(node, dict):
        return {key: renamed(value, names) for key, value in node.items()}
    if isinstance(node, list):
        return [renamed(value, names) for value in node]
    return names.get(node, node) if isinstance(node, str) else node
