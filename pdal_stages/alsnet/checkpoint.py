"""A training's state in one file of PyTorch's own: tensors by name, and the rest as JSON text.

It is read with ``weights_only``: nothing in it is executed. Tensors are taken only where name, type and shape are those
of the network at hand, and none of the file is compressed, so it cannot grow while it is read.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..base import strictjson
from ..base.errors import ModelError
from ..base.files import write_whole

FORMAT = "pdal-stages alsnet checkpoint 2"
_CURE = "Delete the checkpoint to begin anew, or name another file"


def save(path: str | os.PathLike, state: dict[str, Any], tensors: Mapping[str, Any]) -> None:
    """Write a checkpoint, whole or not at all; `state` can be written as JSON and has an ``identity``."""
    import torch

    buffer = io.BytesIO()
    text = json.dumps(state, allow_nan=False)
    torch.save({"format": FORMAT, "state": text, "tensors": dict(tensors)}, buffer)
    write_whole(path, buffer.getvalue())


def load(
    path: str | os.PathLike, identity: dict[str, Any], like: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint of this very training: of the same options, classes and data, with tensors as those of `like`.

    Raises
    ------
    ModelError
        It is damaged, hostile, or of another training; the message says what differs.
    """
    import torch

    try:
        data = Path(path).read_bytes()
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise ModelError("the checkpoint is compressed, as none of ours is")
        found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise ModelError("this is not a checkpoint of this release")
        state = strictjson.loads(str(found["state"]).encode())
        _same(state["identity"], identity)
        tensors = found["tensors"]
        if set(tensors) != set(like):
            raise ModelError("the checkpoint's tensors are not the network's")
        for name, wanted in like.items():
            one = tensors[name]
            fits = isinstance(one, torch.Tensor) and one.layout == torch.strided and one.dtype == wanted.dtype
            if not (fits and one.shape == wanted.shape and bool(torch.isfinite(one).all())):
                raise ModelError("a tensor does not fit the network or is not finite", found=name)
    except ModelError as error:
        error.cure = error.cure or _CURE
        raise error.at(str(path)) from None
    except (pickle.UnpicklingError, zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, AttributeError,
            RuntimeError, NotImplementedError, EOFError, RecursionError, MemoryError) as error:  # fmt: skip
        raise ModelError(
            "the checkpoint cannot be read",
            where=str(path),
            found=f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"[:200],
            cure=_CURE,
        ) from error
    return state, tensors


def _same(found: Any, wanted: dict[str, Any]) -> None:
    found = found if isinstance(found, dict) else {}
    plain = json.loads(json.dumps(wanted))
    differs = sorted(key for key in {*found, *plain} if found.get(key) != plain.get(key))
    if differs:
        raise ModelError(
            "the checkpoint belongs to another training",
            found=f"a different {', '.join(map(str, differs[:4]))}",
        )
