"""What a command is about to write, held against what it reads and what is there already."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from .errors import StageError
from .files import check_writable, is_stream


@dataclass(frozen=True)
class Output:
    """A file to be written."""

    path: str  #: in its name '#' stands for numbers
    what: str = "output"  #: what messages call it: ``output``, ``model``, ``metadata``
    kind: str = ""  #: one of :mod:`pdal_stages.base.kinds`, where it is known beforehand


def check_outputs(outputs: Iterable[Output], inputs: Iterable[str | os.PathLike]) -> None:
    """Refuse outputs that cannot be written, that are read, that are one file, or that would replace another kind.

    Links are followed and hard links seen through.

    Raises
    ------
    StageError
        Naming the output.
    """
    read = {identity: os.fspath(path) for path in inputs if (identity := _identity(path))}
    names = [Path(os.path.realpath(path)) for path in read.values()]
    seen: dict[tuple[int, int] | Path, Output] = {}
    for output in outputs:
        check_writable(output.path, output.what, output.kind)
        if is_stream(output.path):
            continue
        real = Path(os.path.realpath(output.path))
        identity = _identity(output.path)
        hit = (identity and read.get(identity)) or _numbered(real, names)
        if hit is not None:
            raise StageError(
                f"the {output.what} file is one of the inputs", found=str(hit), cure="Give it another name"
            )
        one = identity or real
        if one in seen:
            raise StageError(
                f"the {output.what} file is the {seen[one].what} file too"
                if output.what != seen[one].what
                else f"two {output.what} files are one",
                found=output.path,
                cure="Give each its own name",
            )
        seen[one] = output


def _identity(path: str | os.PathLike) -> tuple[int, int] | None:
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino


def _numbered(output: Path, inputs: list[Path]) -> Path | None:
    """The input that a numbered output might become."""
    if "#" not in output.name:
        return None
    before, _, after = output.name.partition("#")
    pattern = re.compile(rf"{re.escape(before)}\d+{re.escape(after)}")
    return next((p for p in inputs if p.parent == output.parent and pattern.fullmatch(p.name)), None)
