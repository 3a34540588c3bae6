"""Each two things together: a covering array over inputs, doors, models, tiles, options and writers.

What has gone wrong in use lay mostly between two things that each have tests of their own. Every pair of values of two of
these parameters is in one row at least; `--all-pairs` runs all rows, else the first ones, which hold most pairs. A row ends
with the classes that a plain run of its input gives.
"""

from __future__ import annotations

import itertools
import json
import subprocess
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
VALUES = {
    "input": [
        "las 1.2",
        "las 1.4",
        "laz 1.4",
        "copc",
        "feet",
        "several",
        "gaps",
        "noise unlabeled",
    ],
    "door": ["classify", "pipeline", "objects", "stock"],
    "model": ["standard", "one pass", "two passes", "binary", "network"],
    "tiles": ["none", "no workers", "two workers, per tile", "two workers, per file", "resumed"],
    "option": [
        "none",
        "where",
        "ignore",
        "keep",
        "reject_below",
        "vegetation_heights",
        "probabilities",
    ],
    "writer": ["las 1.2", "las 1.4", "laz", "text", "gdal", "ogr", "none"],
}
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
    "las 1.2": (
        "las",
        {"type": "writers.las", "minor_version": 2, "dataformat_id": 1, "forward": "all"},
    ),
    "las 1.4": (
        "las",
        {"type": "writers.las", "minor_version": 4, "dataformat_id": 6, "forward": "all"},
    ),
    "laz": ("laz", {"type": "writers.las", "forward": "all", "extra_dims": "all"}),
    "text": (
        "txt",
        {
            "type": "writers.text",
            "order": "X,Y,Z,Classification",
            "keep_unspecified": False,
            "precision": 4,
        },
    ),
    "gdal": (
        "tif",
        {
            "type": "writers.gdal",
            "resolution": 2,
            "dimension": "Classification",
            "output_type": "max",
        },
    ),
    "ogr": ("geojson", {"type": "writers.ogr"}),
    "none": ("", {}),
}
FEET = (
    'PROJCS["UTM 32N in feet",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",1640416.67],PARAMETER["false_northing",0],UNIT["foot",0.3048]]'
)


def possible(values) -> bool:
    """Whether a row makes sense: what has no tiles, or no such writer, is not asked for them."""
    row = dict(zip(VALUES, values, strict=False))
    tiles, writer, door = row.get("tiles", "none"), row.get("writer"), row.get("door")
    if door in ("objects", "stock") and tiles != "none":
        return False
    if door == "classify" and writer in ("gdal", "ogr", "none"):
        return False
    if tiles != "none" and writer in ("gdal", "none"):
        return False
    return (row.get("model"), row.get("option")) != (
        "binary",
        "vegetation_heights",
    )  # which is refused


def rows() -> list[tuple]:
    """The covering array; pairs that the search did not find a place for get rows of their own."""
    found = [tuple(row) for row in allpairs(list(VALUES.values()), filter_func=possible)]
    for one, two in itertools.combinations(VALUES, 2):
        places = list(VALUES).index(one), list(VALUES).index(two)
        for pair in itertools.product(VALUES[one], VALUES[two]):
            if not any((row[places[0]], row[places[1]]) == pair for row in found):
                given = dict(zip((one, two), pair, strict=True))
                row = tuple(given.get(name) or _neutral(name, given) for name in VALUES)
                if possible(row):
                    found.append(row)
    return found


def _neutral(name, given):
    """A value that goes with any other."""
    return {
        "door": "pipeline",
        "writer": "laz",
        "model": "one pass",
        "option": "none",
        "tiles": "none",
    }.get(name, VALUES[name][0])


ROWS = rows()


@pytest.fixture(scope="session")
def scenes(tmp_path_factory, write_las):
    """Files of every kind of input."""
    folder = tmp_path_factory.mktemp("pairs")
    made = ps.make_town(50.0, 4.0, seed=5)
    rng = np.random.default_rng(1)
    n = len(made.xyz)
    arrays = {
        **dict(zip("XYZ", np.round(made.xyz, 3).T, strict=True)),
        "Classification": rng.choice(
            np.array([1, 2, 7, 12], np.uint8), n, p=[0.5, 0.4, 0.05, 0.05]
        ),
        "ReturnNumber": np.ones(n, np.uint8),
        "NumberOfReturns": np.ones(n, np.uint8),
        "GpsTime": np.arange(n, dtype=float),
        "Withheld": (rng.random(n) < 0.03).astype(np.uint8),
        "Synthetic": (rng.random(n) < 0.1).astype(np.uint8),
    }

    def part(mask):
        return {name: values[mask] for name, values in arrays.items()}

    x, y = arrays["X"] - 500_000, arrays["Y"] - 5_400_000
    lost = rng.integers(0, n, 40)
    noisy = {name: np.concatenate([values, values[lost]]) for name, values in arrays.items()}
    noisy["Z"][n:] += rng.choice([-30.0, 40.0], 40)
    noisy["Classification"][n:] = 1
    feet = {name: values / 0.3048 if name in "XYZ" else values for name, values in arrays.items()}
    plain, modern = {"point_format": 1}, {"point_format": 6}
    found = {
        "las 1.2": [write_las(folder / "old.las", arrays, **plain)],
        "las 1.4": [write_las(folder / "new.las", arrays, **modern)],
        "laz 1.4": [write_las(folder / "new.laz", arrays, **modern)],
        # made by tests/data/make_copc.py of commit b10145c
        "copc": [Path(__file__).parent / "data" / "town.copc.laz"],
        "feet": [write_las(folder / "feet.laz", feet, wkt=FEET, minor_version=4, **modern)],
        "several": [
            write_las(folder / f"part{k}.laz", part((x > 25) == k), **plain) for k in (False, True)
        ],
        "gaps": [write_las(folder / "gaps.laz", part((x < 12) | (x > 38) | (y < 10)), **modern)],
        "noise unlabeled": [write_las(folder / "noise.laz", noisy, **plain)],
    }
    return {kind: [str(path) for path in paths] for kind, paths in found.items()}


@pytest.fixture(scope="session")
def models(tmp_path_factory, write_las):
    folder = tmp_path_factory.mktemp("models")
    made = ps.make_town(60.0, 4.0, seed=9)
    arrays = {**dict(zip("XYZ", made.xyz.T, strict=True)), "Classification": made.classification}
    source = str(write_las(folder / "train.laz", arrays, point_format=6))
    found = {"standard": "standard"}
    classes = {"2": 2, "3,4,5": 5, "6": 6}
    for name, more in {
        "one pass": {"passes": 1, "classes": classes},
        "two passes": {"passes": 2, "classes": classes},
        "binary": {"passes": 1, "classes": classes, "strategy": "binary", "target": 6},
    }.items():
        found[name] = str(folder / f"{name.replace(' ', '-')}.model")
        train = {
            "type": "writers.classifiermodel",
            "filename": found[name],
            "neighborhoods": "k10,s2",
        }
        train |= {"feature_set": "covariance", "count": 200, "trees": 8, "folds": 0, **more}
        ps.run_pipeline([source, {"type": "filters.hag_minima", "cell": 5}, train])
    found["network"] = str(folder / "network.model")
    model_of(random_net(("Z",), seed=4)).save(found["network"])
    return found


_plain: dict[tuple, np.ndarray] = {}


def columns(x, y, z, codes):
    """Points in one order, whatever theirs: whole millimeters, and class."""
    out = np.column_stack(
        [np.rint(np.asarray(v, float) * 1000) for v in (x, y, z)] + [np.asarray(codes, float)]
    )
    return out[np.lexsort(out.T[::-1])]


def expected(row, files, model, old=False):
    """The points of a plain run, without tiles or writer; `old`: as files before LAS 1.4 say it.

    Class 12 of these is class 0 with the flag Overlap to newer PDAL, which writes 12 into such files again.
    """
    key = (row["input"], row["model"], row["option"], old)
    if key not in _plain:
        run = ps.Pipeline([*map(reader, files), *stages(model, row)])
        run.execute()
        a = np.concatenate(run.arrays)
        codes = a["Classification"]
        if "ClassFlags" not in a.dtype.names and "Withheld" not in a.dtype.names:
            codes = codes & 31  # flags of old files, as PDAL 2.2 reads them
        if old and "Overlap" in a.dtype.names:
            codes = np.where(a["Overlap"] == 1, np.uint8(12), codes)
        _plain[key] = columns(a["X"], a["Y"], a["Z"], codes)
    return _plain[key]


def reader(name):
    return {"type": "readers.las", "filename": name}


def stages(model, row):
    """Heights as in training, and the classifier."""
    info = load_model(find(model)).info
    classify = {"type": "filters.modelclassifier", "model": model, **OPTIONS[row["option"]]}
    made = info.get("preparation") or []
    if row["option"] == "vegetation_heights" and not made:
        made = [{"type": "filters.hag_minima", "cell": 5}]
    return [*made, classify]


def run(row, files, model, folder):
    """The row's command: its exit code and what was said."""
    suffix, writer = WRITERS[row["writer"]]
    several = len(files) > 1 and row["door"] == "classify"
    by_tile = row["tiles"] != "none" or several
    target = str(folder / (f"o_#.{suffix}" if by_tile else f"o.{suffix}"))
    last = [{**writer, "filename": target}] if writer else []
    if row["writer"] == "ogr" and row["door"] == "objects":
        last[0]["measure_dim"] = "Z"  # else PDAL 2.2 takes one from its memory, and crashes
    words = {
        "none": [],
        "no workers": ["--tile", "30", "--workers", "0"],
        "two workers, per tile": ["--tile", "30", "--workers", "2", "--per", "tile"],
        "two workers, per file": ["--tile", "30", "--workers", "2", "--per", "file"],
        "resumed": ["--tile", "30", "--workers", "0"],
    }[row["tiles"]]
    if row["input"] == "feet" and words:
        words[1] = "100"
    if row["door"] == "objects":
        import pdal

        job = pdal.Reader.las(files[0])
        for name in files[1:]:
            job |= pdal.Reader.las(name)
        job = job | pdal.Filter.merge()
        for stage in stages(model, row):
            options = {key: value for key, value in stage.items() if key != "type"}
            job = job | getattr(ps.Filter, stage["type"].partition(".")[2])(**options)
        if last:
            options = {key: value for key, value in last[0].items() if key != "type"}
            job = job | getattr(pdal.Writer, writer["type"].partition(".")[2])(**options)
        job.execute()
        return 0
    if row["door"] == "classify":
        command = [
            "classify",
            *files,
            target,
            "--model",
            model,
            "--no-noise",
            *words,
        ]
        command += [
            f"--filters.modelclassifier.{k}={v}"
            for k, v in OPTIONS[row["option"]].items()
            if k != "where"
        ]
        command += ["--where", OPTIONS["where"]["where"]] if row["option"] == "where" else []
        if row["writer"].startswith("las"):
            command += [
                f"--writers.las.{k}={writer[k]}" for k in ("minor_version", "dataformat_id")
            ]
    else:
        (folder / "job.json").write_text(
            json.dumps([*map(reader, files), *stages(model, row), *last])
        )
        command = ["pipeline", str(folder / "job.json"), *words]
    if row["door"] == "stock":
        if main(["expand", str(folder / "job.json"), "-o", str(folder / "plain.json")]):
            return 1
        return subprocess.run(
            [pdal_env.program(), "pipeline", str(folder / "plain.json")], cwd=folder
        ).returncode
    code = main(command)
    if row["tiles"] == "resumed" and code == 0:
        lost = sorted(folder.glob("o_*"))[0]
        before = lost.read_bytes()
        lost.unlink()
        code = main([*command, "--resume"])
        assert lost.read_bytes() == before
    return code


def read_back(row, outputs):
    """The points of the outputs; None of a format that has no classes."""
    kind = row["writer"]
    if kind.startswith("la"):
        parts = [laspy.read(path) for path in outputs]
        return columns(
            *(
                np.concatenate([np.asarray(p[n]) for p in parts])
                for n in ("x", "y", "z", "classification")
            )
        )
    if kind == "text":
        return columns(*np.concatenate([_table(path) for path in outputs]).T)
    return None


def _table(path):
    """X, Y, Z and class of a text file, by its header."""
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
    code = run(row, files, model, tmp_path)
    said = capfd.readouterr().err
    outputs = sorted(path for path in tmp_path.glob("o*") if path.suffix != ".json")
    assert code == 0, said
    assert bool(outputs) == (row["writer"] != "none"), said
    found = read_back(row, outputs)
    if found is not None:
        old = row["writer"].startswith("la") and laspy.read(outputs[0]).point_format.id < 6
        wanted = expected(row, files, model, old)
        if row["door"] == "objects" and not pdal_env.splits_class_flags():
            found[:, 3] = (
                found[:, 3].astype(int) & 31
            )  # there PDAL 2.2 writes flags as it reads them
        assert np.array_equal(
            np.bincount(found[:, 3].astype(int)), np.bincount(wanted[:, 3].astype(int))
        )
        assert np.abs(found[:, :3] - wanted[:, :3]).max() <= 10.5  # a centimeter, in writers of LAS
        assert (found[:, 3] == wanted[:, 3]).mean() > (
            0.9 if row["writer"].startswith("la") else 0.9999
        )
