"""`classify --where`: one selection, made on the classes of the input, for every step."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from bridge_scenes import SCENES, scan

from pdal_stages.stages.points import SELECTED, Points

pytestmark = pytest.mark.pdal
WHERE = ("--where", "Classification == 1")
TILES = ("--tile", 100, "--workers", 0, "--no-progress")


def write(write_las, path, xyz, point_format, **more):
    """A cloud of class 1 with a low outlier; its least coordinates are 500,000, 5,400,000 and 100."""
    arrays = dict(zip("XYZ", (xyz - xyz.min(axis=0)).T, strict=True))
    arrays["Z"][0] -= 30.0
    arrays["Classification"] = np.ones(len(xyz), np.uint8)
    shift = dict(zip("XYZ", (500_000, 5_400_000, 100), strict=True))
    arrays = {name: values + shift.get(name, 0) for name, values in arrays.items()}
    return write_las(path, arrays | more, point_format=point_format)


def classes(path):
    las = laspy.read(path)
    assert SELECTED not in las.point_format.dimension_names
    return np.asarray(las.classification)


@pytest.mark.parametrize("tiles", [(), TILES])
def test_decks_of_points_that_the_model_gives_another_class(tmp_path, run, write_las, tiles):
    """LAS 1.2, where some points have flags and some have a class that --where leaves out."""
    xyz, codes = scan(SCENES["overpass"](), 4.0)
    rng = np.random.default_rng(0)
    flags = (rng.random(len(xyz)) < 0.2).astype(np.uint8)
    source = write(write_las, tmp_path / "in.las", xyz, 1, Synthetic=flags, KeyPoint=flags[::-1])
    words = ("classify", source, tmp_path / "out.las", "--bridges", *tiles)
    assert run(*words)[0] == 0
    every = classes(tmp_path / "out.las")
    code, output, err = run(*words, *WHERE)
    assert code == 0, err
    codes_values = classes(tmp_path / "out.las")
    assert np.array_equal(codes_values, every) and codes_values[0] == 7
    assert (codes_values[codes == 17] == 17).mean() > 0.7 and "bridge decks" in output
    las = laspy.read(tmp_path / "out.las")
    assert np.array_equal(las.synthetic, flags) and np.array_equal(las.key_point, flags[::-1])
    kept = laspy.read(source)
    left_out = (codes == 17) & (rng.random(len(xyz)) < 0.5)
    kept.classification[left_out] = 9
    kept.write(source)
    assert run(*words, *WHERE, *(("--resume",) if tiles else ()))[0] == 0
    codes_values = classes(tmp_path / "out.las")
    assert (codes_values[left_out] == 9).all() and not (codes_values[~left_out] == 9).any()
    assert np.array_equal(codes_values[~left_out], every[~left_out])  # they are still neighbors


def test_resume_with_another_condition_keeps_nothing(tmp_path, run, write_las):
    xyz, _ = scan(SCENES["overpass"](), 1.0)
    source = write(write_las, tmp_path / "in.las", xyz, 6)
    x = 500_000 + np.ptp(xyz[:, 0]) / 2
    for condition in (f"X < {x}", f"X >= {x}"):
        for name, more in (("resumed.las", ["--resume"]), ("fresh.las", [])):
            (tmp_path / "fresh.las").unlink(missing_ok=True)
            words = ("classify", source, tmp_path / name, *TILES, "--where", condition, *more)
            assert run(*words)[0] == 0
        assert (tmp_path / "resumed.las").read_bytes() == (tmp_path / "fresh.las").read_bytes()


def test_bridges_and_polygons_of_points_that_the_model_gives_another_class(
    tmp_path, run, write_las
):
    pyogrio, shapely = pytest.importorskip("pyogrio"), pytest.importorskip("shapely")
    xyz, _ = scan(SCENES["overpass"](), 4.0)
    source = write(write_las, tmp_path / "in.las", xyz, 6)
    lake = shapely.box(499_000, 5_399_000, 500_000 + np.ptp(xyz[:, 0]) / 2, 5_401_000)
    pyogrio.raw.write(
        tmp_path / "lake.gpkg",
        shapely.to_wkb([lake]),
        [],
        [],
        geometry_type="Polygon",
        crs="EPSG:28992",
    )
    words = ("classify", source, tmp_path / "out.las", "--bridges")
    words += ("--polygons", f"{tmp_path / 'lake.gpkg'}=9:2")
    assert run(*words)[0] == 0
    every = classes(tmp_path / "out.las")
    assert run(*words, *WHERE)[0] == 0
    assert np.array_equal(classes(tmp_path / "out.las"), every)
    assert (every == 17).sum() > 500 and (every == 9).any()


def test_in_a_pipeline_each_where_sees_the_classes_of_its_place(tmp_path, run_job, write_las):
    """As in PDAL; `mark` keeps what the first one saw."""
    xyz, _ = scan(SCENES["overpass"](), 4.0)
    source = write(write_las, tmp_path / "in.las", xyz, 6)
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
    model = {"type": "filters.modelclassifier", "model": "standard", "where": WHERE[1]}
    decks = {}
    for where in (WHERE[1], "Mine == 1"):
        stages = [source, heights, model | {"mark": "Mine"}]
        stages += [{"type": "filters.bridges", "where": where}, tmp_path / "out.las"]
        assert run_job(stages)[0] == 0
        decks[where] = (np.asarray(laspy.read(tmp_path / "out.las").classification) == 17).sum()
    assert not decks[WHERE[1]] and decks["Mine == 1"] > 100


# ---- overlap -----------------------------------------------------------------------------------------------


def test_class_0_with_the_overlap_flag_is_classified_in_las_14(tmp_path, run, write_las):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 40, (2, 4000))
    xyz = np.column_stack([x, y, rng.normal(0, 0.03, 4000)])
    overlap = (np.arange(4000) % 3 == 0).astype(np.uint8)
    source = write(write_las, tmp_path / "in.las", xyz, 6, Overlap=overlap)
    las = laspy.read(source)
    las.classification[:] = 0
    las.write(source)
    code, _, err = run("classify", source, tmp_path / "out.las")
    assert code == 0, err
    out = laspy.read(tmp_path / "out.las")
    assert not (np.asarray(out.classification) == 0).any()
    assert np.array_equal(out.overlap, overlap)


@pytest.mark.parametrize(
    ("of_old_format", "kept"), [(True, [True, True, False]), (False, [True, False, False])]
)
def test_what_newer_pdal_reads_of_class_12(of_old_format, kept):
    """Class 12 of LAS 1.0-1.3 becomes class 0 with a flag; in LAS 1.4 these are two different things."""
    from pdal_stages.pipeline.pdal import overlap_as_flag
    from pdal_stages.stages.bridges import Bridges

    arrays = {
        **dict.fromkeys("XYZ", np.zeros(3)),
        "Classification": np.array([12, 0, 0], np.uint8),
        "Overlap": np.array([0, 1, 0], np.uint8),
    }
    metadata = {"readers.las": {"dataformat_id": 1 if of_old_format else 6}}
    points = Points(arrays, overlap_as_flag=overlap_as_flag(arrays, metadata))
    assert points.chosen(Bridges({}).keep).tolist() == kept


@pytest.mark.parametrize("door", ["classify", "pipeline"])
@pytest.mark.parametrize(
    "name",
    ["X", "z", "Intensity", "CLASSIFICATION", "Reliability", "heightaboveground", "mine", "MINE"],
)
def test_a_mark_is_no_dimension_that_is_there(tmp_path, run, run_job, write_las, name, door):
    """In any case of letters, of LAS, of the stages, or of the file."""
    xyz = np.random.default_rng(0).uniform(0, 30, (3000, 3)) * [1, 1, 0.01]
    source = write(write_las, tmp_path / "in.las", xyz, 6, mine=np.arange(3000.0))
    out = tmp_path / "out.las"
    if door == "classify":
        option = f"--filters.modelclassifier.mark={name}"
        code, _, err = run("classify", source, out, "--where", "Z > 0", option)
    else:
        classifier = {"type": "filters.modelclassifier", "model": "standard", "mark": name}
        heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
        reader = {"type": "readers.las", "filename": str(source), "use_eb_vlr": True}
        code, _, err = run_job([reader, heights, classifier, out])
    assert code == 1 and "'mark' must name a new dimension" in err
    assert not out.exists()


@pytest.mark.parametrize("tiles", [(), TILES])
def test_points_are_selected_as_they_came_in(tmp_path, run, write_las, tiles):
    """By the input's own heights, which are all 0, not by those of this run; for every step."""
    xyz, _ = scan(SCENES["overpass"](), 4.0)
    zero = np.zeros(len(xyz), np.float32)
    source = write(write_las, tmp_path / "in.las", xyz, 6, HeightAboveGround=zero)
    out = tmp_path / "out.las"
    code, _, err = run("classify", source, out, "--where", "HeightAboveGround > 2", *tiles)
    assert code == 0 and "'where' matches no points: HeightAboveGround > 2" in err
    assert (classes(out) == 1).all()
    code, _, err = run("classify", source, out, "--where", "HeightAboveGround <= 2", *tiles)
    assert code == 0 and (classes(out) != 1).mean() > 0.9


@pytest.mark.parametrize("tiles", [(), TILES])
@pytest.mark.parametrize(
    "where", ["Reliability < 0.5", "Reliability >= 0.5", "HeightAboveGround > 2"]
)
def test_a_condition_on_what_the_input_lacks_is_refused(tmp_path, run, write_las, where, tiles):
    xyz, _ = scan(SCENES["overpass"](), 4.0)
    source = write(write_las, tmp_path / "in.las", xyz, 6, mine=np.zeros(len(xyz)))
    out = tmp_path / "out.las"
    code, _, err = run("classify", source, out, "--where", where, *tiles)
    name = where.split()[0]
    assert (
        code == 1 and f"'where' names the dimension '{name}', which the points do not have" in err
    )
    listed = err.partition("(found ")[2].partition(")")[0].split(", ")
    assert {"X", "Classification", "mine"} <= {*listed} and name not in listed
    assert not out.exists() and not any("PdalStages" in each for each in listed)
