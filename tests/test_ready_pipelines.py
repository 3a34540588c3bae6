"""Every file in pipelines/, run through PDAL on the generated town."""

from __future__ import annotations

import subprocess
from pathlib import Path

import laspy
import numpy as np
import pytest

from pdal_stages import load_model, run_tiled
from pdal_stages.classifier.training_options import RECIPES
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.json_source import parse_overrides
from pdal_stages.pipeline.run import Pipeline

pytestmark = pytest.mark.pdal
FOLDER = Path(__file__).resolve().parent.parent / "pipelines"
FILES = sorted(FOLDER.glob("*.json"))


def words(source, output=None, model=None, more=()):
    """Options by tag: the files of a run, and more as (tag.option, value)."""
    options = {"input.filename": source, "output.filename": output, "classifier.model": model}
    return [f"--stage.{k}={v}" for k, v in {**options, **dict(more)}.items() if v is not None]


def run(name, *given, **more):
    """Run a ready pipeline with its files."""
    overrides, rest = parse_overrides(words(*given, **more))
    assert not rest
    pipeline = Pipeline(FOLDER / f"{name}.json", overrides)
    pipeline.execute()
    return pipeline


def test_all_are_on_their_page():
    listed = (FOLDER.parent / "docs" / "pipelines.md").read_text()
    assert all(f"`{f.name}`" in listed for f in FILES)


@pytest.mark.parametrize(
    "name",
    [f"classify{more}" for more in ("", "-with-rejection", "-on-smrf-ground", "-regularized")],
)
def test_classify(ready_town, ready_models, tmp_path, name):
    model = ready_models / ("smrf.model" if "smrf" in name else "classes.model")
    run(name, ready_town, tmp_path / "o.laz", model)
    before, after = laspy.read(ready_town), laspy.read(tmp_path / "o.laz")
    reliability, codes = np.asarray(after["Reliability"]), np.asarray(after.classification)
    sure = np.isin(before.classification, [2, 5, 6]) & (reliability > 0.5)
    assert np.mean(codes[sure] == np.asarray(before.classification)[sure]) > 0.85
    if name == "classify-with-rejection":
        assert (codes[reliability < 0.5] == 1).all()
        assert {"Margin", "Probability_2"} <= set(after.point_format.dimension_names)


@pytest.mark.parametrize(
    "name", ["noise", "normalize", "features", "features-for-viewers", "copc-to-tiles"]
)
def test_those_that_need_no_model_of_their_own(ready_town, ready_models, tmp_path, name):
    octree = Path(__file__).parent / "data" / "town.copc.laz"
    source = octree if name.startswith("copc") else ready_town
    classifies = '"classifier"' in (FOLDER / f"{name}.json").read_text()
    model = ready_models / "classes.model" if classifies else None
    run(name, source, tmp_path / "o_#.laz", model)
    parts = [laspy.read(path) for path in tmp_path.glob("o_*.laz")]
    assert sum(map(len, parts)) == len(laspy.read(source))


def test_tile_index_to_tiles(ready_halves, ready_models, tmp_path):
    index = tmp_path / "survey.gpkg"
    command = [pdal_env.program(), "tindex", "create", str(index)]
    command += ["--stdin", "-f", "GPKG", "--lyr_name", "pdal"]
    files = "\n".join(map(str, ready_halves.glob("*.laz")))
    subprocess.run(command, input=files, text=True, check=True, capture_output=True)
    options = words(index, tmp_path / "o_#.laz", ready_models / "classes.model")
    overrides = parse_overrides(options)[0]
    run_tiled(FOLDER / "tile-index-to-tiles.json", 500, overrides, per="tile", workers=0)
    assert list(tmp_path.glob("o_*.laz"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("paper-*.json")), ids=lambda path: path.stem)
def test_papers(ready_town, tmp_path, path):
    """Each trains as its recipe says, with fewer samples and trees, and the model classifies."""
    recipe, more = path.stem.removeprefix("paper-"), {"model.count": 60, "model.folds": 0}
    if recipe == "winiwarter2019":
        pytest.importorskip("torch", reason="PyTorch is not installed (extra 'deep')")
        more |= {"model.alsnet": '{"configuration": "tiny", "epochs": 1}'}
    elif recipe == "blomley2016":
        more |= {"model.trees_grid": "3,4"}
    else:
        more |= {"model.trees": 4}
    run(path.stem, ready_town, more=more | {"model.filename": tmp_path / "a.model"})
    model = load_model(tmp_path / "a.model")
    names = dict(model.classes)
    if recipe.endswith("binary"):
        assert names == {1: "Background", 6: "Building"}
    else:
        assert {2, 5, 6} <= names.keys()
    options = RECIPES[recipe]
    if "alsnet" in options:
        assert model.info["training"]["network"]["augment"] is False
        assert model.info["training"]["network"]["learning_rate"] == 0.001
    else:
        assert model.info["training"]["vote"] == options.get("vote", "mean")
        assert len(model.passes) == 1


def test_evaluate(ready_town, ready_models, tmp_path):
    pages = {f"accuracy.{kind}": tmp_path / f"a.{kind}" for kind in ("json", "html")}
    model = ready_models / "classes.model"
    pipeline = run("evaluate", ready_town, tmp_path / "o.laz", model, more=pages)
    shown = pipeline.metadata["metadata"]["filters.accuracy"]["overall_accuracy"]
    assert 0.8 < shown <= 1
    assert str(round(shown, 6))[:6] in (tmp_path / "a.json").read_text()
    assert "<html" in (tmp_path / "a.html").read_text()


def test_tiles_to_tiles(ready_town, ready_halves, ready_models, tmp_path):
    files = ready_halves / "*.laz", tmp_path / "classified_#.laz", ready_models / "classes.model"
    run("tiles-to-tiles", *files, more={"tiles.length": 40})
    parts = [laspy.read(p) for p in sorted(tmp_path.glob("classified_*.laz"))]
    assert len(parts) == 4
    assert sum(len(p) for p in parts) == len(laspy.read(ready_town))
    corners = set()
    for part in parts:  # tiles of one grid, none a sliver of half a meter
        cells = {axis: set(np.unique(np.asarray(part[axis]) // 40)) for axis in "xy"}
        assert all(len(result) == 1 for result in cells.values()), cells
        corners.add(tuple(result.pop() for result in cells.values()))
    assert len(corners) == 4


def test_raw_to_footprints(ready_town, tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    run("raw-to-footprints", ready_town, tmp_path / "o.gpkg")
    names = [name for name, _ in pyogrio.list_layers(tmp_path / "o.gpkg")]
    assert names[:5] == ["buildings", "trees", "crowns", "spans", "decks"]
    assert pyogrio.read_info(tmp_path / "o.gpkg", layer="buildings")["features"] > 0


def test_terrain_and_surface_of_a_survey_show_no_tiles(ready_town, ready_halves, tmp_path):
    (tmp_path / "classified").mkdir()
    writer = {"type": "writers.las", "filename": "", "forward": "all", "extra_dims": "all"}
    heights = {"type": "filters.hag_morphological", "window": 20}
    writer["filename"] = str(tmp_path / "classified" / "#.laz")
    stages = [str(ready_halves / "*.laz"), heights, writer]
    assert not run_tiled(stages, 25, workers=0, progress=False).failures
    writer["filename"] = str(tmp_path / "whole.laz")
    Pipeline([str(ready_town), heights, writer]).execute()
    place = {"resolution": 1, "origin_x": 499_995, "origin_y": 5_399_995, "width": 70, "height": 70}
    rasters = {}
    for kind, source in (("files", "classified/*.laz"), ("whole", "whole.laz")):
        options = {}
        for model in ("surface", "terrain"):
            options |= {f"{model}.{name}": value for name, value in place.items()}
            options[f"{model}.filename"] = tmp_path / f"{model}_{kind}.tif"
        run("terrain-and-surface", tmp_path / source, more=options)
        for model in ("surface", "terrain"):
            rasters[model, kind] = raster(tmp_path / f"{model}_{kind}.tif").reshape(70, 70)
    for model in ("surface", "terrain"):
        assert np.allclose(rasters[model, "files"], rasters[model, "whole"], atol=1e-9)
        assert (rasters[model, "files"][10:60, 10:60] != -9999).all()
    inside = np.s_[10:60, 10:60]
    above = (rasters["surface", "files"] - rasters["terrain", "files"])[inside]
    assert above.max() > 4 and np.quantile(above, 0.1) < 1.5


@pytest.mark.parametrize("suffix", ["las", "LAZ"])
def test_the_surface_is_the_highest_point_near_the_middle_of_a_cell(
    tmp_path, write_las, pdal_program, suffix
):
    """Neither points from other cells nor withheld ones are in it; both suffixes are read."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 40, (2, 20_000))
    x[:2], y[:2] = (0, 39.999), (0, 39.999)  # the raster begins at the first point
    z = rng.uniform(0, 10, 20_000)
    withheld = np.zeros(len(x), np.uint8)
    withheld[100:300] = 1
    z[withheld == 1] = 250.0
    arrays = {"X": x, "Y": y, "Z": z, "Withheld": withheld, "HeightAboveGround": z}
    (tmp_path / "classified").mkdir()
    for point_format in (1, 6):
        source = tmp_path / "classified" / f"a.{suffix}"
        write_las(source, dict(arrays), point_format=point_format, offset=[0, 0, 0])
        command = [pdal_program, "pipeline", str(FOLDER / "terrain-and-surface.json")]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
        reader = {"type": "readers.gdal", "filename": str(tmp_path / "surface.tif")}
        reading = Pipeline([{**reader, "header": "Z"}])
        reading.execute()
        cells, radius = reading.arrays[0], 1 / np.sqrt(np.pi)  # a circle with a cell's area
        cells = cells[(cells["X"] > 0) & (cells["X"] < 40)]
        assert len(cells) == 1600
        for column, row, height in zip(cells["X"], cells["Y"], cells["Z"], strict=True):
            distance = np.where(withheld == 0, np.hypot(x - column, y - row), np.inf)
            low, high = (z[distance < radius + step].max() for step in (-0.001, 0.001))
            assert low - 0.001 < height < high + 0.001


# ---- flags of LAS 1.0-1.3, which PDAL before 2.6 reads as parts of the class -----------------------------


def flagged(write_las, path, point_format, everywhere=()):
    """Level ground; half of it are key-points, a third is synthetic; noise 400 m above, also withheld or synthetic."""
    rng = np.random.default_rng(0)
    n = 8000
    x, y = rng.uniform(0, 40, (2, n))
    arrays = {"X": x + 5e5, "Y": y + 5.4e6, "Z": rng.normal(0, 0.03, n)}
    arrays["Classification"] = np.full(n, 2, np.uint8)
    arrays["KeyPoint"] = (x > 20).astype(np.uint8)
    arrays["Synthetic"] = (np.arange(n) % 3 == 0).astype(np.uint8)
    arrays["Withheld"] = np.zeros(n, np.uint8)
    arrays |= {name: np.ones(n, np.uint8) for name in everywhere}
    noise = slice(0, n, 500)
    arrays["KeyPoint"][noise] = 0
    arrays["Withheld"][noise] = np.arange(16) % 2
    arrays["Z"][noise] = 400.0
    arrays["Classification"][noise] = np.repeat([7, 18], 8)
    arrays["HeightAboveGround"] = arrays["Z"].copy()
    return write_las(path, arrays, point_format=point_format)


def raster(path):
    reading = Pipeline([{"type": "readers.gdal", "filename": str(path), "header": "Z"}])
    reading.execute()
    return reading.arrays[0]["Z"]


@pytest.mark.parametrize("program", ["pdal", "pdal-stages"])
@pytest.mark.parametrize("everywhere", [(), ("Synthetic",)])
def test_rasters_of_points_with_flags(tmp_path, write_las, pdal_program, program, everywhere):
    outputs = []
    for point_format in (1, 6):
        source = flagged(write_las, tmp_path / f"{point_format}.las", point_format, everywhere)
        rasters = {kind: tmp_path / f"{kind}{point_format}.tif" for kind in ("surface", "terrain")}
        more = {f"{kind}.filename": path for kind, path in rasters.items()}
        if program == "pdal":
            command = [pdal_program, "pipeline", FOLDER / "terrain-and-surface.json"]
            subprocess.run([*command, *words(source, more=more)], check=True, capture_output=True)
        else:
            run("terrain-and-surface", source, more=more)
        outputs += map(raster, rasters.values())
    for old, new in zip(outputs[:2], outputs[2:], strict=True):
        assert len(old) in range(39**2, 42**2) and np.array_equal(old, new)
        assert np.abs(old[old != -9999]).max() < 1
