"""The model file: what is written comes back, nothing half-written, and hostile files are refused quickly."""

import io
import json
import struct
import time
import tracemalloc
import zipfile
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import RandomForestClassifier

from pdal_stages.base.errors import ModelError
from pdal_stages.classifier import model_file
from pdal_stages.classifier.interface import classifier_of
from pdal_stages.classifier.model_file import to_bytes
from pdal_stages.classifier.random_forest import Forest

FEATURES = 6


@cache
def forest(seed=0, trees=4):
    random = np.random.default_rng(seed)
    x = random.normal(size=(300, FEATURES)).astype(np.float32)
    y = (x[:, 0] > 0).astype(int) + (x[:, 1] > 0.5)
    reference = RandomForestClassifier(trees, random_state=seed, n_jobs=1).fit(x, y)
    return Forest.from_sklearn(reference.estimators_, FEATURES), reference, x


def manifest(**changes):
    only = {
        "algorithm": "random_forest",
        "parameters": {"trees": 4},
        "neighborhoods": ["s1"],
        "feature_names": [f"Feature{i}" for i in range(FEATURES)],
        "dimensions": [],
        "context": [],
        "shape_bins": None,
        "copt_threshold": None,
        "feature_seed": 0,
        "importances": [0.0] * FEATURES,
    }
    counts = {"available": 9, "samples": 9, "duplicates": 0}
    whole = {
        "strategy": "multiclass",
        "target": None,
        "background": None,
        "classes": [{"code": c, "name": str(c), "labels": [c], **counts} for c in (2, 5, 6)],
        "training": {"clouds": [], "count": 9, "seed": 0, "samples": 27},
        "accuracy": {"cross_validation": None},
        "preparation": [],
        "algorithms": {},
        "voxel": 0.0,
        "densities": {"low": 1.0, "high": 9.0},
        "created_by": {"pdal_stages": "0.1.0"},
    }
    return {**whole, "passes": [{**only, **{k: v for k, v in changes.items() if k in only}}]}


def rules(name):
    return classifier_of(name).rules


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.model"
    model_file.write(path, manifest(), [forest()[0].arrays()])
    return path


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def pack(path, contents, **options):
    with zipfile.ZipFile(
        path, "w", options.pop("compression", zipfile.ZIP_DEFLATED), **options
    ) as archive:
        for name, data in contents.items() if isinstance(contents, dict) else contents:
            archive.writestr(name, data)
    return path


def refuse(path, text=".", seconds=10.0, megabytes=100):
    """Reading must fail with a ModelError that names the file, soon and without much memory."""
    tracemalloc.start()
    started = time.process_time()
    try:
        with pytest.raises(ModelError, match=text) as caught:
            model_file.read(path, rules)
        assert time.process_time() - started < seconds
        assert tracemalloc.get_traced_memory()[1] < megabytes * 1e6
    finally:
        tracemalloc.stop()
    assert path.name in str(caught.value)
    return str(caught.value)


# ---- what is written comes back ------------------------------------------------------------------------


def test_round_trip_equals_sklearn(tmp_path):
    output, reference, x = forest()
    path = tmp_path / "m.model"
    model_file.write(path, manifest(), [output.arrays()])
    read, (arrays,) = model_file.read(path, rules)
    assert {k: v for k, v in read.items() if k not in ("format", "version", "arrays")} == manifest()
    again = Forest.from_arrays(arrays, FEATURES, 3)
    assert np.array_equal(again.predict_proba(x), reference.predict_proba(x))
    assert np.array_equal(again.predict_proba(x).argmax(axis=1), reference.predict(x))


def test_the_documented_layout_is_enough_to_read_a_file(good):
    """Zip, JSON, .npy: another program's reader, in a few lines, without this package."""
    with zipfile.ZipFile(good) as archive:
        head = json.loads(archive.read("manifest.json"))
        a = {
            name[2:]: np.load(io.BytesIO(archive.read(entry["file"])), allow_pickle=False)
            for name, entry in head["arrays"].items()
        }
    row = forest()[2][0]
    share, start, leaf = np.zeros(3), 0, 0
    for size in a["tree_sizes"]:
        feature, threshold = (a[key][start : start + size] for key in ("feature", "threshold"))
        i = 0
        while feature[i] >= 0:
            k = np.count_nonzero(feature[:i] >= 0)
            i = 2 * k + 1 if row[feature[i]] <= threshold[i] else 2 * k + 2
        counts = a["leaf_counts"][leaf + np.count_nonzero(feature[:i] < 0)]
        share += counts / counts.sum()
        start, leaf = start + size, leaf + np.count_nonzero(feature < 0)
    assert np.allclose(share / len(a["tree_sizes"]), forest()[1].predict_proba(row[None])[0])


# ---- files that are none -------------------------------------------------------------------------------


def test_cut_short_anywhere(good):
    data = good.read_bytes()
    for size in {*range(0, len(data), max(1, len(data) // 20)), len(data) - 1}:
        good.write_bytes(data[:size])
        refuse(good)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**9), st.integers(1, 255), st.integers(1, 4))
def test_a_flipped_byte_is_noticed_or_harmless(tmp_path_factory, at, flip, times):
    """Whatever byte is changed: an error, or exactly the model that was stored."""
    path = tmp_path_factory.mktemp("flip") / "m.model"
    model_file.write(path, manifest(), [forest(trees=1)[0].arrays()])
    want = model_file.read(path, rules)
    data = bytearray(path.read_bytes())
    for k in range(times):
        data[(at * (k + 1)) % len(data)] ^= flip
    path.write_bytes(bytes(data))
    try:
        read, arrays = model_file.read(path, rules)
    except ModelError:
        return
    assert read == want[0]
    assert all(np.array_equal(arrays[0][name], want[1][0][name]) for name in arrays[0])


def test_members_are_exactly_those_listed(good, tmp_path):
    stored = members(good)
    bad = tmp_path / "bad.model"
    refuse(pack(bad, {**stored, "more.txt": b"x"}), "differ")
    refuse(pack(bad, {**stored, "../../outside.npy": b"x"}), "differ")
    refuse(pack(bad, {**stored, "/etc/passwd": b"x"}), "differ")
    refuse(pack(bad, {k: v for k, v in stored.items() if "threshold" not in k}), "differ")
    refuse(pack(bad, {k: v for k, v in stored.items() if k != "manifest.json"}), "without manifest")
    with pytest.warns(UserWarning, match="Duplicate"):
        pack(bad, [*stored.items(), ("manifest.json", stored["manifest.json"])])
    refuse(bad, "twice")
    refuse(pack(bad, stored, compression=zipfile.ZIP_LZMA), "unsupported compression")


def changed(path, edit, rehash=True):
    """The file again with its manifest or arrays edited; checksums put right, as an attacker would."""
    import hashlib

    stored = members(path)
    head = json.loads(stored["manifest.json"])
    edit(head, stored)
    if rehash and isinstance(head.get("arrays"), dict):
        for entry in head["arrays"].values():
            if entry.get("file") in stored:
                entry["sha256"] = hashlib.sha256(stored[entry["file"]]).hexdigest()
    stored["manifest.json"] = json.dumps(head).encode()
    return pack(path, stored)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("format", "something else", "not a model"),
        ("version", 4, "version"),
        ("version", True, "version"),
        ("algorithm", "magic", "does not know"),
        ("classes", [{"code": 300}] * 3, "classes"),
        ("feature_names", ["a"] * 6, "feature_names"),
        ("importances", ["x"], "importances"),
        ("extra", 1, "extra"),
        ("arrays", {}, "arrays"),
    ],
)
def test_manifest_is_held_against_its_schema(good, key, value, text):
    def edit(head, _):
        (head if key in head or key == "extra" else head["passes"][0]).update({key: value})

    refuse(changed(good, edit), text)


def test_manifests_that_are_no_manifest(good):
    stored = members(good)
    for data, text in (
        (b"\xff\xfe{}", "JSON"),
        (b"{", "JSON"),
        (b"[1, 2]", "something else"),
        (b'{"a": NaN}', "NaN"),
        (b'{"a": 1e999}', "too large"),
        (b'{"a": 1%s}' % (b"0" * 400), "too large"),
        (b'{"a": 1, "a": 2}', "duplicate key"),
        (b"[" * 200_000 + b"]" * 200_000, "deep"),
        (b" " * (model_file.MANIFEST_LIMIT + 1), "too large"),
    ):
        refuse(pack(good, {**stored, "manifest.json": data}), text)


def test_checksum(good):
    def edit(head, stored):
        name = head["arrays"]["1.threshold"]["file"]
        stored[name] = stored[name][:-4] + b"\0\0\x80?"

    refuse(changed(good, edit, rehash=False), "SHA-256")


def npy(descr="'<f4'", shape="(4,)", fortran="False", data=b"\0" * 16, magic=b"\x93NUMPY\x01\x00"):
    head = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}"
    head = head + " " * (-(len(head) + 11) % 64) + "\n"
    return magic + struct.pack("<H", len(head)) + head.encode() + data


@pytest.mark.parametrize(
    "data",
    [
        b"",
        npy(magic=b"\x93NUMPY\x02\x00"),
        npy(descr="'|O'"),
        npy(descr="'>f4'"),
        npy(descr="'<f8'", shape="(2,)"),
        npy(descr="[('a', '<f4')]"),
        npy(fortran="True"),
        npy(shape="(5,)"),
        npy(shape="(999999999999999, 999999999999999, 999999999999999)"),
        npy(shape="(-4,)"),
        npy(shape="(2, 2)"),
        npy(shape="()"),
        npy(shape="(True,)", data=b"\0" * 4),
        npy(shape="(__import__('os').system('true'),)"),
    ],
)
def test_hostile_arrays_are_refused(data, good):
    def edit(head, stored):
        stored[head["arrays"]["1.threshold"]["file"]] = data

    refuse(changed(good, edit))


def test_zip_bomb(good):
    stored = members(good)

    def edit(head, stored):
        stored[head["arrays"]["1.threshold"]["file"]] = to_bytes(np.zeros(20_000_000, np.float32))
        head["arrays"]["1.threshold"]["shape"] = [20_000_000]

    bomb = changed(good, edit)
    assert bomb.stat().st_size < 1e6
    refuse(bomb, "unpack to far more", seconds=2.0, megabytes=20)
    refuse(pack(good, {**stored, "manifest.json": b" " * 80_000_000}), "far more", 2.0, 20)


def test_declared_size_is_not_believed(good):
    """A member that says it is small but unpacks to much: only what was declared is unpacked."""
    stored = members(good)
    stored["arrays/1.threshold.npy"] = b"\0" * 50_000_000
    pack(good, stored)
    data = bytearray(good.read_bytes())
    real = struct.pack("<L", 50_000_000)
    assert data.count(real) == 2
    for _ in range(2):
        at = data.index(real)
        data[at : at + 4] = struct.pack("<L", 1000)
    good.write_bytes(bytes(data))
    refuse(good, megabytes=20)
