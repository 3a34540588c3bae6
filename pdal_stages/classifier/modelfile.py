"""The model file: one zip of a manifest and arrays, written whole or not at all, read with distrust.

Nothing from a file is ever executed. What a file declares is held against the size of the file itself
before anything is allocated, so a hostile one costs bounded time and memory. See docs/model-file.md.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base import strictjson
from ..base.errors import ModelError, StageError
from ..base.files import whole_files
from ..models import shipped
from .algorithms import ArrayRule

#: Arrays of each pass by their names.
Arrays = list[dict[str, npt.NDArray[Any]]]

FORMAT = "pdal-stages model"
#: Of the format; a file of another is refused.
VERSION = 2
MANIFEST = "manifest.json"

#: A manifest's largest size in bytes, unpacked.
MANIFEST_LIMIT = 2 << 20
#: Unpacked bytes allowed per byte of the file (ours have 2 to 15), beside a fixed allowance.
RATIO_LIMIT, ALLOWANCE = 60, 4 << 20
#: A file's members, and the largest file.
MEMBER_LIMIT, FILE_LIMIT = 64, (1 << 32) - 1

#: What helps against most of what can be wrong with a file.
CURE = "Train the model again, or copy the file again if it was damaged on its way"
_END = struct.Struct("<4s4H2LH")  # zip's end of central directory
_BAD = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error,
    KeyError, OverflowError, OSError,
)  # fmt: skip


# ---- writing -----------------------------------------------------------------------------------------------


def write(
    path: str | os.PathLike, manifest: Mapping[str, Any], passes: Sequence[Mapping[str, npt.NDArray[Any]]]
) -> None:
    """Write a model file; an existing one stays as it was until the new one is complete.

    The same model always gives the same bytes: no date, no path and no host is stored. The manifest is whole but for
    ``arrays``; `passes` has the arrays of each pass by their names.
    """
    path = Path(path)
    arrays = {
        f"{number}.{name}": array for number, one in enumerate(passes, 1) for name, array in one.items()
    }
    members = {f"arrays/{name}.npy": to_bytes(array) for name, array in arrays.items()}
    table = {
        name: {
            "file": file,
            "dtype": array.dtype.newbyteorder("<").str,
            "shape": list(array.shape),
            "sha256": hashlib.sha256(members[file]).hexdigest(),
        }
        for (name, array), file in zip(arrays.items(), members, strict=True)
    }
    whole = {"format": FORMAT, "version": VERSION, **manifest, "arrays": table}
    validate(whole)
    text = json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    if len(text) > MANIFEST_LIMIT:
        raise ModelError("the manifest is too large", found=f"{len(text):,} bytes")
    try:
        with (
            whole_files(path, what="model") as (partial,),
            zipfile.ZipFile(partial, "x", zipfile.ZIP_DEFLATED, allowZip64=False, compresslevel=6) as archive,
        ):
            for name, data in ((MANIFEST, text), *members.items()):
                info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
                info.compress_type = zipfile.ZIP_DEFLATED
                info.external_attr = 0o644 << 16
                archive.writestr(info, data)
    except zipfile.LargeZipFile as error:
        raise ModelError(
            "the model is larger than 4 GiB",
            where=str(path),
            found=error,
            cure="Raise min_samples_leaf or lower the number of trees",
        ) from error


# ---- reading -----------------------------------------------------------------------------------------------


def read(path: str | os.PathLike, rules_of) -> tuple[dict[str, Any], Arrays]:
    """Read a model file.

    Parameters
    ----------
    path : path
    rules_of : function
        From a pass's ``algorithm`` to its arrays' rules (name to :class:`ArrayRule`, a name that ends
        in ``*`` stands for many); raises for an algorithm it does not know.

    Returns
    -------
    manifest : dict
    arrays : list of dict
        Of each pass.

    Raises
    ------
    ModelError
        Whatever is wrong with the file; the message names it.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise ModelError("there is no such model file", cure="Check the path")
        if not path.is_file():
            raise ModelError("the model is not a file", cure="Check the path")
        with open(path, "rb") as stream:
            size = _check_end(stream)
            with zipfile.ZipFile(stream) as archive:
                return _read(archive, size, rules_of, path in shipped().values())
    except StageError as error:
        error.cure = error.cure or CURE
        raise error.at(str(path)) from error.__cause__
    except (*_BAD, RecursionError, MemoryError) as error:
        text = f"{type(error).__name__}: {error}"[:200]
        raise ModelError("the model file cannot be read", where=str(path), found=text, cure=CURE) from error


def _check_end(stream) -> int:
    """The file's size, after a look at zip's last record: how long is the list zipfile is about to load?"""
    size = stream.seek(0, os.SEEK_END)
    if size < _END.size:
        raise ModelError("this is not a model file", found=f"{size} bytes")
    if size > FILE_LIMIT:
        raise ModelError("the model file is larger than 4 GiB", found=f"{size:,} bytes")
    tail = min(size, _END.size + 20)
    stream.seek(size - tail)
    data = stream.read(tail)
    signature, disk, first, here, total, length, offset, comment = _END.unpack(data[-_END.size :])
    if signature != b"PK\x05\x06" or comment:
        raise ModelError("this is not a model file, or it is cut short")
    if data[: -_END.size].startswith(b"PK\x06\x07"):
        raise ModelError("the model file is a zip of a kind that is not used here", found="zip64")
    if disk or first or here != total or not 1 <= total <= MEMBER_LIMIT or length > MEMBER_LIMIT * 512:
        raise ModelError("the model file's list of members is not right", found=f"{total} members")
    if offset + length + _END.size != size:
        raise ModelError("the model file has bytes outside any member")
    stream.seek(0)
    return size


def _read(archive: zipfile.ZipFile, size: int, rules_of, own: bool) -> tuple[dict[str, Any], Arrays]:
    members: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        if info.filename in members:
            raise ModelError("the model file has a member twice", found=repr(info.filename))
        if info.flag_bits & 0x1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ModelError("a member has an unsupported compression", found=repr(info.filename))
        members[info.filename] = info
    declared = sum(info.file_size for info in members.values())
    if declared > RATIO_LIMIT * size + ALLOWANCE:
        raise ModelError(
            "the model file would unpack to far more than a model does",
            found=f"{declared:,} bytes from {size:,}",
        )
    if MANIFEST not in members:
        raise ModelError("this is not a model file", found=f"a zip without {MANIFEST}")
    if members[MANIFEST].file_size > MANIFEST_LIMIT:
        raise ModelError("the manifest is too large", found=f"{members[MANIFEST].file_size:,} bytes")
    manifest = parse(_unpack(archive, members[MANIFEST]), own)
    rules = [rules_of(one["algorithm"]) for one in manifest["passes"]]
    table = manifest["arrays"]
    expected = {MANIFEST, *(entry["file"] for entry in table.values())}
    if len(expected) != 1 + len(table) or expected != set(members):
        odd = sorted(expected ^ set(members))
        raise ModelError("the members and the manifest's list of arrays differ", found=odd[:3] or None)
    arrays: Arrays = [{} for _ in rules]
    for label, entry in table.items():
        number, name = int(label[0]) - 1, label[2:]
        if number >= len(rules):
            raise ModelError("the model file has an array of a pass it does not have", found=repr(label))
        data = _unpack(archive, members[entry["file"]])
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise ModelError(f"the array '{name}' is not the one that was stored", found="another SHA-256")
        array = from_bytes(data, _rule(rules[number], name), name)
        if list(array.shape) != entry["shape"] or array.dtype.newbyteorder("<").str != entry["dtype"]:
            raise ModelError(
                f"the array '{name}' is not what the manifest says", found=f"shape {array.shape}"
            )
        arrays[number][name] = array
    for there, needed in zip(arrays, rules, strict=True):
        missing = [name for name in needed if not name.endswith("*") and name not in there]
        if missing:
            raise ModelError("the model file lacks an array", found=missing[0])
    return manifest, arrays


def _rule(rules: Mapping[str, ArrayRule], name: str) -> ArrayRule:
    for pattern, rule in rules.items():
        if fnmatchcase(name, pattern):
            return rule
    raise ModelError("the model file has an array its algorithm does not know", found=repr(name))


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    with archive.open(info) as stream:
        data = stream.read(info.file_size + 1)  # never more than was declared; the CRC is checked at the end
        if len(data) != info.file_size or stream.read(1):
            raise ModelError("a member has another size than declared", found=repr(info.filename))
    return data


# ---- arrays ------------------------------------------------------------------------------------------------

#: Of ``.npy`` files, version 1.0.
_MAGIC = b"\x93NUMPY\x01\x00"


def to_bytes(array: npt.NDArray[Any]) -> bytes:
    """The array as ``.npy`` bytes (version 1.0, little-endian, C order)."""
    array = np.asarray(array)
    little = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    out = io.BytesIO()
    np.lib.format.write_array(out, little, version=(1, 0), allow_pickle=False)
    return out.getvalue()


def from_bytes(data: bytes, rule: ArrayRule, name: str) -> npt.NDArray[Any]:
    """The array in ``.npy`` bytes, if it is what `rule` says; a view of `data`, read-only.

    ``np.load`` is not used because it allocates what a header says: here an array's size must be that of the bytes.
    """
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


# ---- the manifest ----------------------------------------------------------------------------------------


def parse(data: bytes, own: bool = False) -> dict[str, Any]:
    """The manifest in `data`, valid by its schema; `own` ones, which came with the package, are known to be."""
    try:
        manifest = strictjson.loads(data.decode("utf-8"))
    except RecursionError:
        raise ModelError("the manifest is nested too deeply") from None
    except (UnicodeDecodeError, ValueError) as error:
        raise ModelError("the manifest is not valid JSON", found=str(error)[:200]) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError("this is not a model file", found="a manifest of something else")
    version = manifest.get("version")
    if type(version) is not int or version != VERSION:
        raise ModelError(
            f"the model file has a version this release does not know (it knows {VERSION})",
            found=f"version {str(version)[:20]}",
            cure="Update pdal-stages",
        )
    if not own:  # the validator takes 0.07 s to import
        validate(manifest)
    return manifest


def validate(manifest: Mapping[str, Any]) -> None:
    """Hold a manifest against its JSON Schema."""
    try:
        error = next(_validator().iter_errors(manifest), None)
    except RecursionError:
        raise ModelError("the manifest is nested too deeply", cure=CURE) from None
    if error is not None:
        place = "/".join(str(part)[:60] for part in error.absolute_path) or "(the whole)"
        raise ModelError(f"the manifest is not valid at {place}", found=error.message[:200], cure=CURE)


@lru_cache
def _validator():
    import jsonschema

    text = resources.files(__package__).joinpath("model.json").read_text("utf-8")
    return jsonschema.Draft202012Validator(json.loads(text))
