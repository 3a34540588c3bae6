"""Each two things together: a covering array over inputs, doors, models, tiles, options and writers.

What has gone wrong in use lay mostly between two things that each have tests of their own. Every pair of values of two of
these parameters is in one row at least; `--all-pairs` runs all rows, else the first ones, which hold most pairs. A row ends
with the classes that a plain run of its input gives.
"""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from alsnet_scenes import model_of, random_net

import pdal_stages as ps
from pdal_stages.classifier.model import load_model
from pdal_stages.classifier.model_file import find
from pdal_stages.cli import main
from pdal_stages.pipeline import pdal as pdal_env

allpairs = pytest.importorskip("allpairspy").AllPairs

pytestmark = pytest.mark.pdal
#: Rows that run without --all-pairs.
FIRST = 9
OPTIONS = {
    "none": {},
    "where": {"where": "Classification != 1"},
    "ignore": {"ignore": "7"},
    "keep": {"keep": "1,12"},
    "reject_below": {"reject_below": 0.6, "rejected_code": 0},
    "vegetation_heights": {"vegetation_heights": "0.5,2"},
    "probabilities": {"probabilities": True},
}
WRITERS = {
    "las 1.2": {"type": "writers.las", "minor_version": 2, "dataformat_id": 1, "forward": "all"},
    "las 1.4": {"type": "writers.las", "minor_version": 4, "dataformat_id": 6, "forward": "all"},
    "laz": {"type": "writers.las", "forward": "all", "extra_dims": "all"},
    "text": {"type": "writers.text", "order": "X,Y,Z,Classification", "keep_unspecified": False, "precision": 4},
}  # fmt: skip
SUFFIXES = {"las 1.2": "las", "las 1.4": "las", "laz": "laz", "text": "txt"}
TILES = {
    "none": [],
    "no workers": ["--tile", "30", "--workers", "0"],
    "two workers, per tile": ["--tile", "30", "--workers", "2", "--per", "tile"],
    "two workers, per file": ["--tile", "30", "--workers", "2", "--per", "file"],
    "resumed": ["--tile", "30", "--workers", "0"],
}
VALUES = {
    "input": ["las 1.2", "las 1.4", "laz 1.4", "copc", "several"],
    "door": ["classify", "pipeline"],
    "model": ["standard", "one pass", "two passes", "network"],
    "tiles": list(TILES),
    "option": list(OPTIONS),
    "writer": list(WRITERS),
}  # fmt: skip
ROWS = [tuple(row) for row in allpairs(list(VALUES.values()))]


@pytest.fixture(scope="session")
def scenes(tmp_path_factory, write_las):
    """Files of every kind of input."""
    folder = tmp_path_factory.mktemp("pairs")
    town = ps.make_town(50.0, 4.0, seed=5)
    rng = np.random.default_rng(1)
    n = len(town.xyz)
    arrays = {
        **dict(zip("XYZ", np.round(town.xyz, 3).T, strict=True)),
        "Classification": rng.choice(np.array([1, 2, 7, 12], np.uint8), n, p=[0.5, 0.4, 0.05, 0.05]),
        "ReturnNumber": np.ones(n, np.uint8),
        "NumberOfReturns": np.ones(n, np.uint8),
        "GpsTime": np.arange(n, dtype=float),
        "Withheld": (rng.random(n) < 0.03).astype(np.uint8),
        "Synthetic": (rng.random(n) < 0.1).astype(np.uint8),
    }  # fmt: skip
    x = arrays["X"] - 500_000
    plain, modern = {"point_format": 1}, {"point_format": 6}

    def part(mask):
        return {name: values[mask] for name, values in arrays.items()}

    return {
        "las 1.2": [write_las(folder / "old.las", arrays, **plain)],
        "las 1.4": [write_las(folder / "new.las", arrays, **modern)],
        "laz 1.4": [write_las(folder / "new.laz", arrays, **modern)],
        # made by tests/data/make_copc.py of commit b10145c
        "copc": [Path(__file__).parent / "data" / "town.copc.laz"],
        "several": [write_las(folder / f"p{k}.laz", part((x > 25) == k), **plain) for k in (0, 1)],
    }


@pytest.fixture(scope="session")
def models(tmp_path_factory, write_las):
    folder = tmp_path_factory.mktemp("models")
    town = ps.make_town(60.0, 4.0, seed=9)
    arrays = {**dict(zip("XYZ", town.xyz.T, strict=True)), "Classification": town.classification}
    source = str(write_las(folder / "train.laz", arrays, point_format=6))
    paths = {"standard": "standard", "network": str(folder / "network.model")}
    for name, more in {
        "one pass": {"passes": 1},
        "two passes": {"passes": 2},
    }.items():
        paths[name] = str(folder / f"{name.replace(' ', '-')}.model")
        train = {
            "type": "writers.classifiermodel",
            "filename": paths[name],
            "count": 200,
            "trees": 8,
        }
        train |= {"neighborhoods": "k10,s2", "feature_set": "covariance", "folds": 0}
        train["classes"] = {"2": 2, "3,4,5": 5, "6": 6}
        ps.run_pipeline([source, {"type": "filters.hag_minima", "cell": 5}, {**train, **more}])
    model_of(random_net(("Z",), seed=4)).save(paths["network"])
    return paths


_plain: dict[tuple, np.ndarray] = {}


def columns(x, y, z, codes):
    """Points in one order, whatever theirs: whole millimeters, and class."""
    out = [np.rint(np.asarray(v, float) * 1000) for v in (x, y, z)]
    out = np.column_stack([*out, np.asarray(codes, float)])
    return out[np.lexsort(out.T[::-1])]


def expected(row, files, model, old):
    """The points of a plain run, without tiles or writer; `old`: as files before LAS 1.4 say it.

    Class 12 of these is class 0 with the flag Overlap to newer PDAL, which writes 12 into such files again.
    """
    key = (row["input"], row["model"], row["option"], old)
    if key not in _plain:
        pipeline = ps.Pipeline([*map(str, files), *stages(model, row)])
        pipeline.execute()
        a = np.concatenate(pipeline.arrays)
        codes = a["Classification"]
        if not {"ClassFlags", "Withheld"} & set(a.dtype.names):
            codes = codes & 31  # flags of old files, as PDAL 2.2 reads them
        if old and "Overlap" in a.dtype.names:
            codes = np.where(a["Overlap"] == 1, np.uint8(12), codes)
        _plain[key] = columns(a["X"], a["Y"], a["Z"], codes)
    return _plain[key]


def stages(model, row):
    """Heights as in training, and the classifier."""
    heights = load_model(find(model)).info.get("preparation") or []
    if row["option"] == "vegetation_heights" and not heights:
        heights = [{"type": "filters.hag_minima", "cell": 5}]
    classify = {"type": "filters.modelclassifier", "model": model, **OPTIONS[row["option"]]}
    return [*heights, classify]


def command_of(row, files, model, folder):
    """The words of the row's command."""
    writer, words = WRITERS[row["writer"]], list(TILES[row["tiles"]])
    names = "o_#" if words or (len(files) > 1 and row["door"] == "classify") else "o"
    target = str(folder / f"{names}.{SUFFIXES[row['writer']]}")
    if row["door"] == "pipeline":
        last = {**writer, "filename": target}
        pipeline = json.dumps([*map(str, files), *stages(model, row), last])
        (folder / "job.json").write_text(pipeline)
        return ["pipeline", str(folder / "job.json"), *words]
    options = dict(OPTIONS[row["option"]])
    words += ["--where", options.pop("where")] if "where" in options else []
    words += [f"--filters.modelclassifier.{name}={value}" for name, value in options.items()]
    if row["writer"].startswith("las"):
        words += [f"--writers.las.{k}={writer[k]}" for k in ("minor_version", "dataformat_id")]
    return ["classify", *map(str, files), target, "--model", model, "--no-noise", *words]


def read_back(path):
    """X, Y, Z and class of an output, (n, 4)."""
    if path.suffix != ".txt":
        las = laspy.read(path)
        return np.column_stack([las.x, las.y, las.z, las.classification])
    head, text = path.read_text().split("\n", 1)
    names = [name.strip('"').lower() for name in head.split(",")]
    table = np.array([line.split(",") for line in text.splitlines()], float)
    return table[:, [names.index(name) for name in ("x", "y", "z", "classification")]]


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", range(len(ROWS)), ids=lambda n: f"{n}-{'-'.join(ROWS[n])}".replace(" ", "_")
)
def test_row(number, request, scenes, models, tmp_path, capfd):
    if number >= FIRST and not request.config.getoption("--all-pairs"):
        pytest.skip("--all-pairs runs all rows")
    row = dict(zip(VALUES, ROWS[number], strict=True))
    files, model = scenes[row["input"]], models[row["model"]]
    command = command_of(row, files, model, tmp_path)
    code, said = main(command), capfd.readouterr().err
    if code and not pdal_env.splits_class_flags():  # flags of old files, through PDAL
        assert "as parts of the class" in said and not [*tmp_path.glob("o*")]
        return
    assert code == 0, said
    outputs = sorted(tmp_path.glob("o*"))
    if row["tiles"] == "resumed":
        before = outputs[0].read_bytes()
        outputs[0].unlink()
        assert main([*command, "--resume"]) == 0, capfd.readouterr().err
        assert outputs[0].read_bytes() == before
    result = columns(*np.concatenate([*map(read_back, outputs)]).T)
    las = row["writer"] != "text"
    wanted = expected(row, files, model, las and laspy.read(outputs[0]).point_format.id < 6)
    codes, right = result[:, 3].astype(int), wanted[:, 3].astype(int)
    assert np.array_equal(np.bincount(codes), np.bincount(right))
    assert np.abs(result[:, :3] - wanted[:, :3]).max() <= 10.5  # a centimeter, in writers of LAS
    assert (codes == right).mean() > (0.9 if las else 0.9999)
