"""What the fuzzers call: the two parsers of ours, given any bytes, and what must hold of them.

Each takes bytes and returns normally or raises; only :class:`StageError` is caught here, so anything else that
comes out is a finding. No atheris is needed: the tests run the same functions on stored cases.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import tempfile
import time
import zipfile
from functools import cache
from pathlib import Path

import numpy as np

from pdal_stages.base.errors import StageError
from pdal_stages.classifier import modelfile
from pdal_stages.classifier.model import assemble
from pdal_stages.pipeline.lowering import lower
from pdal_stages.pipeline.overrides import apply_overrides, parse_overrides
from pdal_stages.pipeline.read import decode, parse_pipeline

#: CPU seconds one input may take; beyond it is a finding (the largest inputs of the fuzzers are a few kB).
PATIENCE = 10.0


def pipeline(data: bytes) -> str:
    """Parse, override, lower; "refused" or "lowered"."""
    started = time.process_time()
    try:
        source = parse_pipeline(decode(data, "fuzz.json"), "fuzz.json")
        assert len(source.lines) == len(source.stages)
        assert all(line >= 1 for line in source.lines)
        overrides, _ = parse_overrides(
            ["--stage.a.cell=5", "--filters.hag_minima.resolution=0.25"][: len(data) % 3]
        )
        with contextlib.suppress(StageError):  # one that fits no stage
            source.stages = apply_overrides(source.stages, overrides)
        lowered = lower(source)
        # What PDAL gets is JSON, with no stage of ours left and none of PDAL's lost.
        again = json.loads(json.dumps(lowered.stages, allow_nan=False))
        assert again == lowered.stages
        types = [str(stage.get("type", "")) for stage in lowered.stages]
        assert not any(
            t in ("filters.hag_minima", "filters.multiscalefeatures", "writers.classifiermodel")
            for t in types
        )
        assert types.count("filters.python") >= len(lowered.ours)
        assert len(types) >= len(source.stages)
        outcome = "lowered"
    except StageError as error:
        assert str(error).strip().endswith((".", "?", "!")) and "Traceback" not in str(error)
        outcome = "refused"
    assert time.process_time() - started < PATIENCE, "too slow"
    return outcome


# ---- model files -----------------------------------------------------------------------------------------


@cache
def good_model() -> dict[str, bytes]:
    """Members of a small good model file."""
    from pdal_stages.classifier import TrainingCloud, TrainingOptions, train

    rng = np.random.default_rng(0)
    xyz = np.round(rng.uniform(0, 12, (400, 3)), 2)
    labels = np.where(xyz[:, 2] > 6, 5, 2)
    options = TrainingOptions(
        neighborhoods="c1,s2", feature_set=["covariance", "D1"], dimensions=(), count=60, trees=2, threads=1
    )
    model = train([TrainingCloud(xyz=xyz, labels=labels, dimensions={}, name="fuzz")], options)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "m")
        with zipfile.ZipFile(Path(folder) / "m") as archive:
            return {info.filename: archive.read(info) for info in archive.infolist()}


def packed(members: dict[str, bytes]) -> bytes:
    """A zip of members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    return out.getvalue()


def model_file(data: bytes) -> bytes:
    """A model file from the fuzzer's bytes; the first byte says which part of a good file they replace.

    0: the whole file; 1: the manifest; 2: the manifest, with checksums put right as an attacker would; from 3 on: the
    values of one array, with its checksum put right.
    """
    if not data or data[0] == 0:
        return data[1:]
    members = dict(good_model())
    if data[0] in (1, 2):
        members[modelfile.MANIFEST] = data[1:]
        if data[0] == 2:
            members[modelfile.MANIFEST] = _rehashed(data[1:], members)
        return packed(members)
    names = sorted(name for name in members if name != modelfile.MANIFEST)
    name = names[(data[0] - 3) % len(names)]
    whole, fresh = members[name], data[1:]
    start = 10 + int.from_bytes(whole[8:10], "little")
    values = bytearray(whole[start:])
    values[: len(fresh)] = fresh[: len(values)]
    members[name] = whole[:start] + bytes(values)
    members[modelfile.MANIFEST] = _rehashed(members[modelfile.MANIFEST], members)
    return packed(members)


def _rehashed(manifest: bytes, members: dict[str, bytes]) -> bytes:
    try:
        head = json.loads(manifest)
        for entry in head["arrays"].values():
            if entry.get("file") in members:
                entry["sha256"] = hashlib.sha256(members[entry["file"]]).hexdigest()
        return json.dumps(head).encode()
    except Exception:  # whatever the fuzzer made of it goes in as it is
        return manifest


@cache
def _scratch() -> Path:
    folder = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else Path(tempfile.gettempdir())
    return folder / f"fuzz-{os.getpid()}.model"


def model(data: bytes) -> str:
    """Read a model file and, where it is accepted, classify with it; "refused" or "loaded"."""
    from pdal_stages.classifier.algorithms import algorithm

    path = _scratch()
    content = model_file(data)
    started = time.process_time()
    try:
        path.write_bytes(content)
        manifest, arrays = modelfile.read(path, lambda name: algorithm(name).rules)
        made = assemble(manifest, arrays)
        assert str(made) and made.describe() and made.halo_m >= 0
        made.importances()
        codes = [code for code, _ in made.classes]
        for one in made.passes:
            values = np.random.default_rng(1).normal(size=(50, len(one.columns(codes)))).astype(np.float32)
            shares = one.probabilities(values)
            assert shares.shape == (50, len(codes))
            assert np.isfinite(shares).all() and (shares >= 0).all()
            assert np.allclose(shares.sum(axis=1), 1, atol=1e-5)
        outcome = "loaded"
    except StageError as error:
        assert str(error).strip().endswith((".", "?", "!")) and "Traceback" not in str(error)
        outcome = "refused"
    finally:
        path.unlink(missing_ok=True)
    assert time.process_time() - started < PATIENCE, "too slow"
    return outcome


TARGETS = {"pipeline": pipeline, "model": model}


def seeds(name: str) -> list[bytes]:
    """Good inputs to start from."""
    if name == "model":
        good = good_model()
        manifest = good[modelfile.MANIFEST]
        whole = packed(good)
        return [b"\0" + whole, b"\1" + manifest, b"\2" + manifest] + [
            bytes([k]) + b"\0" * 8 for k in range(3, 12)
        ]
    ready = sorted((Path(__file__).resolve().parents[2] / "pipelines").glob("*.json"))
    return [path.read_bytes() for path in ready] + [
        b'["a.las",{"type":"filters.hag_minima","tag":"a","cell":20,"where":"Z > 3 && !(Classification == 7)"},"b.laz"]',
        b'\xef\xbb\xbf// c\r\n{"pipeline":[{"type":"readers.las","filename":"*.las","tag":"r"},'
        b'{"type":"filters.multiscalefeatures","inputs":["r"],"neighborhoods":["c1","kopt(10,50)","copt"],'
        b'"feature_set":"all","seed":3},/* x */{"type":"writers.las","filename":"o#.las","extra_dims":"all",'
        b'"minor_version":4,"dataformat_id":6,"forward":"all"}]}',
        b'[{"type":"filters.accuracy","dimension":"Classification","classes":[2,5],"merge":{"5":[3,4]}}]',
        b'[{"type":"writers.classifiermodel","filename":"m.model","classes":{"2":"Ground","3,4,5":"5 Vegetation",'
        b'"6":6},"strategy":"binary","target":2,"trees":10,"dimensions":["Intensity"]}]',
        b'[{"type":"filters.modelclassifier","model":"m.model","reject_below":0.5}]',
    ]
