"""The inputs of a tiled run: files behind a pipeline's readers, and where they lie."""

from __future__ import annotations

import glob
import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base import las, strictjson
from ..base.errors import PipelineError, StageError
from ..pipeline import pdal as pdal_env
from ..pipeline.inputs_outputs import locations
from .grid import Box

#: Readers of files whose points can be fetched by number.
_LAS = ("readers.las", "readers.copc")
#: Bytes of an EPT source's description at most.
_LARGEST = 16 << 20
#: Options of readers.tindex that choose files or points, or change them.
_TINDEX_QUERIES = ("bounds", "polygon", "where", "sql", "count", "srs_column")


@dataclass(frozen=True)
class InputSource:
    """One input."""

    path: str  #: absolute, or an address
    reader: dict[str, Any]  #: the stage that reads it
    kind: str  #: ``las`` (LAS, LAZ, COPC) or ``ept``

    @property
    def key(self) -> str:
        """A short name, the same in every run."""
        return hashlib.sha1(os.fsencode(self.path)).hexdigest()[:12]

    @property
    def stem(self) -> str:
        """The name outputs are called after."""
        name = Path(self.path).name
        for suffix in (".copc.laz", ".laz", ".las"):
            if name.lower().endswith(suffix):
                return name[: -len(suffix)]
        return Path(name).stem

    @property
    def plain_name(self) -> str:
        """The file's name, without what says that it is COPC: outputs of tiles are not."""
        name = Path(self.path).name
        return self.stem + name[-len(".laz") :] if name.lower().endswith(".copc.laz") else name

    def within(self, box: Box) -> dict[str, Any]:
        """The reader of an EPT source for a box alone."""
        x0, y0, x1, y1 = box
        return {**self.reader, "filename": self.path, "bounds": f"([{x0!r}, {x1!r}], [{y0!r}, {y1!r}])"}


def find_sources(readers: list[dict[str, Any]]) -> list[InputSource]:
    """The inputs behind readers: names, patterns, EPT addresses, tile indexes.

    Raises
    ------
    PipelineError
        Where nothing is found, or a reader cannot be cut into tiles.
    """
    found: dict[str, InputSource] = {}
    for reader in readers:
        given = reader.get("filename", "")
        name = str(given)
        kind = reader["type"]
        if kind == "readers.tindex":
            ignored = [o for o in _TINDEX_QUERIES if o in reader]
            if ignored:
                raise PipelineError(
                    "in tiles all files of a tile index are read, whole",
                    where=kind,
                    found=", ".join(ignored),
                    cure="Leave these options out, or make an index of the files you mean",
                )
            options = {k: v for k, v in reader.items() if k in ("override_srs", "default_srs")}
            paths = locations(name, str(reader.get("tindex_name", "location")))
            reader = {"type": "readers.las", **options}
        elif kind == "readers.ept":
            for one in given if isinstance(given, list) else [name]:
                path = one.removeprefix("ept://")
                path = path if path.endswith("ept.json") else path.rstrip("/") + "/ept.json"
                path = path if "://" in path else str(Path(path).absolute())
                found.setdefault(path, InputSource(path, _bare(reader), "ept"))
            continue
        elif isinstance(given, list):  # from a command: all of them are files
            paths = given
        elif kind in _LAS:
            patterned = any(c in name for c in "*?[") and not os.path.exists(name)
            paths = sorted(glob.glob(name, recursive=True)) if patterned else [name]
            if not paths:
                raise PipelineError("no file fits the reader's pattern", where=kind, found=name)
        else:
            raise PipelineError(
                f"{kind} cannot read a part of a file, so it cannot be cut into tiles",
                found=name,
                cure="Convert the input first: pdal translate INPUT input.laz",
            )
        bare = {**_bare(reader), "type": "readers.las"}
        for path in paths:
            full = os.path.abspath(path)
            found.setdefault(full, InputSource(full, bare, "las"))
    return list(found.values())


def _bare(reader: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in reader.items() if k not in ("filename", "tag", "inputs")}


@dataclass(frozen=True)
class Extent:
    """What an input says of itself."""

    count: int  #: points
    box: Box


def read_extent(source: InputSource) -> Extent:
    """Number of points and bounding box, from the first bytes.

    Raises
    ------
    StageError
        If the input cannot be read.
    """
    if source.kind != "ept":
        return las_extent(source.path)
    described = read_ept(source.path)
    x0, y0, _, x1, y1, _ = map(float, described["boundsConforming"])
    return Extent(int(described["points"]), (x0, y0, x1, y1))


def las_extent(path: str) -> Extent:
    """Number of points and bounding box in the header of a LAS or LAZ file."""
    try:
        found = las.read_header(path)
    except OSError as error:
        raise StageError("the input cannot be read", where=path, found=error) from None
    if found is None:
        raise StageError("the input is not a LAS or LAZ file", where=path)
    x0, y0, x1, y1 = found.box
    if found.count and not (math.isfinite(x1 - x0 + y1 - y0) and x0 <= x1 and y0 <= y1):
        raise StageError(
            "the header has no bounding box", where=path, found=f"x {x0} to {x1}, y {y0} to {y1}"
        )
    return Extent(found.count, found.box)


def read_ept(path: str) -> dict[str, Any]:
    """The description of an EPT source."""
    try:
        if "://" in path:
            import urllib.request

            with urllib.request.urlopen(path, timeout=60) as answer:
                text = answer.read(_LARGEST)
        else:
            with open(path, "rb") as file:
                text = file.read(_LARGEST)
        found = strictjson.loads(text)
        x0, y0, _, x1, y1, _ = map(float, found["boundsConforming"])
        names = [dimension["name"] for dimension in found["schema"]]
        if (
            int(found["points"]) < 0
            or not (x0 <= x1 and y0 <= y1)
            or not all(isinstance(n, str) for n in names)
        ):
            raise ValueError("a description of nothing")
        return found
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise StageError("the EPT source cannot be read", where=path, found=str(error)) from None


def ept_format(described: Mapping[str, Any]) -> int:
    """The LAS point format that has the colors of an EPT source."""
    names = {dimension["name"] for dimension in described["schema"]}
    return 8 if "Infrared" in names else 7 if "Red" in names else 6


def fetch_ept(source: InputSource, box: Box, target: str) -> bool:
    """Read the points of an EPT source in a box into a LAS file; whether there are any.

    Scales and offsets are the source's, so coordinates stay what they are; other dimensions become extra dimensions.
    """
    described = read_ept(source.path)
    form = {"minor_version": 4, "dataformat_id": ept_format(described), "extra_dims": "all"}
    for dimension in described["schema"]:
        if dimension["name"] in ("X", "Y", "Z"):
            axis = dimension["name"].lower()
            form[f"scale_{axis}"] = dimension.get("scale", 0.001)
            form[f"offset_{axis}"] = dimension.get("offset", 0.0)
    writer = {"type": "writers.las", "filename": target, **form}
    run = pdal_env.execute([source.within(box), writer], arrays=False)
    return bool(run.count and las_extent(target).count)
