"""What a command is about to write, held against what it reads and what is there already."""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from .errors import StageError

LAS, MODEL, CHECKPOINT = "a LAS or LAZ file", "a model file", "a training's checkpoint"
JSON, HTML, PNG = "a JSON file", "an HTML page", "a PNG picture"
#: The first bytes of files that people would miss.
_BEGINNINGS = {
    b"LASF": LAS,
    b"\x89PNG": PNG,
    b"ply\n": "a PLY file",
    b"ply\r": "a PLY file",
    b"BPF!": "a BPF file",
    b"II*\0": "a TIFF file",
    b"MM\0*": "a TIFF file",
    b"SQLite format 3\0": "an SQLite or GeoPackage file",
    b"%PDF": "a PDF file",
    b"\x7fELF": "a program",
    b"#!": "a program",
    b"\x1f\x8b": "a gzip archive",
}


def kind_of(path: str | os.PathLike) -> str:
    """The kind of a file, as messages say it; empty where there is no file, nothing in it, or it is not known."""
    try:
        with open(path, "rb") as file:
            head = file.read(512)
    except OSError:
        return ""
    for beginning, kind in _BEGINNINGS.items():
        if head.startswith(beginning):
            return kind
    if head.startswith(b"PK\x03\x04"):
        first = head[30 : 30 + int.from_bytes(head[26:28], "little")]
        return {b"manifest.json": MODEL, b"archive/data.pkl": CHECKPOINT}.get(first, "a zip archive")
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return HTML
    return JSON if text.startswith((b"{", b"[")) else ""


#: Bytes a file's name may have, on every usual file system.
_LONGEST_NAME = 255


def check_writable(path: str | os.PathLike, what: str = "output", kind: str = "") -> None:
    """Refuse an output that cannot be written, before any work is done.

    Parameters
    ----------
    path : path
    what : str
        What messages call it.
    kind : str
        The kind of file it will be, one of :data:`LAS`, :data:`MODEL`, ... in this module, where that is known.

    Raises
    ------
    StageError
        If its folder is missing or read-only, its name is too long, or what is there must not be replaced: a folder, a
        write-protected file, a file that is known to be of another kind.
    """
    if is_stream(path):
        if not os.access(path, os.W_OK) or stat.S_IFMT(os.stat(path).st_mode) in (
            stat.S_IFBLK,
            stat.S_IFSOCK,
        ):
            raise StageError(f"the {what} file is a device that cannot be written to", found=str(path))
        return
    real = real_path(path)
    if len(real.name.encode(errors="surrogateescape")) > _LONGEST_NAME:
        raise StageError(f"the name of the {what} file is longer than {_LONGEST_NAME} bytes", found=str(path))
    if not real.parent.is_dir():
        cure = "Create it first"
        if not str(real.parent).isascii() and sys.getfilesystemencoding() != "utf-8":
            cure = _locale_cure()
        raise StageError(f"the folder of the {what} file does not exist", found=str(real.parent), cure=cure)
    if real.is_symlink():
        raise StageError(f"the {what} file is a link that leads to itself", found=str(path))
    if real.is_dir():
        raise StageError(f"the {what} file names a folder", found=str(path), cure="Give a file name")
    if not os.access(real.parent, os.W_OK):
        raise StageError(f"the folder of the {what} file cannot be written to", found=str(real.parent))
    if real.exists() and not (os.access(real, os.W_OK) and real.stat().st_mode & 0o222):
        cure = "Give another name, or change its mode"
        raise StageError(f"the {what} file is write-protected", found=str(path), cure=cure)
    older = kind_of(real) if kind else ""
    if older and older != kind:
        cure = "Give another name, or remove that file first"
        raise StageError(f"the {what} file would replace {older}", found=str(path), cure=cure)


def is_stream(path: str | os.PathLike) -> bool:
    """Whether a name stands for something to write into: a device, a pipe, or what this process has open."""
    try:
        kind = stat.S_IFMT(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False
    opened = os.path.abspath(path).startswith(("/dev/std", "/dev/fd/", "/proc/"))
    return kind not in (stat.S_IFREG, stat.S_IFDIR) or (kind == stat.S_IFREG and opened)


def real_path(path: str | os.PathLike) -> Path:
    """The file that a name leads to."""
    try:
        return Path(os.path.realpath(path))
    except UnicodeEncodeError as error:
        what = "the name of the file cannot be written in this locale"
        raise StageError(what, found=ascii(str(path)), cure=_locale_cure()) from error


def _locale_cure() -> str:
    return f"Set PYTHONUTF8=1: this locale's file names are {sys.getfilesystemencoding()}"


@dataclass(frozen=True)
class Output:
    """A file to be written."""

    path: str  #: in its name '#' stands for numbers
    what: str = "output"  #: what messages call it: ``output``, ``model``, ``metadata``
    kind: str = ""  #: its kind: :data:`LAS`, :data:`MODEL`, ..., where it is known beforehand


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
