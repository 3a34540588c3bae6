"""Hashes of points by their values alone: splitmix64 (Steele, Lea, Flood 2014); fingerprints."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

#: Values hashed at a time: few enough to stay in a core's cache.
_BATCH = 1 << 16
#: What splitmix64 adds before it mixes.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def digest_of_file(path: str | os.PathLike) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while data := file.read(1 << 24):
            digest.update(data)
    return digest.hexdigest()


def finalize(h):
    """Return the finalizer of splitmix64 of a uint64: an array, or in a kernel a number.

    Kernels take it through ``njit(forceinline=True)(finalize)``.
    """
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


def hash_rows(columns: Iterable[npt.ArrayLike], seed: int) -> npt.NDArray[np.uint64]:
    """Return a 64-bit hash (n,) of each point's values and the seed.

    Every bit of the values counts, but -0.0 is 0.0. Each column is an array (n,) of any type, such
    as one axis of the coordinates; there must be at least one.
    """
    arrays = [np.asarray(column) for column in columns]
    out = np.empty(len(arrays[0]), np.uint64)
    for start in range(0, len(out), _BATCH):
        batch = slice(start, start + _BATCH)
        value: Any = np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
        for array in arrays:
            bits = (np.asarray(array[batch], np.float64) + 0.0).view(np.uint64)
            value = finalize((value ^ bits) + GOLDEN)
        out[batch] = value
    return out


def fingerprint(*parts: object) -> str:
    """Return a digest of JSON-able values."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]
