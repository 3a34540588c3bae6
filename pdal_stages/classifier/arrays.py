"""Arrays in and out of ``.npy`` bytes: NumPy's own header reader, behind a check of sizes; nothing is unpickled.

``np.load`` is not used on files from outside because it allocates what a header says. Here an array is a view
of the bytes that are there, and its size must be theirs.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError

_MAGIC = b"\x93NUMPY\x01\x00"


@dataclass(frozen=True)
class ArrayRule:
    """What an algorithm expects of one of its arrays."""

    dtypes: tuple[str, ...]  #: allowed types, as NumPy writes them: ``<f4``
    ndim: int  #: number of axes


def to_bytes(array: npt.NDArray[Any]) -> bytes:
    """The array as ``.npy`` bytes (version 1.0, little-endian, C order)."""
    array = np.asarray(array)
    little = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    out = io.BytesIO()
    np.lib.format.write_array(out, little, version=(1, 0), allow_pickle=False)
    return out.getvalue()


def from_bytes(data: bytes, rule: ArrayRule, name: str) -> npt.NDArray[Any]:
    """The array in ``.npy`` bytes, if it is what `rule` says; a view of `data`, read-only."""
    if data[:8] != _MAGIC:
        raise ModelError("an array is not in the .npy format, version 1.0", found=name)
    stream = io.BytesIO(data)
    stream.seek(len(_MAGIC))
    try:
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except (ValueError, RecursionError, MemoryError) as error:
        raise ModelError(f"the header of the array '{name}' cannot be read", found=str(error)[:80]) from None
    if fortran or dtype.str not in rule.dtypes or len(shape) != rule.ndim:
        raise ModelError(
            f"the array '{name}' must be {' or '.join(rule.dtypes)} with {rule.ndim} axes, in C order",
            found=f"{dtype.str} {shape}",
        )
    start = stream.tell()
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ModelError(
            f"the array '{name}' has another size than its header says",
            found=f"shape {shape}, {len(data) - start:,} bytes",
        )
    return np.frombuffer(data, dtype, offset=start).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
