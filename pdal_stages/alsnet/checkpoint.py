"""A training's state in one file of plain data: weights, the best ones, the optimizer's moments, the curve.

A zip of one JSON member and ``.npy`` arrays. Nothing is unpickled; sizes are known from the network before
anything is unpacked, and whatever does not fit them is refused.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base import strictjson
from ..base.errors import ModelError
from ..base.files import write_whole
from ..classifier.arrays import ArrayRule, from_bytes, to_bytes

FORMAT = "pdal-stages alsnet checkpoint 1"
STATE = "state.json"
_STATE_LIMIT = 16 << 20
_CURE = "Delete the checkpoint to begin anew, or name another file"


def save(path: str | os.PathLike, state: dict[str, Any], arrays: dict[str, npt.NDArray[np.float32]]) -> None:
    """Write a checkpoint, whole or not at all; `state` can be written as JSON and has an ``identity``."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        members = {STATE: json.dumps({"format": FORMAT, **state}, allow_nan=False).encode()}
        members |= {f"{name}.npy": to_bytes(array) for name, array in arrays.items()}
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
    write_whole(path, buffer.getvalue())


def load(
    path: str | os.PathLike, identity: dict[str, Any], shapes: dict[str, tuple[int, ...]]
) -> tuple[dict[str, Any], dict[str, npt.NDArray[np.float32]]]:
    """Read a checkpoint of this very training: of the same options, classes and data, with arrays of these shapes.

    Raises
    ------
    ModelError
        It is damaged, hostile, or of another training; the message says what differs.
    """
    try:
        with zipfile.ZipFile(Path(path)) as archive:
            infos = {info.filename: info for info in archive.infolist()}
            expected = {STATE, *(f"{name}.npy" for name in shapes)}
            if STATE not in infos or infos[STATE].file_size > _STATE_LIMIT:
                raise ModelError("this is not a checkpoint")
            state = strictjson.loads(_read(archive, infos[STATE]))
            if not isinstance(state, dict) or state.get("format") != FORMAT:
                raise ModelError("this is not a checkpoint of this release")
            _same(state.get("identity"), identity)
            if set(infos) != expected or len(archive.infolist()) != len(expected):
                raise ModelError("the checkpoint's arrays are not the network's")
            arrays = {}
            for name, shape in shapes.items():
                info = infos[f"{name}.npy"]
                if info.file_size > 4 * math.prod(shape) + 1024:
                    raise ModelError("an array is larger than the network's", found=name)
                array = from_bytes(_read(archive, info), ArrayRule(("<f4",), len(shape)), name)
                if array.shape != shape or not np.isfinite(array).all():
                    raise ModelError(
                        "an array of the checkpoint does not fit the network or is not finite",
                        found=f"{name} {array.shape}",
                    )
                arrays[name] = array
    except ModelError as error:
        error.cure = error.cure or _CURE
        raise error.at(str(path)) from None
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, RuntimeError, NotImplementedError, EOFError,
            RecursionError, zlib.error) as error:  # fmt: skip
        raise ModelError(
            "the checkpoint cannot be read",
            where=str(path),
            found=f"{type(error).__name__}: {error}"[:200],
            cure=_CURE,
        ) from error
    return state, arrays


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    if info.compress_type != zipfile.ZIP_STORED:
        raise ModelError("a member has an unsupported compression", found=repr(info.filename)[:60])
    return archive.read(info)


def _same(found: Any, wanted: dict[str, Any]) -> None:
    found = found if isinstance(found, dict) else {}
    plain = json.loads(json.dumps(wanted))
    differs = sorted(key for key in {*found, *plain} if found.get(key) != plain.get(key))
    if differs:
        raise ModelError(
            "the checkpoint belongs to another training",
            found=f"a different {', '.join(map(str, differs[:4]))}",
        )
