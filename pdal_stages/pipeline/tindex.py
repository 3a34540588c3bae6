"""File names in a tile index, as ``pdal tindex create`` writes it: Shapefile, GeoPackage, SQLite or GeoJSON."""

from __future__ import annotations

import json
import sqlite3
import struct
from pathlib import Path

from ..base.errors import StageError


def locations(path: str, column: str = "location") -> list[str]:
    """The files a tile index names; relative names count from the index's folder, then from here.

    Raises
    ------
    StageError
        If it cannot be read, or has no such column.
    """
    file = Path(path)
    try:
        suffix = file.suffix.lower()
        if suffix == ".shp":
            names = _dbf(file.with_suffix(".dbf").read_bytes(), column)
        elif suffix in (".gpkg", ".sqlite", ".db"):
            names = _sqlite(file, column)
        elif suffix in (".geojson", ".json"):
            features = json.loads(file.read_text(encoding="utf-8"))["features"]
            names = [feature["properties"][column] for feature in features]
        else:
            raise StageError(
                "a tile index of this kind is not read",
                where=path,
                found=suffix or "no suffix",
                cure="Write it as .gpkg, .sqlite, .shp or .geojson",
            )
        if odd := [name for name in names if not (isinstance(name, str) and name) or "\0" in name]:
            raise ValueError(f"{odd[0]!r} is not a file's name")
        there = {name: file.absolute().parent / name for name in names}
        found = [str(path if path.exists() else Path(name).absolute()) for name, path in there.items()]
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        RecursionError,
        struct.error,
        sqlite3.Error,
    ) as error:
        raise StageError(
            "the tile index cannot be read",
            where=path,
            found=f"{type(error).__name__}: {error}",
            cure=f"It needs a column '{column}' with file names (option tindex_name)",
        ) from None
    if not found:
        raise StageError("the tile index names no file", where=path)
    return found


def _sqlite(file: Path, column: str) -> list[str]:
    file.stat()  # sqlite3 would make a missing file
    with sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True) as base:
        for (table,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            quoted = table.replace('"', '""')
            columns = [row[1] for row in base.execute(f'PRAGMA table_info("{quoted}")')]
            if column in columns:
                return [row[0] for row in base.execute(f'SELECT "{column}" FROM "{quoted}"')]
    raise KeyError(column)


def _dbf(data: bytes, column: str) -> list[str]:
    """Values of one text column of a dBASE table."""
    rows, start, width = struct.unpack_from("<IHH", data, 4)
    if not width or start + rows * width > len(data):
        raise ValueError(f"{rows:,} rows in {len(data):,} bytes")
    at, offset = 32, 1
    while data[at : at + 11].split(b"\0")[0].decode("latin-1") != column[:10]:
        if data[at] == 0x0D:
            raise KeyError(column)
        offset += data[at + 16]
        at += 32
    records = (data[begin : begin + width] for begin in range(start, start + rows * width, width))
    texts = (one[offset : offset + data[at + 16]] for one in records if one[:1] != b"*")
    return [text.decode("utf-8", "replace").strip() for text in texts]
