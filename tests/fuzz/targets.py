"""What the fuzz tests call: readers of ours, given any bytes, and what must hold of them.

Each takes bytes and returns in a word how it ended, or raises; only :class:`StageError` is caught
here, so anything else that comes out is a finding.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import io
import json
import os
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from pdal_stages import TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.base import las, las_check
from pdal_stages.base.errors import StageError
from pdal_stages.base.las_points import Layout
from pdal_stages.base.octrees import check_ept
from pdal_stages.classifier import model_file
from pdal_stages.classifier.interface import classifier_of
from pdal_stages.classifier.model import assemble
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.expansion import expand
from pdal_stages.pipeline.json_source import (
    apply_overrides,
    decode,
    parse_overrides,
    parse_pipeline,
)
from pdal_stages.tiling import inputs
from pdal_stages.tiling.options import TileGrid
from pdal_stages.tiling.sorted_points import sort_points

TESTS = Path(__file__).resolve().parents[1]
#: Name -> what is called, and good inputs to start from.
TARGETS: dict[str, tuple[Callable[[bytes], str], Callable[[], list[bytes]]]] = {}


def target(seeds: Callable[[], list[bytes]]):
    """Register a function that may raise StageError: "refused" where it does."""

    def register(function: Callable[[bytes], str]):
        def call(data: bytes) -> str:
            try:
                return function(data)
            except StageError as error:
                assert str(error).strip().endswith((".", "?", "!")) and "Traceback" not in str(
                    error
                )
                return "refused"

        TARGETS[function.__name__] = call, cache(seeds)
        return call

    return register


@cache
def folder() -> Path:
    """A folder in memory, until the process ends."""
    memory = Path("/dev/shm")
    path = Path(
        tempfile.mkdtemp(prefix="fuzz-", dir=memory if os.access(memory, os.W_OK) else None)
    )
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


def put(name: str, data: bytes) -> Path:
    path = folder() / name
    path.write_bytes(data)
    return path


# ---- pipelines ------------------------------------------------------------------------------


def _pipelines() -> list[bytes]:
    ready = sorted((TESTS.parent / "pipelines").glob("*.json"))
    return [path.read_bytes() for path in ready] + [
        b'["a.las",{"type":"filters.hag_minima","tag":"a","cell":20,"where":"Z > 3 && '
        b'!(Classification == 7)"},"b.laz"]',
        b'\xef\xbb\xbf// c\r\n{"pipeline":[{"type":"readers.las","filename":"*.las","tag":"r"},'
        b'{"type":"filters.multiscalefeatures","inputs":["r"],"neighborhoods":["c1","kopt(10,50)","copt"],'
        b'"feature_set":"all","seed":3},/* x '
        b'*/{"type":"writers.las","filename":"o#.las","extra_dims":"all",'
        b'"minor_version":4,"dataformat_id":6,"forward":"all"}]}',
        b'[{"type":"writers.classifiermodel","filename":"m.model","classes":{"2":"Ground","3,4,5":"5 Vegetation",'
        b'"6":6},"target":2,"trees":10,"dimensions":["Intensity"]}]',
    ]


@target(_pipelines)
def pipeline(data: bytes) -> str:
    """Parse, override, expand: what PDAL gets is JSON, with no stage of ours left and none of
    PDAL's lost."""
    source = parse_pipeline(decode(data, "fuzz.json"), "fuzz.json")
    assert len(source.lines) == len(source.stages) and all(line >= 1 for line in source.lines)
    overrides, _ = parse_overrides(
        ["--stage.a.cell=5", "--filters.hag_minima.resolution=0.25"][: len(data) % 3]
    )
    with contextlib.suppress(StageError):  # one that fits no stage
        source.stages = apply_overrides(source.stages, overrides)
    source.stages = pdal_env.with_types(source.stages)
    expanded = expand(source)
    assert json.loads(json.dumps(expanded.stages, allow_nan=False)) == expanded.stages
    types = [str(stage.get("type", "")) for stage in expanded.stages]
    assert not {
        "filters.hag_minima",
        "filters.multiscalefeatures",
        "writers.classifiermodel",
    } & set(types)
    assert types.count("filters.python") >= len(expanded.ours) and len(types) >= len(source.stages)
    return "expanded"


# ---- files of points, and what names many of them ------------------------------------------------------------


def _clouds() -> list[bytes]:
    out = []
    for form in (0, 1, 3, 6, 7):
        for suffix in ("las", "laz"):
            header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
            header.scales = np.full(3, 0.01)
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", b"x" * 40))
            las_data = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(30, header=header))
            las_data.x, las_data.y = np.arange(30.0), np.arange(30.0)
            las_data.write(folder() / f"seed.{suffix}")
            out.append((folder() / f"seed.{suffix}").read_bytes())
    return [*out, (TESTS / "data" / "town.copc.laz").read_bytes()[:20_000]]


@target(_clouds)
def cloud(data: bytes) -> str:
    """A LAS or LAZ file: what passes the look at its header is read, whole or with an error."""
    path = put("cloud.laz", data)
    las_check.check_readable(path)
    las.projection_digest(path)
    assert Layout.of_file(path).fields
    extent = inputs.las_extent(str(path))
    copy = str(path.with_suffix(".copy"))
    index = sort_points(str(path), TileGrid(10.0), TileGrid(250.0), copy)
    assert index.count == extent.count
    las.supersede_copc(path)
    return "read"


def _epts() -> list[bytes]:
    schema = [{"name": n, "type": "signed", "size": 4, "scale": 0.01, "offset": 0} for n in "XYZ"]
    schema += [{"name": "Classification", "type": "unsigned", "size": 1}]
    box = [500000, 5400000, 0, 500100, 5400100, 50]
    whole = {"bounds": box, "boundsConforming": box, "points": 1000, "schema": schema, "span": 128, "dataType": "laszip",
             "hierarchyType": "json", "srs": {"authority": "EPSG", "horizontal": "25832", "wkt": ""}, "version": "1.0.0"}  # fmt: skip
    return [json.dumps(whole).encode()]


@target(_epts)
def ept(data: bytes) -> str:
    """The description of an EPT source."""
    path = put("ept.json", data)
    path.with_name("ept-hierarchy").mkdir(exist_ok=True)
    (path.with_name("ept-hierarchy") / "0-0-0-0.json").write_text('{"0-0-0-0": 0}')
    described = check_ept(str(path))
    assert int(described["points"]) >= 0 and np.isfinite(described["boundsConforming"]).all()
    return "read"


# ---- model files -----------------------------------------------------------------------------------------


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


@cache
def good_model() -> dict[str, bytes]:
    """Members of a small good model file, which needs heights and says where from."""
    rng = np.random.default_rng(0)
    xyz = np.round(rng.uniform(0, 12, (400, 3)), 2)
    options = TrainingOptions(
        neighborhoods="c1,s2", feature_set=["covariance", "D1"], dimensions=("HeightAboveGround",), count=60, trees=2,
        threads=1, passes=1, folds=0,
    )  # fmt: skip
    labels = np.where(xyz[:, 2] > 6, 6, 2)
    model = train(
        [TrainingCloud(xyz, labels, {"HeightAboveGround": xyz[:, 2]}, "fuzz")],
        options,
        progress=False,
    )
    model.info["preparation"] = [{"type": "filters.hag_minima", "cell": 5}]
    model.save(folder() / "good.model")
    return members_of(folder() / "good.model")


def packed(members: dict[str, bytes], manifest: bytes | None = None) -> bytes:
    """A zip of members; with another manifest, where given, whose checksums are put right as an
    attacker would."""
    if manifest is not None:
        with contextlib.suppress(Exception):  # whatever else was made of it goes in as it is
            head = json.loads(manifest)
            for entry in head["arrays"].values():
                if entry.get("file") in members:
                    entry["sha256"] = hashlib.sha256(members[entry["file"]]).hexdigest()
            manifest = json.dumps(head).encode()
        members = {**members, model_file.MANIFEST: manifest}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    return out.getvalue()


def _model_file(data: bytes) -> bytes:
    """The first byte says which part of a good file the others replace.

    0: the whole file; 1: the manifest; 2: the manifest, with checksums put right; from 3 on: the
    values of one array.
    """
    if not data or data[0] == 0:
        return data[1:]
    members = dict(good_model())
    if data[0] == 1:
        return packed(members | {model_file.MANIFEST: data[1:]})
    if data[0] == 2:
        return packed(members, data[1:])
    names = sorted(name for name in members if name != model_file.MANIFEST)
    name = names[(data[0] - 3) % len(names)]
    start = 10 + int.from_bytes(members[name][8:10], "little")
    values = bytearray(members[name][start:])
    values[: len(data) - 1] = data[1 : len(values) + 1]
    members[name] = members[name][:start] + bytes(values)
    return packed(members, members[model_file.MANIFEST])


def _models() -> list[bytes]:
    manifest = good_model()[model_file.MANIFEST]
    parts = [bytes([k]) + b"\0" * 8 for k in range(3, 12)]
    return [b"\0" + packed(good_model()), b"\1" + manifest, b"\2" + manifest, *parts]


@target(_models)
def model(data: bytes) -> str:
    """Read a model file and, where it is accepted, classify with it."""
    manifest, arrays = model_file.read(
        put("fuzz.model", _model_file(data)), lambda name: classifier_of(name).rules
    )
    loaded = assemble(manifest, arrays)
    assert str(loaded) and loaded.halo_m >= 0
    loaded.importances()
    codes = [code for code, _ in loaded.classes]
    for classifier in loaded.passes:
        values = (
            np.random.default_rng(1)
            .normal(size=(50, len(classifier.inputs(codes))))
            .astype(np.float32)
        )
        shares = classifier.probabilities(values)
        assert (
            shares.shape == (50, len(codes)) and np.isfinite(shares).all() and (shares >= 0).all()
        )
        assert np.allclose(shares.sum(axis=1), 1, atol=1e-5)
    return "loaded"


@cache
def _network_model() -> dict[str, bytes]:
    sys.path.insert(0, str(TESTS))
    from alsnet_scenes import model_of, random_net

    model_of(random_net(("Z", "Intensity"))).save(folder() / "network.model")
    return members_of(folder() / "network.model")


@target(lambda: [_network_model()[model_file.MANIFEST]])
def network(data: bytes) -> str:
    """The manifest of a model with a network; what is accepted classifies a small cloud."""
    loaded: Any = load_model(put("hostile.model", packed(_network_model(), data)))
    rng = np.random.default_rng(1)
    xyz = np.round(rng.uniform(0, 30, (200, 3)), 2)
    assert str(loaded) and loaded.halo_m >= 0
    prediction = loaded.predict(
        xyz, {"Intensity": rng.uniform(0, 100, 200)}, threads=1, probabilities=True
    )
    assert np.isfinite(prediction.probabilities).all()
    return "loaded"
