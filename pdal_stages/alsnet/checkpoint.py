"""The checkpoint of a training: a file of PyTorch and its SHA-256, written whole or not at all."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

from ..base.errors import ModelError
from ..base.files import write_whole

#: First part of what a checkpoint must agree with; changes with what is stored.
FORMAT = "pdal-stages alsnet checkpoint 4"
#: Bytes of the SHA-256 at the end.
_DIGEST = 32
_CURE = "Delete the checkpoint to begin anew, or name another file"


def save(path: str, state: dict[str, Any]) -> None:
    """Write the state of a training; ``state["identity"]`` tells which training it is of."""
    from .torch_network import torch

    buffer = BytesIO()
    torch.save(state, buffer)
    write_whole(path, buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())


def resume(path: str, identity: str, apply: Callable[[dict[str, Any]], None]) -> None:
    """Read the state of a training and `apply` it. Nothing in the file is executed.

    ModelError where it is damaged, or the state of a training of another `identity`.
    """
    from .torch_network import torch

    data = Path(path).read_bytes()
    if hashlib.sha256(data[:-_DIGEST]).digest() != data[-_DIGEST:]:
        raise ModelError(
            "this is not a checkpoint of this release, or it is damaged", where=path, cure=_CURE
        )
    try:
        state = torch.load(BytesIO(data[:-_DIGEST]), map_location="cpu", weights_only=True)
        fits = state["identity"] == identity
        if fits:
            apply(state)
    except Exception as error:  # PyTorch's own, of files that somebody made
        raise ModelError(
            "the checkpoint cannot be read",
            where=path,
            found=f"{type(error).__name__}: {error}".splitlines()[0][:200],
            cure=_CURE,
        ) from error
    if not fits:
        what = "the checkpoint belongs to another training, of other options, classes or data"
        raise ModelError(what, where=path, cure=_CURE)
