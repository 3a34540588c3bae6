"""``pdal-stages corrections``: what a person changed or looked at is marked, and training draws from it alone."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.base.las import records_of
from pdal_stages.review.corrections import is_near, match_points, write_corrections
from pdal_stages.synthetic import write_town


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("corrections") / "before.laz"
    write_town(ps.make_town(80.0, 4.0, seed=2, progress=False), path)
    return path


def changed_copy(town, path, seed=0, **how):
    """The file with other classes in a corner, in another order; what was changed, in the order of the first."""
    las, random = laspy.read(town), np.random.default_rng(seed)
    xy = np.column_stack([las.x, las.y])
    corner = ((xy - xy.min(axis=0)) < 20).all(axis=1) & (las.classification != 6)
    las.classification[corner] = 6
    order = random.permutation(len(las.points))
    las.points = las.points[order]
    if drop := how.get("drop"):
        las.points = las.points[drop:]
    if scale := how.get("scale"):
        las.change_scaling(scales=[scale] * 3)
    las.write(path)
    return corner, order


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 60), st.integers(1, 6))
def test_partners_are_the_points_themselves(seed, n, places):
    random = np.random.default_rng(seed)
    xyz = random.integers(0, places, (n, 3)) * 0.01 + 500_000.0
    time = random.permutation(n).astype(float)
    order = random.permutation(n)
    matches = match_points(xyz, xyz[order], np.full(3, 0.01), [(time, time[order])])
    assert np.array_equal(order[matches], np.arange(n))
    # Without anything that tells them apart: points of the same place, each taken once.
    matches = match_points(xyz, xyz[order], np.full(3, 0.01))
    assert sorted(matches) == list(range(n))
    assert np.abs(xyz[order][matches] - xyz).max() < 1e-6


def test_points_left_over_take_the_nearest():
    before = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]])
    after = np.array([[2.004, 0, 0], [0.0, 0, 0], [1.006, 0, 0]])
    steps = np.full(3, 0.001)
    assert match_points(before, after, steps, max_steps=10).tolist() == [1, 2, 0, -1]
    assert match_points(before, after, steps, max_steps=5).tolist() == [1, -1, 0, -1]
    assert match_points(before, after, steps).tolist() == [1, -1, -1, -1]


@pytest.mark.parametrize("scales", [(0.001, 0.001, 1.0), (1e-3, 1e-2, 1e-4), (0.5, 0.001, 0.001)])
def test_each_axis_has_its_own_scale(tmp_path, run, scales):
    rng = np.random.default_rng(0)
    cloud = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    cloud.header.scales = scales
    cloud.x, cloud.y, cloud.z = rng.uniform(0, 30, (3, 3000))
    cloud.classification[:] = 2
    cloud.write(tmp_path / "before.las")
    edited = rng.choice(3000, 300, replace=False)
    cloud.classification[edited] = 6
    order = rng.permutation(3000)
    cloud.points = cloud.points[order]
    cloud.write(tmp_path / "after.las")
    names = [str(tmp_path / name) for name in ("before.las", "after.las")]
    code, out, _err = run("corrections", *names, "--out", str(tmp_path / "o.las"), "--around", "0")
    assert code == 0 and "300 changed" in out
    result = laspy.read(tmp_path / "o.las")
    assert np.array_equal(np.flatnonzero(result["Checked"]), np.sort(edited))


@pytest.mark.parametrize("how", [{}, {"drop": 30}, {"scale": 0.01}])
def test_changes_are_found_in_any_order(town, tmp_path, how, run):
    corner, _ = changed_copy(town, tmp_path / "after.laz", **how)
    out = tmp_path / "checked.laz"
    code, output, _ = run(
        "corrections", town, tmp_path / "after.laz", "--out", out, "--around", "0"
    )
    assert code == 0 and ("missing" in output) == bool(how.get("drop"))
    las, before = laspy.read(out), laspy.read(town)
    assert np.array_equal(las.xyz, before.xyz)
    same = las.classification != before.classification
    lost = how.get("drop", 0)
    assert np.count_nonzero(np.asarray(same) != corner) <= lost
    assert np.count_nonzero((np.asarray(las["Checked"]) == 1) != corner) <= lost
    for name in before.point_format.dimension_names:
        if name != "classification":
            assert np.array_equal(las[name], before[name]), name


def test_all_around_a_change_was_seen(town, tmp_path):
    corner, _ = changed_copy(town, tmp_path / "after.laz")
    write_corrections(str(town), str(tmp_path / "o.laz"), str(tmp_path / "after.laz"), radius=2.0)
    las = laspy.read(tmp_path / "o.laz")
    assert np.array_equal(np.asarray(las["Checked"]) > 0, is_near(np.asarray(las.xyz), corner, 2.0))
    # A second time adds to the first.
    again = laspy.read(tmp_path / "o.laz")
    again.classification[:5] = 21
    again.write(tmp_path / "again.laz")
    done = write_corrections(
        str(tmp_path / "o.laz"), str(tmp_path / "p.laz"), str(tmp_path / "again.laz")
    )
    second = laspy.read(tmp_path / "p.laz")
    assert done[0].split(", ")[-2] == "5 changed" and (second["Checked"][:5] == 1).all()
    assert (np.asarray(second["Checked"]) >= np.asarray(las["Checked"])).all()


def test_a_copc_file_becomes_a_plain_one(tmp_path):
    """`classify` does so, too, where PDAL can read COPC."""
    before = Path(__file__).parent / "data/town.copc.laz"
    las = laspy.read(before)
    plain = laspy.LasHeader(version="1.4", point_format=6)
    plain.scales, plain.offsets = las.header.scales, las.header.offsets
    after = laspy.LasData(plain)
    after.x, after.y, after.z = las.x, las.y, las.z
    after.classification = np.where(np.arange(len(las)) < 50, 9, las.classification)
    after.write(tmp_path / "after.laz")
    out = tmp_path / "checked.laz"
    write_corrections(str(before), str(out), str(tmp_path / "after.laz"))
    kept = laspy.read(out)
    assert np.array_equal(kept.xyz, las.xyz) and np.array_equal(
        kept.classification, after.classification
    )
    assert kept.header.parse_crs() == las.header.parse_crs()
    assert "copc" not in {record.user_id for record in [*kept.header.vlrs, *(kept.evlrs or [])]}
    assert len(ps.run_pipeline([str(out)]).arrays[0]) == len(las)


def test_geotiff_keys_that_are_padded_stay_as_they_are(town, tmp_path):
    """Old files in feet have them: laspy counts the padding."""
    las = laspy.read(town)
    las.vlrs[:] = [record for record in las.vlrs if record.user_id != "LASF_Projection"]
    keys = struct.pack("<12H", 1, 1, 0, 1, 3072, 0, 1, 25832, 0, 0, 0, 0)
    las.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", keys))
    las.write(tmp_path / "b.las")
    changed_copy(town, tmp_path / "c.las")
    write_corrections(*(str(tmp_path / f"{name}.las") for name in "bdc"))
    assert [data for _, data in records_of(tmp_path / "d.las", b"LASF_Projection")] == [keys]


@pytest.mark.filterwarnings("ignore:.crs. was not provided")
def test_areas_that_were_looked_at(town, tmp_path):
    shapely, pyogrio = pytest.importorskip("shapely"), pytest.importorskip("pyogrio")
    xyz = np.asarray(laspy.read(town).xyz)
    x, y = xyz[:, :2].min(axis=0)
    shapes = np.array(
        [shapely.to_wkb(shapely.box(x + k, y, x + k + 10, y + 10)) for k in (0, 40)], object
    )
    area = tmp_path / "area.gpkg"
    fields = {"done": np.array([1, 0], np.int32)}
    pyogrio.raw.write(area, shapes, list(fields.values()), list(fields), driver="GPKG", layer="patches",
                      geometry_type="Polygon", crs=None)  # fmt: skip
    done = write_corrections(str(town), str(tmp_path / "o.laz"), areas=(str(area),))
    inside = (xyz[:, 0] <= x + 10) & (xyz[:, 1] <= y + 10)
    assert np.array_equal(np.asarray(laspy.read(tmp_path / "o.laz")["Checked"]) > 0, inside)
    assert f"0 changed, {inside.sum():,} checked" in done[0]
    none = tmp_path / "none.gpkg"
    pyogrio.raw.write(none, shapes, [np.zeros(2, np.int32)], ["done"], driver="GPKG", layer="patches",
                      geometry_type="Polygon", crs=None)  # fmt: skip
    with pytest.raises(StageError, match="no patch is marked as checked"):
        write_corrections(str(town), str(tmp_path / "x.laz"), areas=(str(none),))
    assert not (tmp_path / "x.laz").exists()


def test_other_points_are_refused(town, tmp_path, run):
    las = laspy.read(town)
    las.x = np.asarray(las.x) + 5.0
    las.write(tmp_path / "moved.laz")
    code, _, err = run("corrections", town, tmp_path / "moved.laz", "--out", tmp_path / "o.laz")
    assert code == 1 and "do not hold the same points" in err
    code, _, err = run("corrections", town, "--out", tmp_path / "o.laz")
    assert code == 1 and "nothing to mark" in err
    assert run("corrections", town, town, "--out", town)[0] == 1


@pytest.mark.pdal
def test_training_on_corrections_keeps_the_base_where_it_is_sure(town, tmp_path, run):
    """If the points have a Reliability, as many of those that nobody looked at as of the most frequent checked class."""
    las = laspy.read(town)
    codes = np.asarray(las.classification).copy()
    known = np.isin(codes, (2, 5, 6))
    xyz = np.asarray(las.xyz)
    checked = known & (xyz[:, 0] > np.quantile(xyz[:, 0], 0.9))
    sure = known & ~checked & (xyz[:, 1] > np.median(xyz[:, 1]))
    for name, kind in (("Checked", "uint8"), ("Reliability", "float32")):
        las.add_extra_dim(laspy.ExtraBytesParams(name, kind))
    las["Checked"] = checked.astype(np.uint8)
    las["Reliability"] = np.where(sure, 0.97, 0.9).astype(np.float32)
    las.write(tmp_path / "checked.laz")
    model = tmp_path / "m.model"
    words = ["--model", model, "--base", "standard", "--classes", "2,5,6"]
    code, out, err = run("train", tmp_path / "checked.laz", *words)
    corrected = {code: np.count_nonzero(checked & (codes == code)) for code in (2, 5, 6)}
    anchors = {
        code: min(np.count_nonzero(sure & (codes == code)), max(corrected.values()))
        for code in corrected
        if corrected[code]
    }
    sentence = f"from about {sum(anchors.values()):,} others of which the base is sure"
    assert code == 0 and sentence in err + out
    info = ps.load_model(str(model)).info
    assert info["sureness"]["about"].startswith("its base (")


@pytest.mark.pdal
def test_folders_are_corrected_as_files_are(town, tmp_path, run):
    """Files by name; those without changes are not written, and an error leaves none."""
    las = laspy.read(town)
    part = np.floor((las.x - las.x.min()) / 30).astype(int)
    (tmp_path / "before").mkdir()
    (tmp_path / "after").mkdir()
    for number in range(3):
        piece = laspy.LasData(las.header, las.points[part == number])
        piece.write(tmp_path / "before" / f"t{number}.laz")
        if number < 2:
            piece.classification[: 100 * number] = 6
            piece.write(tmp_path / "after" / f"t{number}_edited.laz")
    out = tmp_path / "checked"
    words = ["corrections", tmp_path / "before", tmp_path / "after", "--out", out]
    code, text, err = run(*words)
    assert code == 0, err
    assert "2 of 3 files were not written" in text
    assert [path.name for path in out.iterdir()] == ["t1.laz"]
    assert np.asarray(laspy.read(out / "t1.laz")["Checked"])[:100].mean() > 0.9
    one = tmp_path / "one.laz"
    files = [tmp_path / name for name in ("before/t1.laz", "after/t1_edited.laz")]
    assert run("corrections", *files, "--out", one)[0] == 0
    assert one.read_bytes() == (out / "t1.laz").read_bytes()
    (tmp_path / "after" / "another.laz").write_bytes(files[1].read_bytes())
    (out / "t1.laz").unlink()
    code, _, err = run(*words)
    assert code == 1 and "another.laz" in err and not list(out.iterdir())
