"""The model file: a zip of a manifest and arrays, written whole or not at all.

Nothing from a file is ever executed. What a file declares is held against the size of the file
itself before anything is allocated, so a hostile one costs bounded time and memory. See
docs/model-file.md.
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

import numpy as np
import numpy.typing as npt

from ..base.checks import strict_json
from ..base.errors import ModelError, StageError
from ..base.files import whole_files
from ..base.json_types import JsonObject
from .interface import ArrayRule

#: Arrays of each pass by their names.
Arrays = list[dict[str, npt.NDArray]]

#: Name of the shipped model that is used where none is named.
STANDARD = "standard"
#: Value of the manifest's key ``format``.
FORMAT = "pdal-stages model"
#: Version of the format; a file of another one is refused.
VERSION = 3
#: Member of the zip that says what is in the others.
MANIFEST = "manifest.json"

#: A manifest's largest size in bytes, unpacked.
MANIFEST_LIMIT = 2 << 20
#: Unpacked bytes allowed per byte of the file; real models have 2 to 15.
RATIO_LIMIT = 60
#: Unpacked bytes allowed beside that, for small files.
ALLOWANCE = 4 << 20

#: Cure of most errors in a file.
CURE = "Train the model again, or copy the file again if it was damaged on its way"
#: Errors that zipfile, zlib and NumPy raise for damaged files.
_BAD = (
    *(zlib.error, struct.error, EOFError, OSError, MemoryError, NotImplementedError, RuntimeError),
    *(ValueError, KeyError, OverflowError, zipfile.BadZipFile),
)


def shipped() -> dict[str, Path]:
    """Return the file of every model that comes with the package, by name, in their order."""
    folder = Path(__file__).parent.parent / "models"
    return {path.stem: path for path in sorted(folder.glob("*.model"))}


def find(name: str) -> str:
    """Return the file of a model: a shipped one by its name, or a path.

    A file in the current folder that has a shipped model's name is ``./name``.

    So what is run does not depend on what lies in the folder, which others may write to.
    """
    path = shipped().get(name)
    return name if path is None else str(path)


def digest_of(name: str) -> str:
    """Return the SHA-256 of a model file, or of a shipped model by its name."""
    return hashlib.sha256(Path(find(name)).read_bytes()).hexdigest()


def write(
    path: str | os.PathLike,
    manifest: JsonObject,
    passes: Sequence[Mapping[str, npt.NDArray]],
) -> None:
    """Write a model file; an existing one stays as it was until the new one is complete.

    The same model always gives the same bytes: no date, no path and no host is stored. The manifest
    is whole but for ``arrays``; `passes` has the arrays of each pass by their names.
    """
    members: dict[str, bytes] = {}
    table = {}
    for number, arrays in enumerate(passes, 1):
        for name, array in arrays.items():
            file = f"arrays/{number}.{name}.npy"
            members[file] = to_bytes(array)
            table[f"{number}.{name}"] = {
                "file": file,
                "dtype": array.dtype.newbyteorder("<").str,
                "shape": list(array.shape),
                "sha256": hashlib.sha256(members[file]).hexdigest(),
            }
    whole = {"format": FORMAT, "version": VERSION, **manifest, "arrays": table}
    validate(whole)
    text = json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    if len(text) > MANIFEST_LIMIT:
        raise ModelError("the manifest is too large", found=f"{len(text):,} bytes")
    with (
        whole_files(Path(path), what="model") as (partial,),
        zipfile.ZipFile(partial, "x", zipfile.ZIP_DEFLATED, compresslevel=6) as archive,
    ):
        for name, data in ((MANIFEST, text), *members.items()):
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            archive.writestr(info, data)


def read(path: str | os.PathLike, rules_of) -> tuple[JsonObject, Arrays]:
    """Return the manifest of a model file, and the arrays of each pass.

    Parameters
    ----------
    path : path
    rules_of : function
        Returns the rules of the arrays of an algorithm; raises for one that it does not know.

    Raises
    ------
    ModelError
        For anything that is wrong with the file.
    """
    path = Path(path)
    try:
        if not path.is_file():
            what = "the model is not a file" if path.exists() else "there is no such model file"
            raise ModelError(what, cure="Check the path")
        with zipfile.ZipFile(path) as archive:
            return _read(archive, path.stat().st_size, rules_of, path in shipped().values())
    except StageError as error:
        error.cure = error.cure or CURE
        raise error.at(str(path)) from error.__cause__
    except _BAD as error:  # RecursionError is a RuntimeError
        what = "this is not a model file, or it is cut short or damaged"
        text = f"{type(error).__name__}: {error}"[:200]
        raise ModelError(what, where=str(path), found=text, cure=CURE) from error


def _read(
    archive: zipfile.ZipFile, size: int, rules_of, is_shipped: bool
) -> tuple[JsonObject, Arrays]:
    members = {info.filename: info for info in archive.infolist()}
    if len(members) != len(archive.infolist()):
        raise ModelError("the model file has a member twice")
    declared = sum(info.file_size for info in members.values())
    if declared > RATIO_LIMIT * size + ALLOWANCE:
        raise ModelError(
            "the model file would unpack to far more than a model does",
            found=f"{declared:,} bytes from {size:,}",
        )
    if MANIFEST not in members:
        raise ModelError("this is not a model file", found=f"a zip without {MANIFEST}")
    if members[MANIFEST].file_size > MANIFEST_LIMIT:
        raise ModelError("the manifest is too large", found=f"{members[MANIFEST].file_size:,} B")
    manifest = parse(_unpack(archive, members[MANIFEST]), is_shipped)
    rules = [rules_of(entry["algorithm"]) for entry in manifest["passes"]]
    table = manifest["arrays"]
    expected = {MANIFEST, *(entry["file"] for entry in table.values())}
    if len(expected) != 1 + len(table) or expected != set(members):
        odd = sorted(expected ^ set(members))
        raise ModelError("members and the manifest's list of arrays differ", found=odd[:3] or None)
    arrays: Arrays = [{} for _ in rules]
    for label, entry in table.items():
        number, name = int(label[0]) - 1, label[2:]
        known = rules[number].items() if number < len(rules) else ()
        rule = next((rule for pattern, rule in known if fnmatchcase(name, pattern)), None)
        if rule is None:
            raise ModelError("the file has an array its passes do not know", found=repr(label))
        data = _unpack(archive, members[entry["file"]])
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise ModelError(f"the array '{name}' is not the stored one", found="another SHA-256")
        arrays[number][name] = from_bytes(data, rule, name)
    for stored, needed in zip(arrays, rules, strict=True):
        missing = [name for name in needed if not name.endswith("*") and name not in stored]
        if missing:
            raise ModelError("the model file lacks an array", found=missing[0])
    return manifest, arrays


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    if info.flag_bits & 0x1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ModelError("a member has an unsupported compression", found=repr(info.filename))
    with archive.open(info) as stream:
        # Never more than was declared; the CRC is checked at the end.
        data = stream.read(info.file_size + 1)
        if len(data) != info.file_size or stream.read(1):
            raise ModelError("a member has another size than declared", found=repr(info.filename))
    return data


def to_bytes(array: npt.NDArray) -> bytes:
    """Return the array as ``.npy`` bytes (version 1.0, little-endian, C order)."""
    out = io.BytesIO()
    little = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    np.save(out, little, allow_pickle=False)
    return out.getvalue()


def from_bytes(data: bytes, rule: ArrayRule, name: str) -> npt.NDArray:
    """Return the array in ``.npy`` bytes, a view of `data`; ModelError where it breaks `rule`.

    NumPy's reader is not used for the values because it allocates what a header says: here an
    array's size must be that of the bytes.
    """
    stream = io.BytesIO(data)
    try:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("another version than 1.0")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        if any(type(n) is not int for n in shape):  # True is one to NumPy
            raise ValueError(f"shape {shape}")
        if fortran or dtype.str not in rule.dtypes or len(shape) != rule.ndim:
            raise ValueError(f"{dtype.str} {shape}, not {rule} in C order")
        rest = len(data) - stream.tell()
        if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != rest:
            raise ValueError(f"{rest:,} bytes of values for shape {shape}")
    except (ValueError, RecursionError, MemoryError) as error:
        raise ModelError(f"the array '{name}' is not a model's", found=str(error)[:120]) from None
    values = np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape)
    return values.astype(dtype.newbyteorder("="), copy=False)


def parse(data: bytes, is_shipped: bool = False) -> JsonObject:
    """Return the manifest in `data`, valid by its schema; a shipped one is not validated again."""
    try:
        manifest = strict_json(data.decode("utf-8"))
    except RecursionError:
        raise ModelError("the manifest is nested too deeply") from None
    except ValueError as error:
        raise ModelError("the manifest is not valid JSON", found=str(error)[:200]) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError("this is not a model file", found="a manifest of something else")
    version = manifest.get("version")
    if type(version) is not int or version != VERSION:  # True is 1
        is_old = type(version) is int and version < VERSION
        raise ModelError(
            f"the model file has another version of the format than this release, {VERSION}",
            found=f"version {str(version)[:20]}",
            cure="Train the model again" if is_old else "Update pdal-stages",
        )
    if not is_shipped:  # the validator takes 0.07 s and 10 MB to import
        validate(manifest)
    return manifest


def validate(manifest: JsonObject) -> None:
    """Raise a ModelError where a manifest does not follow its JSON Schema."""
    try:
        error = next(_validator().iter_errors(manifest), None)
    except RecursionError:
        raise ModelError("the manifest is nested too deeply", cure=CURE) from None
    if error is not None:
        place = "/".join(str(part)[:60] for part in error.absolute_path) or "(the whole)"
        raise ModelError(f"the manifest is not valid at {place}", found=error.message[:200])


@lru_cache
def _validator():
    import jsonschema

    text = resources.files(__package__).joinpath("model.json").read_text("utf-8")
    return jsonschema.Draft202012Validator(json.loads(text))
