"""What the fuzzers call beyond the parsers of pipelines and models: conditions, files of points, indexes, notes of runs.

As in targets.py: bytes in; only :class:`StageError` is caught, so anything else that comes out is a finding.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import shutil
import sqlite3
import struct
import tempfile
import time
import zipfile
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pdal_stages.base import las, lascheck
from pdal_stages.base.errors import StageError
from pdal_stages.base.strictjson import loads
from pdal_stages.pipeline import tindex
from pdal_stages.pipeline.pdal import version
from pdal_stages.stages.where import Expression
from pdal_stages.tiling import results, sources
from pdal_stages.tiling.grid import TileGrid
from pdal_stages.tiling.index import sort_points
from pdal_stages.tiling.store import Store

PATIENCE = 10.0


@cache
def folder() -> Path:
    """A folder in memory, until the process ends."""
    memory = Path("/dev/shm")
    made = Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if os.access(memory, os.W_OK) else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def put(name: str, data: bytes) -> Path:
    path = folder() / name
    path.write_bytes(data)
    return path


# ---- conditions ------------------------------------------------------------------------------------------

NAMES = ("X", "Y", "Z", "Classification", "GpsTime")


@cache
def points() -> np.ndarray:
    rng = np.random.default_rng(7)
    out = np.zeros(60, [(name, "u1" if name == "Classification" else "f8") for name in NAMES])
    for name in NAMES[:4]:
        out[name] = rng.integers(0, 6, len(out))
    return out


def where(data: bytes) -> str:
    """A condition that is taken means what it means to PDAL, where PDAL takes it too."""
    text = data.decode("utf-8", "replace")
    try:
        mask = Expression(text).evaluate({name: points()[name] for name in NAMES})
    except StageError as error:
        assert str(error).strip().endswith((".", "?", "!")) and "Traceback" not in str(error)
        return "refused"
    assert mask.dtype == bool and mask.shape == (60,)
    if (
        theirs := _of_pdal(text)
    ) is not None:  # asked about nothing else, as its parser crashes on some texts
        assert np.array_equal(mask, theirs), "PDAL sees other points"
    return "evaluated"


_MINUS = re.compile(r"(^|[^\w).\s])\s*-\s*(?![\d.])")


def _of_pdal(text: str) -> np.ndarray | None:
    """Where PDAL sees a condition hold; None where it refuses it, or older ones would crash: on a minus before a name."""
    import pdal

    if version() < (2, 9, 0) and _MINUS.search(text):
        return None
    stage = {"type": "filters.assign", "value": f"GpsTime = -1 WHERE {text}"}
    pipeline = pdal.Pipeline(json.dumps([stage]), arrays=[points()])
    try:
        pipeline.execute()
    except RuntimeError:
        return None
    return pipeline.arrays[0]["GpsTime"] == -1


# ---- files of points -------------------------------------------------------------------------------------


def cloud(data: bytes) -> str:
    """A LAS or LAZ file: what passes the look at its header is read, whole or with an error."""
    path = put("cloud.laz", data)
    try:
        lascheck.check_readable(path)
        las.projection(path)
        las.odd_text(path)
        found = sources.las_extent(str(path))
        index = sort_points(str(path), TileGrid(10.0), str(path.with_suffix(".copy")))
        assert index.count == found.count
        las.supersede_copc(path)
        return "read"
    except StageError as error:
        assert "Traceback" not in str(error)
        return "refused"


# ---- indexes and descriptions of many files ----------------------------------------------------------------

_SUFFIXES = (".shp", ".geojson", ".gpkg")


def index(data: bytes) -> str:
    """A tile index; the first byte says of what kind."""
    suffix = _SUFFIXES[data[0] % 3] if data else ".shp"
    path = put(f"index{suffix}", data[1:])
    if suffix == ".shp":
        put("index.dbf", data[1:])
    try:
        found = tindex.locations(str(path))
        assert found and all(isinstance(name, str) and os.path.isabs(name) for name in found)
        return "read"
    except StageError as error:
        assert "Traceback" not in str(error)
        return "refused"


def ept(data: bytes) -> str:
    """The description of an EPT source."""
    path = put("ept.json", data)
    try:
        source = sources.InputSource(str(path), {"type": "readers.ept"}, "ept")
        found = sources.read_extent(source)
        assert found.count >= 0 and np.isfinite(found.box).all()
        TileGrid(10.0).covering(found.box)
        return "read"
    except StageError as error:
        assert "Traceback" not in str(error)
        return "refused"


# ---- what a tiled run keeps ---------------------------------------------------------------------------------


@cache
def _kept() -> tuple[Store, tuple[Path, ...]]:
    keeping = Store(folder())
    for place in (keeping.folder, keeping.tiles, keeping.indexes):
        place.mkdir(exist_ok=True)
    return keeping, (keeping.files, keeping.tiles / "a.json", keeping.indexes / "a.json")


def _notes() -> tuple[dict, dict]:
    report = {"fingerprint": "f", "outputs": [["/no/such", 1, 2]], "points": 3}
    return report, {"count": 3, "box": [0, 0, 1, 1], "tiles": [[0, 0, 3]], "cells": [[0, 0, 0, 3]]}


def _plain(index: Any) -> dict:
    return {name: np.asarray(value).tolist() for name, value in asdict(index).items() if name != "copy"}


def store(data: bytes) -> str:
    """Notes of a run: what was changed, or belongs elsewhere, is not believed."""
    keeping, paths = _kept()
    for path in paths:
        path.write_bytes(data)
    with keeping:
        found = keeping.written("a"), keeping.finished("a"), keeping.index("a")
    report, index = _notes()
    assert found[0] is None and found[1] in (None, report) and (found[2] is None or _plain(found[2]) == index)
    return "read" if any(found) else "refused"


@cache
def _result() -> tuple[bytes, sources.InputSource]:
    source = sources.InputSource("/a.las", {"type": "readers.las"}, "las")
    path = folder() / "result.npz"
    index = np.arange(40, dtype=np.int64)
    content = {
        "index": index,
        "core": np.array(40),
        "dim/Classification": (index % 7).astype(np.uint8),
        "dim/H": index / 7,
    }
    content = {f"{source.key}/{name}": value for name, value in content.items()}
    np.savez(path, names=np.array(sorted(content)), **content)
    return path.read_bytes(), source


def result(data: bytes) -> str:
    """The results of a tile: what was changed is found, whatever it is."""
    source = _result()[1]
    path = put("tile.npz", data)
    try:
        new = results.read_range([str(path)], source, 40, 0, 40)
    except StageError as error:
        assert "Traceback" not in str(error)
        return "refused"
    assert new.kept.all() and set(new.values) == {"Classification", "H"}
    assert np.array_equal(new.values["Classification"][1], np.arange(40) % 7)
    assert np.array_equal(new.values["H"][1], np.arange(40) / 7)
    return "read"


# ---- models with a network -----------------------------------------------------------------------------------


@cache
def network_model() -> bytes:
    """A small good model with a network."""
    import sys

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from alsnet_scenes import model_of, random_net

    path = folder() / "good.model"
    model_of(random_net(("Z", "Intensity"))).save(path)
    return path.read_bytes()


def network(data: bytes) -> str:
    """The manifest of a model with a network, its checksums put right; what is accepted classifies a small cloud."""
    from targets import _rehashed, packed

    from pdal_stages.classifier import load_model

    with zipfile.ZipFile(network_model() and folder() / "good.model") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["manifest.json"] = _rehashed(data, members)
    path = put("hostile.model", packed(members))
    rng = np.random.default_rng(1)
    xyz = np.round(rng.uniform(0, 30, (200, 3)), 2)
    started = time.process_time()
    try:
        model = load_model(path)
        assert str(model) and model.halo_m >= 0
        shares = model.predict(
            xyz, {"Intensity": rng.uniform(0, 100, 200)}, threads=1, probabilities=True
        ).probabilities
        assert np.isfinite(shares).all()
        outcome = "loaded"
    except StageError as error:
        assert "Traceback" not in str(error)
        outcome = "refused"
    assert time.process_time() - started < PATIENCE, "too slow"
    return outcome


TARGETS = {
    "where": where,
    "cloud": cloud,
    "index": index,
    "ept": ept,
    "store": store,
    "result": result,
    "network": network,
}


@cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Good inputs to start from."""
    return tuple(_SEEDS[name]())


def _where() -> list[bytes]:
    return [
        b"Z > 3 && !(Classification == 2) || X <= 2 && Y != 1",
        b"20 < Z", b"X / 0 > 1", b"(X + Y) * 2 >= Z - -1", b"!(!(Z == 2))", b"Z > 1e0 && .5 < X", b"3 > 2 && X == X",
        b"isnan(sqrt(Z)) || !(X < highest())", b"round(-Z) == -3 && floor(Z / 2) < abs(X)", b"!X == 1 && Z > 0",
        b"Classification[2:5]", b"1 + 2 * 3 == 7", b"((((Z)))) > 2",
    ]  # fmt: skip


def _clouds() -> list[bytes]:
    import laspy

    out = []
    for form in (0, 1, 3, 6, 7):
        for compressed in (False, True):
            header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
            header.scales = np.full(3, 0.01)
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", b"x" * 40))
            cloud = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(30, header=header))
            cloud.x, cloud.y = np.arange(30.0), np.arange(30.0)
            path = folder() / ("seed.laz" if compressed else "seed.las")
            cloud.write(path)
            out.append(path.read_bytes())
    return [*out, (Path(__file__).resolve().parents[1] / "data" / "town.copc.laz").read_bytes()[:20_000]]


def _indexes() -> list[bytes]:
    rows = b"".join(b" " + name.ljust(20) for name in (b"a.las", b"b/c.laz"))
    field = b"location".ljust(11, b"\0") + b"C" + bytes(4) + b"\x14" + bytes(15)
    dbf = struct.pack("<B3xIHH20x", 3, 2, 32 + 32 + 1, 21) + field + b"\r" + rows
    features = [
        {"type": "Feature", "properties": {"location": name}, "geometry": None} for name in ("a.las", "b.las")
    ]
    path = folder() / "seed.gpkg"
    path.unlink(missing_ok=True)
    with sqlite3.connect(path) as base:
        base.execute("PRAGMA page_size = 512")
        base.execute("CREATE TABLE pdal (fid INTEGER, location TEXT)")
        base.execute("INSERT INTO pdal VALUES (1, 'a.las'), (2, 'b.las')")
    base.close()
    return [
        b"\0" + dbf,
        b"\1" + json.dumps({"type": "FeatureCollection", "features": features}).encode(),
        b"\2" + path.read_bytes(),
    ]


def _ept() -> list[bytes]:
    schema = [{"name": n, "type": "signed", "size": 4, "scale": 0.01, "offset": 0} for n in "XYZ"]
    schema += [
        {"name": "Classification", "type": "unsigned", "size": 1},
        {"name": "Red", "type": "unsigned", "size": 2},
    ]
    box = [500000, 5400000, 0, 500100, 5400100, 50]
    whole = {"bounds": box, "boundsConforming": box, "points": 1000, "schema": schema, "span": 128, "dataType": "laszip",
             "hierarchyType": "json", "srs": {"authority": "EPSG", "horizontal": "25832", "wkt": ""}, "version": "1.0.0"}  # fmt: skip
    return [json.dumps(whole).encode()]


def _store() -> list[bytes]:
    from pdal_stages.tiling.store import _sealed

    report, index = _notes()
    files, tile, indexed = _kept()[1]
    return [
        _sealed(files, {"a": report}).encode(),
        _sealed(tile, report).encode(),
        _sealed(indexed, index).encode(),
    ]


def _network() -> list[bytes]:
    network_model()
    with zipfile.ZipFile(folder() / "good.model") as archive:
        manifest = archive.read("manifest.json")
    return [manifest, json.dumps(loads(manifest)).encode()]


_SEEDS = {
    "where": _where, "cloud": _clouds, "index": _indexes, "ept": _ept, "store": _store,
    "result": lambda: [_result()[0]], "network": _network,
}  # fmt: skip
