"""The report of a survey: figures against plain NumPy, whole and in tiles."""

from __future__ import annotations

import base64
import json
import re
from collections import defaultdict
from pathlib import Path

import laspy
import numpy as np
import pytest

from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.cli import main
from pdal_stages.surfaces.survey_report import read_control, write_report
from pdal_stages.tiling.options import TilingOptions

pytest.importorskip("startinpy")
pytestmark = pytest.mark.pdal
X, Y = 500_000.0, 5_400_000.0
SHIFT = 0.12


def terrain(x, y):
    return 100 + 0.05 * x + 2 * np.sin(y / 30)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """Two strips, of which the second lies 12 cm higher, with a void, a pond, noise, two classes."""
    random = np.random.default_rng(4)
    x, y = random.uniform(0, [[200], [100]], (2, 60_000))
    strip = np.where(random.random(60_000) < 0.5, 7, 9)
    keep = np.where(strip == 7, x < 130, x > 70)  # they overlap by 60 m
    z = terrain(x, y) + np.where(strip == 9, SHIFT, 0) + random.normal(0, 0.02, 60_000)
    codes = np.full(60_000, 2)
    tree = np.hypot(x - 150, y - 70) < 10
    z[tree], codes[tree] = z[tree] + 8, 5
    codes[:50], z[:50] = 7, 50.0
    pond = np.hypot(x - 40, y - 50) < 9
    codes[(np.hypot(x - 40, y - 50) < 12) & ~pond] = 9
    keep &= ~pond & ~((abs(x - 100) < 5) & (abs(y - 50) < 4))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [X, Y, 0]
    import pyproj

    header.add_crs(pyproj.CRS.from_epsg(25832))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x[keep] + X, y[keep] + Y, z[keep]
    las.classification, las.point_source_id = codes[keep], strip[keep]
    las.number_of_returns = random.integers(1, 4, keep.sum())
    las.return_number = np.minimum(random.integers(1, 4, keep.sum()), las.number_of_returns)
    las.gps_time = random.uniform(3e8, 3e8 + 900, keep.sum())
    las.withheld = np.arange(keep.sum()) % 1000 == 0
    path = tmp_path_factory.mktemp("report") / "cloud.laz"
    las.write(str(path))
    return path


@pytest.fixture(scope="module")
def control(cloud):
    """Control points 5 cm below the first strip, and one outside."""
    rows = [(20, 20), (30, 80), (55, 30), (62, 77)]
    lines = [f"{X + x},{Y + y},{terrain(x, y) - 0.05:.4f},P{n}" for n, (x, y) in enumerate(rows)]
    path = cloud.with_name("control.csv")
    path.write_text("x,y,z,name\n" + "\n".join(lines) + f"\n{X - 500},{Y},0,far\n")
    return path


@pytest.fixture(scope="module")
def result(cloud, control):
    page = cloud.with_name("report.html")
    more = {"density": 3.0, "control": str(control), "json_file": str(cloud.with_name("r.json"))}
    result = write_report([str(cloud)], str(page), progress=False, **more)
    assert json.loads(cloud.with_name("r.json").read_text()) == result
    return result


def columns(cloud):
    las = laspy.read(cloud)
    names = "x y z classification point_source_id return_number number_of_returns withheld"
    return [np.asarray(getattr(las, name)) for name in names.split()]


def test_counts(result, cloud):
    x, _, z, codes, strip, number, count, withheld = columns(cloud)
    survey = result["survey"]
    assert survey == result["files"][str(cloud)]
    assert survey["points"] == len(x) and survey["withheld"] == withheld.sum()
    assert survey["last_returns"] == (number == count).sum()
    for name, values in (("classes", codes), ("sources", strip), ("returns", number)):
        assert survey[name] == {str(v): int((values == v).sum()) for v in np.unique(values)}
    assert survey["extent"][2] == [z.min(), z.max()]
    assert 3e8 <= survey["times"][0] < survey["times"][1] < 3e8 + 900


def test_density_and_voids(result, cloud):
    x, y, _, codes, _, number, count, withheld = columns(cloud)
    good = (codes != 7) & (withheld == 0)
    for name, chosen in (("all", good), ("last", good & (number == count))):
        held, _, _ = np.histogram2d(x[chosen] - X, y[chosen] - Y, (20, 10), ((0, 200), (0, 100)))
        inner = held[1:-1, 1:-1] / 100
        assert result["density"]["cells"] == inner.size
        assert result["density"][name]["median"] == pytest.approx(np.median(inner))
        assert result["density"][name]["share_below"] == pytest.approx((inner < 3).mean())
    fine, _, _ = np.histogram2d(x[good] - X, y[good] - Y, (100, 50), ((0, 200), (0, 100)))
    void = result["voids"]
    largest = void["largest"][0]  # 10 x 8 m, of which whole cells are empty; the pond is none
    assert largest["at"] == pytest.approx([X + 100, Y + 50], abs=1.5)
    assert 64 <= largest["area_m2"] <= 88
    pond = (fine[15:25, 20:30] == 0).sum() * 4
    assert pond > 150 and void["area_m2"] < largest["area_m2"] + 60 < (fine == 0).sum() * 4
    assert result["area_m2"] == pytest.approx(20_000, rel=0.02)


def test_strips(result, cloud):
    x, y, z, codes, strip, _, _, withheld = columns(cloud)
    good = np.isin(codes, (2, 9)) & (withheld == 0)
    heights = defaultdict(lambda: defaultdict(list))
    for k in np.flatnonzero(good):
        heights[int(x[k] // 1), int(y[k] // 1)][int(strip[k])].append(z[k])
    mean = {cell: np.mean(np.concatenate([*by.values()])) for cell, by in heights.items()}
    found = []
    for (i, j), by in heights.items():
        beside = [mean.get(place) for place in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))]
        if len(by) < 2 or None in beside:
            continue
        slope = np.hypot(beside[0] - beside[1], beside[2] - beside[3]) / 2
        if slope <= np.tan(np.radians(10)):
            found.append(np.mean(by[9]) - np.mean(by[7]))
    (pair,) = result["strips"]
    assert pair["strips"] == [7, 9] and pair["cells"] == len(found) > 1000
    assert pair["median_m"] == pytest.approx(np.median(found), abs=1.1e-3)
    assert pair["median_m"] == pytest.approx(SHIFT, abs=5e-3)
    assert pair["rms_m"] == pytest.approx(np.sqrt(np.mean(np.square(found))), abs=1e-3)


def test_control_points(result):
    control = result["control"]
    assert control["points"] == 4 and control["outside"] == ["far"]
    errors = [row["difference_m"] for row in control["worst"]]
    assert control["mean_m"] == pytest.approx(0.05, abs=0.02) == np.mean(errors)
    assert control["rmse_m"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    assert control["nssda_95_m"] == pytest.approx(1.96 * control["rmse_m"])
    assert errors == sorted(errors, key=abs, reverse=True)


def test_the_same_in_tiles_and_files(result, cloud, control, tmp_path):
    las = laspy.read(cloud)
    order = np.random.default_rng(0).permutation(len(las.points))
    names = []
    for number, part in enumerate(np.array_split(order, 2)):
        piece = laspy.LasData(las.header)
        piece.points = las.points[part]
        names.append(str(tmp_path / f"{number}.las"))
        piece.write(names[-1])
    tiles = TilingOptions(tile=37.3, workers=0)
    more = {"density": 3.0, "control": str(control), "tiling": tiles, "progress": False}
    cut = write_report(names, str(tmp_path / "r.html"), **more)
    for name in ("survey", "area_m2", "density", "voids", "strips", "control"):
        assert cut[name] == result[name], name


def test_points_that_come_twice_count_once(result, cloud, control, tmp_path):
    copy = tmp_path / "copy.laz"
    copy.write_bytes(cloud.read_bytes())
    more = {"density": 3.0, "control": str(control), "progress": False}
    twice = write_report([str(cloud), str(copy)], str(tmp_path / "r.html"), **more)
    assert twice["repeated"] == result["survey"]["points"] and result["repeated"] == 0
    for name in ("area_m2", "density", "voids", "strips", "control"):
        assert twice[name] == result[name], name


def test_a_far_point_is_counted_named_and_in_no_raster(result, cloud, control, tmp_path, capsys):
    las = laspy.read(cloud)
    las.points = las.points[[*range(len(las.points)), 100]]
    las.x[-1] += 80_000
    las.update_header()
    las.write(str(tmp_path / "far.laz"))
    page = str(tmp_path / "far.html")
    again = write_report([str(tmp_path / "far.laz")], page, control=str(control), progress=False)
    assert "1 point left out of rasters" in capsys.readouterr().err
    assert again["survey"]["points"] == result["survey"]["points"] + 1
    for part in ("voids", "strips", "control"):
        assert again[part] == result[part]
    widths = [picture_widths(text) for text in (Path(page), cloud.with_name("report.html"))]
    assert len(widths[0]) == len(widths[1]) and 0.7 < widths[0][0] / widths[1][0] < 1.5


def picture_widths(page):
    """The widths in pixels of the pictures in a page."""
    pictures = re.findall('base64,([^"]+)"', page.read_text())
    return [int.from_bytes(base64.b64decode(text)[16:20], "big") for text in pictures]


def test_the_page(result, cloud):
    page = cloud.with_name("report.html").read_text()
    assert page.count("<img") == 5 and "<script" not in page and "Signature" in page
    text = re.sub(r"<[^>]+>|\s+", " ", page)
    for shown in ("far", "P0", "7, 9", "+0.12", "2021-03-1", "5 High vegetation", "cloud.laz"):
        assert shown in text, shown


def test_one_strip_without_times_and_ground(tmp_path):
    random = np.random.default_rng(1)
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.scales, header.offsets = [0.01] * 3, [X, Y, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = random.uniform(0, 50, (3, 3000)) + np.array([[X], [Y], [0]])
    las.write(str(tmp_path / "plain.las"))
    result = write_report([str(tmp_path / "plain.las")], str(tmp_path / "r.html"), progress=False)
    assert (
        result["strips"] == [] and result["survey"]["times"] is None and result["control"] is None
    )
    page = (tmp_path / "r.html").read_text()
    assert "the points have no times" in page and "strips are not compared" in page
    assert "Control points" not in page


@pytest.mark.parametrize("count", [1, 40])
def test_a_point_and_a_line(count, tmp_path):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.x = np.arange(count) * 30.0 + 1000
    las.y = las.z = np.full(count, 10.0)
    las.write(str(tmp_path / "line.las"))
    result = write_report(
        [str(tmp_path / "line.las")], str(tmp_path / "r.html"), density=1.0, progress=False
    )
    assert result["survey"]["points"] == count and result["density"]["all"]["median"] is None
    assert "too small to" in (tmp_path / "r.html").read_text()


def test_bad_input(cloud, tmp_path):
    for text, match in (
        ("x,y,z\n1,2,3\n1,2\n", "line 3"),
        ("", "no control points"),
        ("1,2,inf\n", "line 1"),
        ("1,2,3\n4,nan,5\n", "line 2"),
        ("a,b,c\n", "no control points"),
    ):
        (tmp_path / "c.csv").write_text(text)
        with pytest.raises(StageError, match=match):
            read_control(str(tmp_path / "c.csv"))
    (tmp_path / "c.csv").write_text('"id","X","Y","Z"\n7,1,2,3\n')
    assert read_control(str(tmp_path / "c.csv")) == [(1.0, 2.0, 3.0, "7")]
    with pytest.raises(OptionError, match="--void"):
        write_report([str(cloud)], str(tmp_path / "r.html"), void=0.0)
    with pytest.raises(StageError, match="would replace a LAS"):
        write_report([str(cloud)], str(cloud))
    assert not list(tmp_path.glob("*.html"))


def test_the_command(cloud, control, tmp_path, capsys):
    page, figures = tmp_path / "r.html", tmp_path / "r.json"
    more = ["--control", str(control), "--json", str(figures), "--density", "3", "--no-progress"]
    assert main(["report", str(cloud), str(page), *more]) == 0
    shown = capsys.readouterr().out
    assert "control points: mean +0.0" in shown and "m, 1 outside the terrain" in shown
    assert "strips 7 and 9: median +0.12" in shown and f"written to {page}, {figures}" in shown
    assert json.loads(figures.read_text())["density"]["ordered"] == 3.0
