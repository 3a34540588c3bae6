"""Odd clouds through every stage: by the command line, and by PDAL's own objects with arrays."""

from __future__ import annotations

import json
import struct

import laspy
import numpy as np
import pytest
from robustness_kit import job
from scipy.spatial import cKDTree

import pdal_stages as ps
from pdal_stages.base.errors import StageError

pytestmark = pytest.mark.pdal

HAG = {"type": "filters.hag_minima"}
FEATURES = {
    "type": "filters.multiscalefeatures",
    "neighborhoods": "c1,s2,k10,kopt,ropt,copt",
    "feature_set": "all",
}


def grid(n=20, step=1.0):
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])


def random(n, seed=3, size=(20.0, 20.0, 5.0)):
    return np.round(np.random.default_rng(seed).uniform(0, size, (n, 3)), 2)


def wall():
    rng = np.random.default_rng(2)
    return np.column_stack(
        [np.full(400, 3.0), rng.uniform(0, 8, 400).round(2), rng.uniform(0, 20, 400).round(2)]
    )


#: case, coordinates
ODD = {
    "1 point": [[5.0, 5.0, 1.0]],
    "2 points": [[5.0, 5.0, 1.0], [5.5, 5.0, 2.0]],
    "3 points": [[5.0, 5.0, 1.0], [5.5, 5.0, 2.0], [5.5, 5.5, 1.5]],
    "all points equal": np.full((300, 3), 7.25),
    "two places, many points each": np.repeat([[0.0, 0, 0], [0.5, 0, 3]], 200, axis=0),
    "all points on a line along x": np.column_stack([np.arange(300) * 0.1, np.zeros(300), np.zeros(300)]),
    "all points on a slanted line": np.arange(300)[:, None] * np.array([0.06, 0.08, 0.02]),
    "all points on a vertical line": np.column_stack([np.zeros(300), np.zeros(300), np.arange(300) * 0.05]),
    "a vertical wall": wall(),
    "a perfect plane on a grid": grid(),
    "a sphere of points": (lambda v: 5 + 4 * v / np.linalg.norm(v, axis=1)[:, None])(
        np.random.default_rng(0).normal(size=(400, 3))
    ),
    "points 100 m apart": grid(10, 100.0),
    "negative coordinates": random(300) - [50.0, 7000.0, 200.0],
    "coordinates of tens of millions": random(300) + [32_500_000.0, 5_800_000.0, 0.0],
    "one stray point 1e6 m away": np.vstack([random(300), [[1e6, 10.0, 0.0]]]),
    "one stray point 1e6 m up": np.vstack([random(300), [[10.0, 10.0, 1e6]]]),
    "a gap of water wider than a cell": np.vstack([random(200), random(200) + [90.0, 0.0, 0.0]]),
    "a pit 30 m deep": np.vstack([random(300, size=(60.0, 60.0, 0.1)), [[30.0, 30.0, -30.0]]]),
    "coordinates one millimeter apart": random(300) / 1000.0,
}


def las(path, xyz, write_las, scale=0.001, **more):
    xyz = np.asarray(xyz, np.float64)
    n = len(xyz)
    arrays = {"X": xyz[:, 0], "Y": xyz[:, 1], "Z": xyz[:, 2]}
    arrays["Classification"] = np.where(np.arange(n) % 2, 6, 2).astype(np.uint8)
    return write_las(path, {**arrays, **more}, point_format=3, scale=scale)


def check_output(path, count):
    """Every value of every dimension finite, as many points as came in."""
    out = laspy.read(path)
    assert len(out) == count
    for name in out.point_format.extra_dimension_names:
        values = np.asarray(out[name])
        assert np.isfinite(values).all(), name
        if name.startswith(
            ("Linearity", "Planarity", "Scattering", "Anisotropy", "Verticality", "Reliability")
        ):
            assert values.min() >= 0 and values.max() <= 1 + 1e-6, name
    return out


@pytest.mark.parametrize("case", ODD)
def test_odd_shapes(cell, tmp_path, write_las, model, case):
    xyz = np.asarray(ODD[case], float)
    source = las(tmp_path / "in.las", xyz, write_las)
    path = job(tmp_path, str(source), HAG, {**FEATURES, "feature_set": "covariance,geometric"},
               {"type": "filters.modelclassifier", "model": str(model)},
               {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "forward": "all"})  # fmt: skip
    cell("Clouds", case).runs(["pipeline", path], "heights, features and classes, all finite")
    out = check_output(tmp_path / "out.las", len(xyz))
    assert np.isin(out.classification, [2, 6]).all()
    if case.startswith(("all points equal", "all points on a line", "a perfect plane")):
        assert np.allclose(out["HeightAboveGround"], 0)
    if case == "all points equal":
        assert (np.asarray(out["Linearity_c1"]) == 0).all() and (np.asarray(out["HeightRange_c1"]) == 0).all()
    if case == "all points on a line along x":
        assert np.allclose(out["Linearity_c1"], 1)
    if case == "a vertical wall":
        assert np.allclose(out["Verticality_s2"], 1, atol=1e-6)
    if "stray" in case:
        assert 4 < np.asarray(out["HeightAboveGround"])[:300].max() <= 5  # as without it


def test_shape_distributions_of_odd_shapes(cell, tmp_path, write_las):
    it = cell("Clouds", "shape distributions where all points are equal")
    source = las(tmp_path / "in.las", ODD["all points equal"], write_las)
    path = job(tmp_path, str(source), {**FEATURES, "feature_set": "shapes", "neighborhoods": "c1,kopt"},
               {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "forward": "all"})  # fmt: skip
    done = it.command("pipeline", path)
    if done.code:
        it.refused(done, "filters.multiscalefeatures")
    else:
        it.runs(done, "histograms, all finite")
        check_output(tmp_path / "out.las", 300)


def empty_las(path, write_las):
    return write_las(path, {name: np.empty(0) for name in "XYZ"} | {"Classification": np.empty(0, np.uint8)})


def test_no_points(cell, tmp_path, write_las, model):
    source = empty_las(tmp_path / "in.las", write_las)
    path = job(tmp_path, str(source), HAG, FEATURES, {"type": "filters.modelclassifier", "model": str(model)},
               {"type": "writers.las", "filename": str(tmp_path / "out.las")})  # fmt: skip
    cell("Clouds", "0 points").runs(["pipeline", path], "an output without points")
    assert len(laspy.read(tmp_path / "out.las")) == 0
    train = job(
        tmp_path, str(source), HAG, {"type": "writers.classifiermodel", "filename": str(tmp_path / "m")}
    )
    cell("Clouds", "training on 0 points").refused(["pipeline", train], "no points to train on")
    judge = job(tmp_path, str(source), {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
                {"type": "filters.accuracy"})  # fmt: skip
    cell("Clouds", "accuracy of 0 points").refused(["pipeline", judge], "no points to compare")


def test_training_on_odd_clouds(cell, tmp_path, write_las):
    def train(case, xyz, *says, passes=1, **more):
        source = las(tmp_path / "in.las", xyz, write_las, **more)
        stage = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m"), "count": 50, "trees": 3,
                 "neighborhoods": "c1,k5", "feature_set": "covariance", "passes": passes, "voxel": 0}  # fmt: skip
        path = job(tmp_path, str(source), HAG, stage)
        it = cell("Clouds", case)
        if says:
            it.refused(["pipeline", path], *says)
        else:
            it.runs(["pipeline", path], "a model")
            (tmp_path / "m").unlink()

    train(
        "training on points of one class",
        random(100),
        "writers.classifiermodel",
        Classification=np.full(100, 2, np.uint8),
    )
    train(
        "training on unclassified points",
        random(100),
        "writers.classifiermodel",
        Classification=np.zeros(100, np.uint8),
    )
    train("training on 2 points", ODD["2 points"])
    train("two passes on 2 points", ODD["2 points"], "too small to be cut", "set passes to 1", passes=2)
    train("training where all points are equal", ODD["all points equal"])


# ---- not finite, through PDAL's arrays and a text file ------------------------------------------------------


def arrays_of(xyz):
    out = np.zeros(len(xyz), [("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("Classification", "u1")])
    out["X"], out["Y"], out["Z"] = np.asarray(xyz, float).T
    out["Classification"] = 2
    return out


@pytest.mark.parametrize(
    ("case", "row"),
    [
        ("NaN in X", [np.nan, 1, 1]), ("NaN in Z", [1, 1, np.nan]),
        ("infinite X", [np.inf, 1, 1]), ("infinite Z", [1, 1, -np.inf]), ("all of a point NaN", [np.nan] * 3),
    ],
)  # fmt: skip
def test_not_finite(cell, tmp_path, pdal_module, model, case, row):
    xyz = np.vstack([random(50), [row]])
    for stage in (HAG, FEATURES, {"type": "filters.modelclassifier", "model": str(model)}):
        options = {k: v for k, v in stage.items() if k != "type"}
        ours = getattr(ps.Filter, stage["type"].partition(".")[2])(**options)
        pipeline = ours if stage["type"] != "filters.modelclassifier" else ps.Filter.hag_minima() | ours
        pipeline.inputs = [arrays_of(xyz)]
        with pytest.raises(RuntimeError, match="not finite"):
            pipeline.execute()
    text = tmp_path / "in.txt"
    text.write_text("X,Y,Z\n" + "\n".join(",".join(map(str, r)) for r in xyz) + "\n")
    path = job(tmp_path, {"type": "readers.text", "filename": str(text)}, HAG, str(tmp_path / "out.las"))
    it = cell("Clouds", case)
    done = it.command("pipeline", path)
    if "not finite" in done.err:
        it.refused(done, "coordinates are not finite", "1 of 51 points", "filters.range")
    elif done.code == 0:  # PDAL 2.2 reads the word as 0, and says so
        it.runs(
            done,
            "PDAL's readers.text sets it to 0, and its words are shown: Can't convert field 'inf' to numeric value",
        )
        assert "Can't convert field" in done.err and "on line 52" in done.err
    else:
        it.refused(done, "in.txt")


def test_stray_points_beyond_any_grid(cell, tmp_path, pdal_module, write_las, model):
    for case, far in (
        ("one stray point 1e9 m away", 1e9),
        ("one stray point 1e15 m away", 1e15),
        ("one stray point 1e300 m away", 1e300),
    ):
        xyz = np.vstack([random(300), [[far, -far, 3.0]]])
        it = cell("Clouds", case)
        np.savetxt(tmp_path / "in.txt", xyz, fmt="%.3f", delimiter=",", header="X,Y,Z", comments="")
        stages = [
            HAG,
            {**FEATURES, "feature_set": "covariance,geometric"},
            {"type": "filters.modelclassifier", "model": str(model)},
        ]
        path = job(tmp_path, {"type": "readers.text", "filename": str(tmp_path / "in.txt")}, *stages,
                   {"type": "writers.text", "filename": str(tmp_path / "out.csv"), "order": "Z,HeightAboveGround"})  # fmt: skip
        done = it.command("pipeline", path)
        if done.code:
            it.refused(done, "too large", "filters.crop")
        else:
            it.runs(done, "heights, features and classes; the others are as without it")
            out = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
            assert np.isfinite(out["HeightAboveGround"]).all() and len(out) == 301
            assert out["HeightAboveGround"][:300].max() < 5.1
            (tmp_path / "out.csv").unlink()


def test_many_duplicates(cell, tmp_path, write_las, model):
    xyz = np.vstack([random(200), np.repeat([[5.0, 5.0, 1.0]], 20_000, axis=0)])
    source = las(tmp_path / "in.las", xyz, write_las)
    path = job(tmp_path, str(source), HAG, {"type": "filters.modelclassifier", "model": str(model)},
               {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "forward": "all"})  # fmt: skip
    cell("Clouds", "20,000 copies of one point among others").runs(
        ["pipeline", path], "classes; copies get the same"
    )
    out = check_output(tmp_path / "out.las", len(xyz))
    assert len(np.unique(out.classification[200:])) == 1 and len(np.unique(out["Reliability"][200:])) == 1


# ---- noise, labels, references ------------------------------------------------------------------------------


def test_noise_below_ground(cell, tmp_path, write_las):
    xyz = np.vstack([random(400, size=(40.0, 40.0, 0.1)), [[10.0, 10.0, -40.0], [30.0, 30.0, -35.0]]])
    codes = np.full(402, 2, np.uint8)
    codes[400:] = 7, 18
    source = las(tmp_path / "in.las", xyz, write_las, Classification=codes)
    path = job(tmp_path, str(source), HAG,
               {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "forward": "all"})  # fmt: skip
    meta = tmp_path / "m.json"
    cell("Clouds", "noise (classes 7 and 18) below ground").runs(
        ["pipeline", path, "--metadata", meta],
        "noise forms no terrain, is counted, and gets its (negative) height",
    )
    height = np.asarray(laspy.read(tmp_path / "out.las")["HeightAboveGround"])
    assert height[:400].min() > -0.11 and height[:400].max() < 0.11 and (height[400:] < -34).all()
    assert json.loads(meta.read_text())["metadata"]["filters.hag_minima"]["ignored"] == 2
    source = las(tmp_path / "in.las", xyz, write_las, Classification=np.full(402, 7, np.uint8))
    (tmp_path / "out.las").unlink()
    meta.unlink()
    cell("Clouds", "nothing but noise").refused(["pipeline", path], "no terrain", "ignore")


def test_water_gap_is_counted(cell, tmp_path, write_las):
    source = las(tmp_path / "in.las", ODD["a gap of water wider than a cell"], write_las)
    path = job(tmp_path, str(source), HAG)
    meta = tmp_path / "m.json"
    cell("Clouds", "empty cells at a gap").runs(
        ["pipeline", path, "--metadata", meta], "filled, and counted in the metadata"
    )
    assert json.loads(meta.read_text())["metadata"]["filters.hag_minima"]["interpolated_cells"] > 0


WKT = {
    "metre": 'PROJCS["UTM",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1]]',
    "degree": 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]',
}
WKT["geocentric"] = (
    'GEOCCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["metre",1]]'
)
WKT["us-ft"] = WKT["metre"].replace('UNIT["metre",1]', 'UNIT["US survey foot",0.304800609601219]')
UP = 'VERT_CS["height",VERT_DATUM["sea",2005],UNIT["%s",%s],AXIS["Up",UP]]'
WKT["compound, feet up"] = f'COMPD_CS["both",{WKT["metre"]},{UP % ("foot", "0.3048")}]'
WKT["compound, meters up"] = f'COMPD_CS["both",{WKT["us-ft"]},{UP % ("metre", "1")}]'
WKT["compound, geographic"] = f'COMPD_CS["both",{WKT["degree"]},{UP % ("metre", "1")}]'


@pytest.mark.parametrize(
    ("case", "wkt", "across", "up"),
    [
        ("no spatial reference", None, 1.0, 1.0),
        ("a projected reference in meters", "metre", 1.0, 1.0),
        ("a projected reference in US survey feet", "us-ft", 0.304800609601219, 0.304800609601219),
        ("a compound reference: meters, heights in feet", "compound, feet up", 1.0, 0.3048),
        ("a compound reference: feet, heights in meters", "compound, meters up", 0.304800609601219, 1.0),
    ],
)
def test_references(cell, tmp_path, write_las, case, wkt, across, up):
    meters = random(300, size=(30.0, 30.0, 8.0))
    xyz = meters / [across, across, up]
    arrays = {"X": xyz[:, 0], "Y": xyz[:, 1], "Z": xyz[:, 2]}
    source = write_las(tmp_path / "in.las", arrays, point_format=6, wkt=WKT[wkt] if wkt else None, scale=1e-6)
    path = job(tmp_path, str(source), HAG, {**FEATURES, "neighborhoods": "s2", "feature_set": "HeightRange"},
               {"type": "writers.las", "filename": str(tmp_path / "out.las"), "extra_dims": "all", "minor_version": 4})  # fmt: skip
    done = cell("Clouds", case).runs(
        ["pipeline", path], "meters are assumed, and it says so" if wkt is None else "lengths are converted"
    )
    assert ("meters were assumed" in done.err) == (wkt is None)
    out = laspy.read(tmp_path / "out.las")
    expected = ps.hag_minima(*meters.T) / up
    # A point on the border of a fine cell may fall on either side of it after conversion.
    assert np.mean(np.abs(np.asarray(out["HeightAboveGround"]) - expected) < 1e-3) > 0.97
    near = cKDTree(meters).query_ball_point(meters, 2.0)
    ranges = [np.ptp(meters[rows, 2]) for rows in near]  # meters, whatever the file's unit
    assert np.mean(np.abs(np.asarray(out["HeightRange_s2"]) - ranges) < 1e-3) > 0.97


@pytest.mark.parametrize(
    ("case", "wkt"),
    [
        ("a geographic reference", "degree"),
        ("a compound reference with degrees", "compound, geographic"),
        ("a geocentric reference", "geocentric"),
    ],
)
def test_degrees(cell, tmp_path, write_las, case, wkt):
    xyz = random(100, size=(0.001, 0.001, 5.0)) + [9.0, 50.0, 0.0]
    arrays = {"X": xyz[:, 0], "Y": xyz[:, 1], "Z": xyz[:, 2]}
    source = write_las(tmp_path / "in.las", arrays, point_format=6, wkt=WKT[wkt], scale=1e-7)
    path = job(tmp_path, str(source), HAG, str(tmp_path / "out.las"))
    cell("Clouds", case).refused(
        ["pipeline", path],
        "geocentric" if wkt == "geocentric" else "geographic (degrees)",
        "filters.reprojection",
    )


def test_degrees_without_a_reference(cell, tmp_path, write_las):
    xyz = random(100, size=(0.001, 0.001, 5.0)) * [1, 1, 1] + [9.0, 50.0, 0.0]
    arrays = {"X": xyz[:, 0], "Y": xyz[:, 1], "Z": xyz[:, 2]}
    source = write_las(tmp_path / "in.las", arrays, scale=1e-7)
    path = job(tmp_path, str(source), HAG)
    done = cell("Clouds", "degrees without a spatial reference").runs(
        ["pipeline", path], "a warning that coordinates look like degrees"
    )
    assert "look like degrees" in done.err


def test_labels_that_are_none(cell, tmp_path, write_las):
    arrays = {
        "Weight": np.full(100, 2.5),
        "Big": np.full(100, 300, np.int32),
        "Negative": np.full(100, -1, np.int8),
    }
    source = las(tmp_path / "in.las", random(100), write_las, **arrays)
    for name, says in (("Weight", "2.5"), ("Big", "300"), ("Negative", "-1"), ("None", "is missing")):
        path = job(tmp_path, {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}, HAG,
                   {"type": "writers.classifiermodel", "filename": str(tmp_path / "m"), "label": name})  # fmt: skip
        case = {
            "Weight": "labels that are fractions",
            "Big": "labels above 255",
            "Negative": "labels below 0",
        }.get(name)
        cell("Clouds", case or "labels of a dimension that is missing").refused(
            ["pipeline", path], name, says
        )


def test_stage_error_in_a_thread_is_the_same(cloud):
    with pytest.raises(StageError, match="none"):
        ps.run_pipeline([str(cloud), {**HAG, "where": "Z > 3", "ignore": list(range(256))}])


def test_no_heights(cell, tmp_path):
    (tmp_path / "flat.txt").write_text("X,Y\n1,2\n3,4\n")
    for stage in (HAG, {"type": "filters.multiscalefeatures", "neighborhoods": "c1"}):
        path = job(tmp_path, {"type": "readers.text", "filename": str(tmp_path / "flat.txt")}, stage)
        cell("Clouds", "cloud without Z").refused(["pipeline", path], "the dimension 'Z' is missing")


def test_deep_well_known_text():
    """Meters are assumed, as where there is none."""
    from pdal_stages.base.units import units_of_wkt

    for text in ("PROJCS[" * 5000, 'PROJCS["a",' + 'UNIT["m",' * 5000 + "1" + "]" * 5001):
        assert units_of_wkt(text).horizontal == 1.0


BOXES = [
    ("infinite bounding box", float("inf"), 20, "the header has no bounding box"),
    ("bounding box of 1e300", 1e300, 20, None),
    ("tiles of 1e-300", None, 1e-300, "too far away to be counted in tiles"),
    ("tiles of 1e-9", None, 1e-9, "too far away to be counted in tiles"),
    ("tiles of a millimeter", None, 0.001, None),
]  # fmt: skip


@pytest.mark.parametrize(("case", "side", "tile", "says"), BOXES, ids=[row[0] for row in BOXES])
def test_boxes_and_tiles_of_odd_sizes(cell, tmp_path, cloud, case, side, tile, says):
    data = bytearray(cloud.read_bytes())
    if side is not None:
        struct.pack_into("<4d", data, 179, side, -side, side, -side)
    (tmp_path / "in.las").write_bytes(data)
    path = job(
        tmp_path, str(tmp_path / "in.las"), {"type": "writers.las", "filename": str(tmp_path / "o_#.las")}
    )
    it = cell("Clouds", f"in tiles: {case}")
    done = it.command("pipeline", path, "--tile", tile, "--workers", 0)
    if says is not None:
        assert done.code == 1 and "Traceback" not in done.err and says in done.err, done.err
        assert not list(tmp_path.glob("o_*"))
    else:
        it.runs(done, "every point comes out")
        assert len(laspy.read(tmp_path / "o_in.las")) == 600
    done = it.command("pipeline", path, "--tile", tile, "--workers", 0, "--dry-run")
    assert done.code == 1 and "Traceback" not in done.err  # headers alone cannot say
