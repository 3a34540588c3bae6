"""Odd clouds through every stage: by the command line, and by PDAL's own objects with arrays."""

from __future__ import annotations

import json
import struct

import laspy
import numpy as np
import pytest
from robustness_kit import HAG, job, las
from scipy.spatial import cKDTree

import pdal_stages as ps
from pdal_stages.base.units import units_of_wkt

pytestmark = pytest.mark.pdal

FEATURES = {
    "type": "filters.multiscalefeatures",
    "neighborhoods": "c1,s2,k10,kopt,ropt,copt",
    "feature_set": "covariance,geometric",
}
TRAIN = {"type": "writers.classifiermodel", "count": 50, "trees": 3, "neighborhoods": "c1,k5", "feature_set": "covariance",
         "passes": 1, "voxel": 0}  # fmt: skip


def grid(n=20, step=1.0):
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])


def random(n, seed=3, size=(20.0, 20.0, 5.0)):
    return np.round(np.random.default_rng(seed).uniform(0, size, (n, 3)), 2)


ODD = {
    "1 point": [[5.0, 5.0, 1.0]],
    "2 points": [[5.0, 5.0, 1.0], [5.5, 5.0, 2.0]],
    "3 points": [[5.0, 5.0, 1.0], [5.5, 5.0, 2.0], [5.5, 5.5, 1.5]],
    "all points equal": np.full((300, 3), 7.25),
    "all points on a line along x": np.column_stack(
        [np.arange(300) * 0.1, np.zeros(300), np.zeros(300)]
    ),
    "all points on a vertical line": np.column_stack(
        [np.zeros(300), np.zeros(300), np.arange(300) * 0.05]
    ),
    "a vertical wall": random(400, size=(0.0, 8.0, 20.0)) + [3.0, 0.0, 0.0],
    "a perfect plane on a grid": grid(),
    "points 100 m apart": grid(10, 100.0),
    "coordinates of tens of millions": random(300) + [32_500_000.0, 5_800_000.0, 0.0],
    "one stray point 1e6 m away": np.vstack([random(300), [[1e6, 10.0, 0.0]]]),
    "one stray point 1e6 m up": np.vstack([random(300), [[10.0, 10.0, 1e6]]]),
    "a gap of water wider than a cell": np.vstack([random(200), random(200) + [90.0, 0.0, 0.0]]),
    "coordinates one millimeter apart": random(300) / 1000.0,
    "thousands of copies of one point": np.vstack(
        [random(200), np.repeat([[5.0, 5.0, 1.0]], 5000, axis=0)]
    ),
}


def written(path, xyz, write_las, **more):
    n = len(xyz)
    arrays = dict(zip("XYZ", np.asarray(xyz, np.float64).reshape(n, 3).T, strict=True))
    codes = np.where(np.arange(n) % 2, 6, 2).astype(np.uint8)
    return write_las(path, {**arrays, "Classification": codes, **more}, point_format=3)


@pytest.mark.parametrize("case", ODD)
def test_odd_shapes(command, tmp_path, write_las, model, case):
    xyz, out = np.asarray(ODD[case], float), tmp_path / "out.las"
    source = written(tmp_path / "in.las", xyz, write_las)
    classify = {"type": "filters.modelclassifier", "model": str(model)}
    words = [
        "pipeline",
        job(tmp_path, source, HAG, FEATURES, classify, las(out)),
        "--metadata",
        tmp_path / "m.json",
    ]
    command.runs(words)
    out = laspy.read(out)
    assert len(out) == len(xyz) and np.isin(out.classification, [2, 6]).all()
    for name in out.point_format.extra_dimension_names:
        values = np.asarray(out[name])
        assert np.isfinite(values).all(), name
        if name.startswith(
            ("Linearity", "Planarity", "Scattering", "Anisotropy", "Verticality", "Reliability")
        ):
            assert values.min() >= 0 and values.max() <= 1 + 1e-6, name
    if case.startswith(("all points equal", "all points on a line", "a perfect plane")):
        assert np.allclose(out["HeightAboveGround"], 0)
    if case == "all points equal":
        assert (np.asarray(out["Linearity_c1"]) == 0).all() and (
            np.asarray(out["HeightRange_c1"]) == 0
        ).all()
    if case == "all points on a line along x":
        assert np.allclose(out["Linearity_c1"], 1)
    if case == "a vertical wall":
        assert np.allclose(out["Verticality_s2"], 1, atol=1e-6)
    if "stray" in case:
        assert 4 < np.asarray(out["HeightAboveGround"])[:300].max() <= 5  # as without it
    if "gap" in case:
        meta = json.loads((tmp_path / "m.json").read_text())["metadata"]
        assert meta["filters.hag_minima"]["interpolated_cells"] > 0
    if "copies" in case:
        assert (
            len(np.unique(out.classification[200:])) == 1
            and len(np.unique(out["Reliability"][200:])) == 1
        )


def test_no_points(command, tmp_path, write_las, model):
    source = written(tmp_path / "in.las", np.empty((0, 3)), write_las)
    classify = {"type": "filters.modelclassifier", "model": str(model)}
    command.runs(["pipeline", job(tmp_path, source, HAG, FEATURES, classify, tmp_path / "out.las")])
    assert len(laspy.read(tmp_path / "out.las")) == 0
    train = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m")}
    command.refused(["pipeline", job(tmp_path, source, HAG, train)], "no points to train on")
    ferry = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
    judge = job(tmp_path, source, ferry, {"type": "filters.accuracy"})
    command.refused(["pipeline", judge], "no points to compare")


def test_training_on_odd_clouds(command, tmp_path, write_las):
    def words(xyz, more, options):
        source = written(tmp_path / "in.las", xyz, write_las, **more)
        return [
            "pipeline",
            job(tmp_path, source, HAG, {**TRAIN, "filename": str(tmp_path / "m"), **options}),
        ]

    for code in (2, 0):  # one class, none
        command.refused(
            words(random(100), {"Classification": np.full(100, code, np.uint8)}, {}), TRAIN["type"]
        )
    command.refused(
        words(ODD["2 points"], {}, {"passes": 2}), "too small to be cut", "set passes to 1"
    )
    command.refused(words(ODD["all points equal"], {}, {}), "at least two classes")  # one point
    command.runs(words(ODD["2 points"], {}, {}))


def test_thresholds_of_no_points(command, tmp_path, write_las):
    bins = tmp_path / "b.json"
    path = written(tmp_path / "in.las", random(300), write_las)
    source = {"type": "readers.las", "filename": str(path), "use_eb_vlr": True}
    shapes = {
        "type": FEATURES["type"],
        "neighborhoods": "k5",
        "feature_set": "D1",
        "bins": str(bins),
    }
    for none in ({"where": "Z > 99"}, {"ignore": [2, 6]}):
        command.runs(
            ["pipeline", job(tmp_path, source, {**shapes, **none}), "--metadata", tmp_path / "m"]
        )
        assert bins.exists() == ("where" in none)
        bins.unlink(missing_ok=True)
    bins.write_text('{"bins": null, "copt_threshold": null}')
    command.refused(
        ["pipeline", job(tmp_path, source, shapes)], "does not hold the thresholds", "Delete it"
    )


def test_labels_that_are_none(command, tmp_path, write_las):
    arrays = {
        "Weight": np.full(100, 2.5),
        "Big": np.full(100, 300, np.int32),
        "Negative": np.full(100, -1, np.int8),
    }
    source = written(tmp_path / "in.las", random(100), write_las, **arrays)
    for name, says in (
        ("Weight", "2.5"),
        ("Big", "300"),
        ("Negative", "-1"),
        ("None", "is missing"),
    ):
        write = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m"), "label": name}
        read = {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}
        command.refused(["pipeline", job(tmp_path, read, HAG, write)], name, says)


# ---- not finite, too far, no heights -------------------------------------------------------------------------


@pytest.mark.parametrize("row", [[np.nan, 1, 1], [1, 1, -np.inf]], ids=str)
def test_not_finite(command, tmp_path, pdal_module, model, row):
    xyz = np.vstack([random(50), [row]])
    array = np.zeros(len(xyz), [("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("Classification", "u1")])
    array["X"], array["Y"], array["Z"] = xyz.T
    options = {k: v for k, v in FEATURES.items() if k != "type"}
    for pipeline in (
        ps.Filter.hag_minima(),
        ps.Filter.multiscalefeatures(**options),
        ps.Filter.hag_minima() | ps.Filter.modelclassifier(model=str(model)),
    ):
        pipeline.inputs = [array]
        with pytest.raises(RuntimeError, match="not finite"):
            pipeline.execute()
    text = tmp_path / "in.txt"
    text.write_text("X,Y,Z\n" + "\n".join(",".join(map(str, r)) for r in xyz) + "\n")
    path = job(tmp_path, {"type": "readers.text", "filename": str(text)}, HAG, tmp_path / "out.las")
    done = command("pipeline", path)
    if "not finite" in done.err:
        command.refused(done, "coordinates are not finite", "1 of 51 points", "filters.range")
    elif done.code == 0:  # PDAL 2.2 reads the word as 0, and says so
        assert "Can't convert field" in command.runs(done).err and "on line 52" in done.err
    else:
        command.refused(done, "in.txt")


@pytest.mark.parametrize("far", [1e9, 1e300])
def test_stray_points_beyond_any_grid(command, tmp_path, model, far):
    xyz, out = np.vstack([random(300), [[far, -far, 3.0]]]), tmp_path / "out.csv"
    np.savetxt(tmp_path / "in.txt", xyz, fmt="%.3f", delimiter=",", header="X,Y,Z", comments="")
    read = {"type": "readers.text", "filename": str(tmp_path / "in.txt")}
    classify = {"type": "filters.modelclassifier", "model": str(model)}
    write = {"type": "writers.text", "filename": str(out), "order": "Z,HeightAboveGround"}
    done = command("pipeline", job(tmp_path, read, HAG, FEATURES, classify, write))
    if done.code:
        command.refused(done, "too large", "filters.crop")
    else:
        height = np.genfromtxt(out, delimiter=",", names=True)["HeightAboveGround"]
        assert len(height) == 301 and np.isfinite(height).all() and height[:300].max() < 5.1


def test_no_heights(command, tmp_path):
    (tmp_path / "flat.txt").write_text("X,Y\n1,2\n3,4\n")
    for stage in (HAG, {**FEATURES, "neighborhoods": "c1"}):
        path = job(
            tmp_path, {"type": "readers.text", "filename": str(tmp_path / "flat.txt")}, stage
        )
        command.refused(["pipeline", path], "the dimension 'Z' is missing")


def test_noise_below_ground(command, tmp_path, write_las):
    """Noise forms no terrain, is counted, and gets its (negative) height."""
    xyz = np.vstack(
        [random(400, size=(40.0, 40.0, 0.1)), [[10.0, 10.0, -40.0], [30.0, 30.0, -35.0]]]
    )
    codes = np.full(402, 2, np.uint8)
    codes[400:] = 7, 18
    out, meta = tmp_path / "out.las", tmp_path / "m.json"
    words = ["pipeline", job(tmp_path, tmp_path / "in.las", HAG, las(out)), "--metadata", meta]
    written(tmp_path / "in.las", xyz, write_las, Classification=codes)
    command.runs(words)
    height = np.asarray(laspy.read(out)["HeightAboveGround"])
    assert np.abs(height[:400]).max() < 0.11 and (height[400:] < -34).all()
    assert json.loads(meta.read_text())["metadata"]["filters.hag_minima"]["ignored"] == 2
    written(tmp_path / "in.las", xyz, write_las, Classification=np.full(402, 7, np.uint8))
    command.refused(words, "no terrain", "ignore")


# ---- spatial references --------------------------------------------------------------------------------------

DEGREES = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS '
    '84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
METERS = (
    f'PROJCS["UTM",{DEGREES},PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1]]'
)
FOOT = 0.304800609601219
FEET = METERS.replace('UNIT["metre",1]', f'UNIT["US survey foot",{FOOT}]')
GEOCENTRIC = (
    'GEOCCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["metre",1]]'
)


def both(across, name, unit):
    return f'COMPD_CS["both",{across},VERT_CS["height",VERT_DATUM["sea",2005],UNIT["{name}",{unit}],AXIS["Up",UP]]]'


@pytest.mark.parametrize(
    ("wkt", "across", "up"),
    [(None, 1, 1), (METERS, 1, 1), (FEET, FOOT, FOOT), (both(METERS, "foot", 0.3048), 1, 0.3048), (both(FEET, "metre", 1), FOOT, 1)],
    ids=["no reference", "meters", "feet", "meters, heights in feet", "feet, heights in meters"],
)  # fmt: skip
def test_references(command, tmp_path, write_las, wkt, across, up):
    meters = random(300, size=(30.0, 30.0, 8.0))
    arrays = dict(zip("XYZ", (meters / [across, across, up]).T, strict=True))
    source = write_las(tmp_path / "in.las", arrays, point_format=6, wkt=wkt, scale=1e-6)
    features = {**FEATURES, "neighborhoods": "s2", "feature_set": "HeightRange"}
    done = command.runs(
        [
            "pipeline",
            job(tmp_path, source, HAG, features, las(tmp_path / "out.las", minor_version=4)),
        ]
    )
    assert ("meters were assumed" in done.err) == (wkt is None)
    out = laspy.read(tmp_path / "out.las")
    # A point on the border of a fine cell may fall on either side of it after conversion.
    assert (
        np.mean(np.abs(np.asarray(out["HeightAboveGround"]) - ps.hag_minima(*meters.T) / up) < 1e-3)
        > 0.97
    )
    ranges = [np.ptp(meters[rows, 2]) for rows in cKDTree(meters).query_ball_point(meters, 2.0)]
    assert np.mean(np.abs(np.asarray(out["HeightRange_s2"]) - ranges) < 1e-3) > 0.97


def test_degrees(command, tmp_path, write_las):
    xyz = random(100, size=(0.001, 0.001, 5.0)) + [9.0, 50.0, 0.0]
    path = job(tmp_path, tmp_path / "in.las", HAG)
    for wkt, says in (
        (DEGREES, "geographic (degrees)"),
        (both(DEGREES, "metre", 1), "geographic (degrees)"),
        (GEOCENTRIC, "geocentric"),
    ):
        write_las(
            tmp_path / "in.las",
            dict(zip("XYZ", xyz.T, strict=True)),
            point_format=6,
            wkt=wkt,
            scale=1e-7,
        )
        command.refused(["pipeline", path], says, "filters.reprojection")
    xyz = random(1000, size=(0.001, 0.001, 5.0)) + [9.0, 50.0, 0.0]
    write_las(tmp_path / "in.las", dict(zip("XYZ", xyz.T, strict=True)), scale=1e-7)
    for words in (
        ["pipeline", path],
        ["classify", tmp_path / "in.las", tmp_path / "o.las", "--tile", 100],
    ):
        command.refused(words, "look like degrees", "in_srs=EPSG:4326")
    for text in ("PROJCS[" * 5000, 'PROJCS["a",' + 'UNIT["m",' * 5000 + "1" + "]" * 5001):
        assert units_of_wkt(text).horizontal == 1.0  # assumed, as where there is none


# ---- boxes and tiles -----------------------------------------------------------------------------------------

BOXES = {
    "infinite bounding box": (float("inf"), 20, "the header has no bounding box"),
    "bounding box of 1e300": (1e300, 20, None),
    "tiles of 1e-300": (None, 1e-300, "--tile must be a number from 0.001 to"),
    "tiles of a millimeter": (None, 0.001, None),
}  # fmt: skip


@pytest.mark.parametrize("case", BOXES)
def test_boxes_and_tiles_of_odd_sizes(command, tmp_path, write_las, case):
    side, tile, says = BOXES[case]
    data = bytearray(written(tmp_path / "in.las", random(40), write_las).read_bytes())
    if side is not None:
        struct.pack_into("<4d", data, 179, side, -side, side, -side)
    (tmp_path / "in.las").write_bytes(data)
    path = job(
        tmp_path,
        tmp_path / "in.las",
        {"type": "writers.las", "filename": str(tmp_path / "o_#.las")},
    )
    done = command("pipeline", path, "--tile", tile, "--workers", 0)
    if says is not None:
        assert done.code == 1 and "Traceback" not in done.err and says in done.err, done.err
        assert not list(tmp_path.glob("o_*"))
    else:
        command.runs(done)
        assert len(laspy.read(tmp_path / "o_in.las")) == 40
    done = command("pipeline", path, "--tile", tile, "--workers", 0, "--dry-run")
    assert done.code == 1 and "Traceback" not in done.err  # headers alone cannot say
