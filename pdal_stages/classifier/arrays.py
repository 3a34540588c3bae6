"""Arrays in and out of ``.npy`` bytes, with a strict header of one known form and nothing executed.

NumPy's own reader is not used on files from outside: it parses the header as Python source and
allocates what the header says. Here the header must be, byte for byte, the one NumPy writes for a
little-endian number array in C order, and its size must be the size of the bytes that follow.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError

_HEADER = re.compile(
    rb"\{'descr': '([<|][iufb][1248])', 'fortran_order': False, "
    rb"'shape': \(((?:\d{1,15}, ?)*\d{0,15},?)\), \} *\n"
)
_MAGIC = b"\x93NUMPY\x01\x00"


@dataclass(frozen=True)
class ArrayRule:
    """What an algorithm expects of one of its arrays.

    Attributes
    ----------
    dtypes : tuple of str
        Allowed types, as NumPy writes them: ``<f4``.
    ndim : int or None
        Number of axes; None where any will do.
    """

    dtypes: tuple[str, ...]
    ndim: int | None = None


def to_bytes(array: npt.NDArray[Any]) -> bytes:
    """The array as ``.npy`` bytes (version 1.0, little-endian, C order)."""
    array = np.asarray(array)
    little = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    out = io.BytesIO()
    np.lib.format.write_array(out, little, version=(1, 0), allow_pickle=False)
    return out.getvalue()


def from_bytes(data: bytes, rule: ArrayRule, name: str) -> npt.NDArray[Any]:
    """The array in ``.npy`` bytes, if it is what `rule` says; a view of `data`, read-only."""
    if data[:8] != _MAGIC or len(data) < 10:
        raise ModelError("an array is not in the .npy format, version 1.0", found=name)
    start = 10 + int.from_bytes(data[8:10], "little")
    match = _HEADER.fullmatch(data[10:start])
    if match is None:
        raise ModelError("an array's header is not a plain number array's", found=name)
    kind = match[1].decode()
    shape = tuple(int(part) for part in match[2].split(b",") if part.strip())
    if kind not in rule.dtypes or (rule.ndim is not None and len(shape) != rule.ndim):
        axes = "" if rule.ndim is None else f" with {rule.ndim} axes"
        raise ModelError(
            f"the array '{name}' must be {' or '.join(rule.dtypes)}{axes}", found=f"{kind} {shape}"
        )
    dtype = np.dtype(kind)
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ModelError(
            f"the array '{name}' has another size than its header says",
            found=f"shape {shape}, {len(data) - start:,} bytes",
        )
    return np.frombuffer(data, dtype, offset=start).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
