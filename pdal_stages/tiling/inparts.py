"""A large file's output, written part by part, so that memory does not grow with the file."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ..base.files import whole_files
from ..base.lascheck import check_complete
from .lasfiles import BLOCK, header_of, open_las, read_block, record_blocks, write_records
from .results import NewValues
from .sources import InputSource
from .store import check_run
from .tail import run_tail, written


class HeadersDifferError(Exception):
    """Parts cannot be joined: the writer gives them different headers."""


def write_in_parts(
    source: InputSource,
    count: int,
    most: int,
    new_values: Callable[[int, int], NewValues],
    tail: list[dict[str, Any]],
    outputs: list[str],
    scratch: str,
) -> dict[str, Any]:
    """Write the outputs of a file with `count` points, `most` points at a time.

    Each part goes through the pipeline's own tail and writer into an uncompressed file; their points are then
    joined under the first part's header. `new_values` gives the results of points from one number to another.

    Raises
    ------
    HeadersDifferError
        Nothing is written then.
    """
    joined: list[_Joined] = []

    def check(made: Path, final: Path, number: int) -> None:
        check_run(scratch)
        check_complete(made, final, {"type": "writers.las", "filename": final}, joined[number].count)

    with whole_files(*outputs, check=check) as partials, contextlib.ExitStack() as stack:
        joined += [stack.enter_context(contextlib.closing(_Joined(p))) for p in partials]
        folder = stack.enter_context(TemporaryDirectory(dir=scratch, ignore_cleanup_errors=True))
        for start in range(0, count, most):
            end = min(count, start + most)
            piece = os.path.join(folder, "part.las")
            write_records(piece, header_of(source.path), record_blocks(source.path, start, end))
            parts = [os.path.join(folder, f"out{n}.las") for n in range(len(outputs))]
            reader = {**source.reader, "filename": piece}
            run_tail([reader], [new_values(start, end)], _uncompressed(tail), parts, scratch)
            for one, part in zip(joined, parts, strict=True):
                one.add(part)
    return written(outputs, joined[0].count if joined else 0)


def _uncompressed(tail: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {k: v for k, v in s.items() if k != "compression"} if s["type"] == "writers.las" else s for s in tail
    ]


class _Joined:
    """A LAS or LAZ file made of others with one header."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = path, 0
        self._writer: Any = None
        self._head: Any = None

    def add(self, part: str) -> None:
        """Append the points of a file."""
        import laspy

        with open_las(part) as reader:
            header = reader.header
            head = (
                *header.scales.tolist(),
                *header.offsets.tolist(),
                header.point_format,
                str(header.version),
                [(v.user_id, v.record_id, v.record_data_bytes()) for v in header.vlrs],
            )
            if self._writer is None:
                self._head = head
                self._writer = laspy.open(
                    self.path, mode="w", header=header, do_compress=self.path.suffix.lower() == ".laz"
                )
            elif head != self._head:
                raise HeadersDifferError
            total = int(header.point_count)
            for first in range(0, total, BLOCK):
                self._writer.write_points(read_block(reader, part, first, total))
            self.count += total
        os.unlink(part)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
