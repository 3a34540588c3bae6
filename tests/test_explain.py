"""`explain`: it computes what `classify` wrote, its sums add up, and its text names planted errors."""

import json
import struct
from dataclasses import replace

import laspy
import numpy as np
import pytest
from alsnet_scenes import model_of, random_net

from pdal_stages import load_model
from pdal_stages.base.asprs import class_name
from pdal_stages.base.errors import StageError
from pdal_stages.base.las_boxes import read_around
from pdal_stages.base.las_points import columns_of_files
from pdal_stages.classifier.training_percentiles import PERCENTILES, share_below
from pdal_stages.cli import main
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.review.explain import explain_points
from pdal_stages.review.explanation import LineTrace, Noise, StepAfter
from pdal_stages.review.explanation_text import lines
from pdal_stages.review.places import AskedPlace, read_places
from pdal_stages.review.trace_points import SURROUNDINGS
from pdal_stages.review.words import (
    AFTER,
    DIFFERENCE,
    GROUND,
    HEAD,
    MODEL,
    NOISE,
    fill,
    words_for,
)
from pdal_stages.terrain.heights import filtered_ground

pytestmark = pytest.mark.pdal
DATA = "tests/data/city.laz"


@pytest.fixture(scope="module")
def city(tmp_path_factory, request):
    """A part of a city, classified by the shipped model."""
    folder = tmp_path_factory.mktemp("city")
    las = laspy.read(request.config.rootpath / DATA)
    las.points = las.points[(las.x < 770625) & (las.y < 6277530)]
    las.write(folder / "raw.laz")
    assert main(["classify", str(folder / "raw.laz"), str(folder / "city.laz")]) == 0
    return folder / "city.laz"


@pytest.fixture()
def explain(run, tmp_path):
    """Return a function that gives the text and the JSON of an explanation."""

    def go(*words):
        target = tmp_path / "told.json"
        code, out, err = run("explain", *words, "--json", target)
        assert code == 0, err
        return out, json.loads(target.read_text())["points"]

    return go


def places_of(path, rows):
    las = laspy.read(path)
    return las, np.stack([las.x, las.y, las.z], axis=1)[rows]


def csv_of(path, places):
    path.write_text("x,y,z\n" + "\n".join(",".join(map(str, place)) for place in places))
    return path


def test_it_computes_what_classify_wrote_and_sums_add_up(city, explain, tmp_path):
    rows = np.random.default_rng(0).choice(len(laspy.read(city)), 30, replace=False)
    las, places = places_of(city, rows)
    _, told = explain(city, "--points", csv_of(tmp_path / "p.csv", places))
    for row, each in zip(rows, told, strict=True):
        assert each["point"]["number"] == row and each["point"]["distance_m"] < 1e-6
        assert each["computed"] == each["in_file"] == las.classification[row]
        assert [same for _, _, same in each["compared"].values()] in ([], [True, True])
        if each["verdict"] is None:
            continue
        winner = str(each["verdict"]["winner"])
        reliability = each["verdict"]["probabilities"][winner]
        assert reliability == pytest.approx(las.Reliability[row], abs=1 / 128 + 1e-6)
        for single in each["verdict"]["passes"]:
            for code, share in single["probabilities"].items():
                added = sum(entry["added"][code] for entry in single["inputs"])
                assert single["start"][code] + added == pytest.approx(share, abs=1e-6)
        heights = next(
            entry["value"]
            for entry in each["verdict"]["passes"][0]["inputs"]
            if entry["name"] == "HeightAboveGround"
        )
        if each["verdict"]["stands_for_it_m"] is None:
            assert heights == pytest.approx(each["ground"]["height"], abs=1e-4)
        assert each["verdict"]["passes"][-1]["inputs"][-1]["name"] == SURROUNDINGS


def test_the_ground_filter_is_told_step_by_step(city, explain, tmp_path):
    las, _ = places_of(city, [])
    ground = np.flatnonzero(las.classification == 2)[[7, -7]]
    roof = np.flatnonzero((las.classification == 6) & (las.HeightAboveGround > 4))[[7, -7]]
    for rows, is_ground in ((ground, True), (roof, False)):
        _, places = places_of(city, rows)
        _, told = explain(city, "--points", csv_of(tmp_path / "p.csv", places))
        for each in told:
            steps = each["ground"]
            assert steps["is_ground"] == is_ground
            assert (abs(steps["above_provisional"]) <= steps["tolerance"]) == is_ground
            assert any(steps["rounds"]) == is_ground and (steps["floor"] < -1.0) != is_ground
            assert steps["lowest"] <= 1e-3 and steps["cell"] == 1.0 and not steps["is_given"]


def test_text_is_a_screen_and_names_what_the_model_saw(city, explain):
    _, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 6)[:1])
    text, (each,) = explain(city, *places[0])
    rows = text.splitlines()
    assert len(rows) <= 50 and max(map(len, rows[1:])) <= 120
    pair = [class_name(each["verdict"][name]) for name in ("winner", "rival")]
    assert f"For {pair[0]}, against {pair[1]}" in text and "where pass 2 starts" in text
    assert "6 Building in the file, 6 Building computed now" in text
    assert "WHAT DIFFERS" not in text and "surroundings: pass 1, here" in text


def test_against_names_the_class_that_is_compared(city, explain):
    _, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 6)[:1])
    text, (each,) = explain(city, *places[0], "--against", "2")
    assert each["verdict"]["rival"] == 2 and "For Building, against Ground" in text


def test_what_may_lie_on_a_line_is_told_and_every_row_can_be_filled(city):
    _, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 5)[:1])
    (told,) = explain_points([str(city)], [AskedPlace(*places[0])], ClassifyRequest())
    for is_on_line, text in (
        (True, "0.08 for 14 Wire - conductor (phase), and it lies on a line of such points"),
        (False, "but it lies on no line of such points: it is 5 High vegetation"),
    ):
        trace = LineTrace(0.08, 14, is_on_line, 14 if is_on_line else 5)
        seen = replace(told, verdict=replace(told.verdict, lines=trace))
        assert sum(text in line for line in lines(seen)) == 1
        assert max(map(len, lines(seen)[1:])) <= 120
    records = (seen, seen, Noise(7, "loose"), seen.ground, seen.verdict, StepAfter("x", 15, False))
    for table, record in zip((HEAD, DIFFERENCE, NOISE, GROUND, MODEL, AFTER), records, strict=True):
        always = [replace(row, when=lambda _: True) for row in table]
        assert len(fill(always, record)) == len(table)
    known = load_model("standard").passes[0].plan.names
    assert all(words_for(name)[0] != name and "_" not in words_for(name)[0] for name in known)


# ---- planted errors ------------------------------------------------------------------------------


def test_a_class_changed_by_hand_or_by_an_option_after_the_model(city, explain, tmp_path):
    las, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 5)[:1])
    las.classification[np.flatnonzero(las.classification == 5)[:1]] = 6
    las.write(tmp_path / "edited.laz")
    text, (each,) = explain(tmp_path / "edited.laz", *places[0])
    assert each["in_file"] == 6 and each["computed"] == 5 and each["verdict"]["rival"] == 6
    assert (
        "the class was changed afterwards: by hand" in text and "reasons          not shown" in text
    )


@pytest.mark.parametrize(
    ("code", "text"),
    [(9, "by hand, by --polygons,"), (1, "--keep-sure"), (3, "--vegetation-heights")],
)
def test_options_that_give_a_class_are_named(city, explain, tmp_path, code, text):
    las, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 5)[:1])
    las.classification[np.flatnonzero(las.classification == 5)[:1]] = code
    las.write(tmp_path / "edited.laz")
    assert text in explain(tmp_path / "edited.laz", *places[0])[0]


def test_echoes_from_below_that_are_left_in_are_doubted(city, explain, tmp_path):
    las, _ = places_of(city, [])
    x, y, codes = (np.array(values) for values in (las.x, las.y, las.classification))
    row = np.flatnonzero(codes == 2)[len(codes) // 4]
    away = np.hypot(x - x[row], y - y[row])
    echoes = np.flatnonzero((away < 6.0) & (away > 0.5) & (codes == 2))[::20]
    las.Z[echoes] -= round(5.0 / las.header.scales[2])
    las.write(tmp_path / "echoes.laz")
    _, places = places_of(tmp_path / "echoes.laz", [row])
    text, (each,) = explain(tmp_path / "echoes.laz", *places[0], "--no-noise")
    assert each["ground"]["lower"] == np.count_nonzero(away[echoes] <= 5.0) > 0
    assert ("echoes from below the ground?" in text) != each["ground"]["is_ground"]


def test_another_model_or_another_ground(city, explain, tmp_path):
    las, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 5)[:1])
    row = np.flatnonzero(las.classification == 5)[0]
    las.classification[row], las.Reliability[row] = 6, las.Reliability[row] / 2
    las.write(tmp_path / "other.laz")
    assert "and the model is another: --model" in explain(tmp_path / "other.laz", *places[0])[0]
    las.HeightAboveGround[row] -= 2.0
    las.write(tmp_path / "ground.laz")
    assert (
        "so the ground of that run was another: --ground"
        in explain(tmp_path / "ground.laz", *places[0])[0]
    )


def test_given_ground_that_was_edited_is_seen_beside_the_lowest_point(city, explain, tmp_path):
    """Ground that someone set on top of a roof or hedge lies above the lowest points around."""
    las = laspy.read(city)
    row = np.flatnonzero(las.classification == 6)[3]
    x, y, codes = (np.array(values) for values in (las.x, las.y, las.classification))
    edited = (np.hypot(x - x[row], y - y[row]) < 3.0) & (codes == 6)
    las.classification = np.where(edited, 2, codes)
    las.write(tmp_path / "edited.laz")
    _, places = places_of(tmp_path / "edited.laz", [row])
    text, (each,) = explain(tmp_path / "edited.laz", *places[0], "--ground", "given")
    assert each["kept"] and "given ground, which keeps its class" in text
    assert each["ground"]["given"] > each["ground"]["lowest_near"] + 1.0
    assert "above the lowest point near: was a class edited?" in text


def test_options_after_the_model_and_stages_are_told(city, explain, tmp_path):
    _, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 5)[:1])
    words = ["--vegetation-heights", "20,30", "--keep-sure", "0.9", "--bridges"]
    text, (each,) = explain(city, *places[0], *words)
    assert each["computed"] == 3 and [step[1] for step in each["steps"]] == [5, 3, 3, 3]
    assert "makes it 3 Low vegetation" in text and "--bridges" in text


def test_noise_where_and_what_is_left_out(city, explain, tmp_path):
    las = laspy.read(city)
    row = int(np.argmax(las.z))
    las.z[row] += 0.0
    las.Z[row] += round(60.0 / las.header.scales[2])
    las.write(tmp_path / "bird.laz")
    _, places = places_of(tmp_path / "bird.laz", [row])
    text, (each,) = explain(tmp_path / "bird.laz", *places[0])
    assert each["noise"]["code"] == each["computed"] == 18 and "yes, 18 High noise" in text
    assert each["kept"] == "class 18 is left out" and each["verdict"] is None
    text, (each,) = explain(city, *places[0][:2], "--where", "Z > 1000")
    assert "outside --where Z > 1000" in text and each["computed"] == each["in_file"]


# ---- other models --------------------------------------------------------------------------------


def test_a_network_gives_probabilities_and_says_that_it_gives_no_reasons(city, explain, tmp_path):
    model_of(random_net(("Z",), seed=4)).save(tmp_path / "net.model")
    words = ["--model", tmp_path / "net.model", "--no-noise"]
    out = tmp_path / "out.laz"
    assert main(["classify", str(city), str(out), *map(str, words), "--dimensions", "all"]) == 0
    las, places = places_of(out, [2000])
    text, (each,) = explain(out, *places[0], *words)
    assert "a network, or another learner than a forest, gives none" in text
    assert each["computed"] == each["in_file"] == las.classification[2000]
    assert each["noise"] is None and "not looked for (--no-noise)" in text
    assert each["ground"] is None and not each["verdict"]["passes"]
    assert sum(each["verdict"]["probabilities"].values()) == pytest.approx(1.0, abs=1e-5)


def test_a_model_with_percentiles_shows_where_values_lie(city, explain, tmp_path, run):
    """Of a model on top of the shipped one, whose file has them: at a roof's median half lie below."""
    las = laspy.read(city)
    las.add_extra_dim(laspy.ExtraBytesParams("Checked", "uint8"))
    chosen = np.isin(las.classification, (5, 6)) & (np.arange(len(las)) % 40 == 0)
    las["Checked"] = chosen.astype(np.uint8)
    las.write(tmp_path / "checked.laz")
    words = ["--base", "standard", "--model", tmp_path / "mine.model"]
    code, _, err = run("train", tmp_path / "checked.laz", *words)
    assert code == 0, err
    las, places = places_of(city, np.flatnonzero(las.classification == 6)[:1])
    text, (each,) = explain(city, *places[0], "--model", tmp_path / "mine.model")
    last = each["verdict"]["passes"][-1]
    shares = [entry["below"] for entry in last["inputs"][:-1]]
    assert all(set(share) == {"5", "6"} for share in shares) and len(each["verdict"]["passes"]) == 3
    assert all(0.0 <= value <= 1.0 for share in shares for value in share.values())
    assert "the share of the training's points" in text and " %" in text


# ---- files and places ----------------------------------------------------------------------------


def test_at_a_seam_of_a_survey_the_neighbors_count(city, explain, tmp_path):
    las = laspy.read(city)
    middle = float(np.median(las.x))
    (tmp_path / "survey").mkdir()
    for name, part in (("west", las.x < middle), ("east", las.x >= middle)):
        half = laspy.LasData(las.header)
        half.points = las.points[part]
        half.write(tmp_path / "survey" / f"{name}.laz")
    row = int(np.argmin(np.abs(las.x - middle)))
    _, places = places_of(city, [row])
    _, (whole,) = explain(city, *places[0])
    _, (cut,) = explain(tmp_path / "survey", *places[0])
    assert {**whole, "point": 0} == {**cut, "point": 0}


def test_places_of_vector_files_and_other_reference_systems(city, explain, tmp_path):
    pyogrio, pyproj = pytest.importorskip("pyogrio"), pytest.importorskip("pyproj")
    shapely = pytest.importorskip("shapely")
    las, places = places_of(city, [100])
    las.header.add_crs(pyproj.CRS(2154))
    las.write(tmp_path / "c.laz")
    forward = pyproj.Transformer.from_crs(2154, 4326, always_xy=True)
    lon, lat = forward.transform(*places[0][:2])
    _, (first,) = explain(tmp_path / "c.laz", lon, lat, "--crs", "EPSG:4326")
    pyogrio.raw.write(
        tmp_path / "p.gpkg",
        np.array([shapely.to_wkb(shapely.Point(lon, lat))]),
        [],
        [],
        geometry_type="Point",
        crs="EPSG:4326",
    )
    _, (second,) = explain(tmp_path / "c.laz", "--points", tmp_path / "p.gpkg")
    assert first == second and first["point"]["distance_m"] < 0.01


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["0", "0"], "there is no point near this place"),
        (["770610"], "a place is X Y or X Y Z"),
        ([], "a place is X Y or X Y Z"),
        (["770610", "6277510", "--model", "none"], "there is no such model file"),
        (["770610", "6277510", "90"], "the nearest is"),
        (["770610", "6277510", "--against", "9"], "the model cannot compare with class 9"),
        (["1", "2", "--crs", "EPSG:4326"], "the cloud has no reference system"),
    ],
)
def test_errors(city, run, words, text):
    code, out, err = run("explain", city, *words)
    assert code == 1 and text in err and not out


def test_of_too_many_points_those_far_away_count_as_the_lowest_alone(city, explain, monkeypatch):
    from pdal_stages.review import explain as module

    _, places = places_of(city, np.flatnonzero(laspy.read(city).classification == 2)[:1])
    text, (whole,) = explain(city, *places[0])
    assert "too many points" not in text
    monkeypatch.setattr(module, "_MOST_POINTS", 10_000)
    text, (each,) = explain(city, *places[0])
    assert "m only the lowest of each place count" in text and each["computed"] == 2
    assert each["ground"]["height"] == pytest.approx(whole["ground"]["height"], abs=0.1)
    text, _ = explain(city, *places[0], "--ground", "given")
    assert "m are not read" in text


@pytest.mark.parametrize("place", [(1210.0, 20.0), (1500.0, 10.0), (1790.0, 5.0)])
def test_ground_is_that_of_the_whole_cloud_though_far_points_are_reduced(
    place, explain, tmp_path, write_las
):
    """Hills, and halls wider than the windows, in a strip longer than the filter looks."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, 1, (2, 90_000)) * [[2400.0], [40.0]]
    halls = np.isin(x // 60, (9, 10, 25, 26, 36))
    z = 6 * np.sin(x / 90) + 0.02 * y + 5.0 * halls + rng.normal(0, 0.03, len(x))
    xyz = np.round(np.stack([x, y, z]), 3)
    write_las(tmp_path / "strip.las", dict(zip("XYZ", xyz, strict=True)))
    whole = filtered_ground(*xyz, openings=[5, 17])
    _, (each,) = explain(tmp_path / "strip.las", *place, "--no-noise")
    row, steps = each["point"]["number"], each["ground"]
    assert steps["height"] == whole["HeightAboveGround"][row]
    assert steps["is_ground"] == whole["Ground"][row]
    assert steps["openings"]["17.0"] == whole["HeightAboveOpening_17"][row]


def test_what_it_cannot_run_is_refused(city, run, tmp_path):
    model = load_model("standard")
    model.record_preprocessing([{"type": "filters.smrf"}, {"type": "filters.hag_nn"}])
    model.save(tmp_path / "pdal.model")
    words = ["explain", city, 770610, 6277510]
    code, _, err = run(*words, "--model", tmp_path / "pdal.model")
    assert code == 1 and "stages of PDAL, which explain does not run" in err
    (tmp_path / "cloud.txt").write_text("X,Y,Z\n1,2,3\n")
    code, _, err = run("explain", tmp_path / "cloud.txt", 1, 2)
    assert code == 1 and "explain reads LAS and LAZ files" in err
    code, _, err = run(*words, "--json", city)
    assert code == 1 and city.stat().st_size > 10_000  # an input is no output


def test_feet_are_meters_in_the_text(city, explain, tmp_path):
    """Heights and distances are in meters, whatever the unit of the file."""
    pyproj = pytest.importorskip("pyproj")
    las, places = places_of(city, [300])
    _, (meters,) = explain(city, *places[0])
    foot = 0.3048
    feet = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    feet.header.scales, feet.header.offsets = [0.001] * 3, np.floor(las.header.mins / foot)
    feet.header.add_crs(pyproj.CRS("EPSG:6557+6360"))
    for name, values in zip("xyz", (las.x, las.y, las.z), strict=True):
        feet[name] = np.array(values) / foot
    for name in ("return_number", "number_of_returns", "classification"):
        feet[name] = np.array(las[name])
    feet.write(tmp_path / "feet.laz")
    _, (told,) = explain(tmp_path / "feet.laz", *(places[0] / foot))
    assert told["point"]["number"] == 300 and told["computed"] == meters["computed"]
    for name in ("height", "tolerance", "lowest"):
        assert told["ground"][name] == pytest.approx(meters["ground"][name], abs=0.1)


def test_rows_that_are_no_places_are_named(tmp_path):
    (tmp_path / "p.csv").write_text("x,y,z\n1,2,\n3,4,5\n")
    assert read_places("", [], str(tmp_path / "p.csv")) == [AskedPlace(1, 2), AskedPlace(3, 4, 5)]
    for text in ("1,2\n3,4\n", "x,y\n1,2\n3,4\n"):
        (tmp_path / "p.csv").write_text(text)
        assert read_places("", [], str(tmp_path / "p.csv")) == [AskedPlace(1, 2), AskedPlace(3, 4)]
    (tmp_path / "p.csv").write_text("1,2\nhere,there\n")
    with pytest.raises(StageError, match="line 2"):
        read_places("", [], str(tmp_path / "p.csv"))
    with pytest.raises(StageError, match="cannot be read"):
        read_places("", [], str(tmp_path / "none.csv"))


def test_a_cloud_without_given_ground(city, run, tmp_path):
    las = laspy.read(city)
    las.classification[:] = 1
    las.write(tmp_path / "none.laz")
    code, _, err = run("explain", tmp_path / "none.laz", 770610, 6277510, "--ground", "given")
    assert code == 1 and "no ground is given" in err


def test_shares_below_are_those_of_the_percentiles():
    row = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert [share_below(v, row) for v in row] == [p / 100 for p in PERCENTILES]
    assert share_below(1.5, row) == pytest.approx(0.15) and share_below(9.0, row) == 0.995
    assert share_below(0.0, [0.0] * 7) == 0.5 and share_below(1.0, [0.0] * 6 + [1.0]) == 0.99


def test_every_dimension_of_the_surroundings_can_be_read(city, tmp_path):
    """Whichever a stage asks for: of LAZ 1.4 each is decoded by itself, and else is zero."""
    las = laspy.read(city)
    las.user_data[:] = np.arange(len(las)) % 256
    las.write(tmp_path / "one.laz")
    las.x = las.x + 50
    las.write(tmp_path / "two.laz")
    files = [str(tmp_path / f"{name}.laz") for name in ("one", "two")]
    whole = columns_of_files(files)
    box = [770_600, 6_277_500, 770_660, 6_277_520]
    around = read_around(files, box, box, box, ("X", "Y"), pytest.fail)
    x, y = whole["X"], whole["Y"]
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    assert 0 < inside.sum() < len(x) and {*around} == {*whole}
    for name in whole:
        assert np.array_equal(around[name], whole[name][inside]), name
    assert around["UserData"].any()


@pytest.mark.parametrize("text", ["5\n", "inf,2\n", "1,nan\n", "1,2,inf\n", "id,2\n", ""])
def test_rows_that_are_no_numbers_are_refused(tmp_path, text):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(StageError, match=r"two or three numbers|has no points"):
        read_places("", [], str(tmp_path / "p.csv"))


def test_places_must_be_finite_and_features_points(city, run, tmp_path):
    for words in (("nan", "2"), ("inf", "inf"), ("3.87", "95", "--crs", "EPSG:27700")):
        code, _, err = run("explain", city, *words)
        assert code and "internal error" not in err, words
    features = [[[1, 2], [3, 4]], None]
    for number, coordinates in enumerate(features):
        shape = coordinates and {"type": "LineString", "coordinates": coordinates}
        feature = {"type": "Feature", "properties": {}, "geometry": shape}
        layer = {"type": "FeatureCollection", "features": [feature]}
        (tmp_path / f"{number}.geojson").write_text(json.dumps(layer))
        with pytest.raises(StageError, match="not one point"):
            read_places(str(city), [], str(tmp_path / f"{number}.geojson"))


def test_a_file_whose_header_names_another_box_is_read(city, tmp_path):
    """`classify` goes by the points, too."""
    las = laspy.read(city)
    west = las.x < np.median(las.x)
    for name, rows in (("west", west), ("east", ~west)):
        part = laspy.LasData(las.header)
        part.points = las.points[rows].copy()
        part.write(tmp_path / f"{name}.las")
    data = bytearray((tmp_path / "east.las").read_bytes())
    high, low = struct.unpack_from("<2d", data, 179)
    files = [str(tmp_path / "west.las"), str(tmp_path / "east.las")]
    box = [las.x.min(), las.y.min(), las.x.max(), las.y.max()]
    right = read_around(files, box, box, box, ["X"], pytest.fail)
    struct.pack_into("<2d", data, 179, high + 1e5, low + 1e5)
    (tmp_path / "east.las").write_bytes(data)
    wrong = read_around(files, box, box, box, ["X"], pytest.fail)
    assert len(right.number) == len(wrong.number) == len(las)
    assert all(np.array_equal(right[axis], wrong[axis]) for axis in "XYZ")
