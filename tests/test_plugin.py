"""Our stages as PDAL's own, run by the program `pdal` and by python-pdal's own objects.

The plugin is compiled once into a folder of the tests' own, which PDAL is told of, so that what is installed does not
matter.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.overrides import apply_overrides, parse_overrides
from pdal_stages.plugin import arrival, building, places
from pdal_stages.stages import registry
from pdal_stages.synthetic import TownOptions, write_town

pytestmark = pytest.mark.pdal
PIPELINES = sorted((Path(__file__).resolve().parent.parent / "pipelines").glob("*.json"))
#: Smaller than the files say; the stages are the same.
QUICK = ["--stage.model.neighborhoods=c2,s2", "--stage.model.count=300", "--stage.model.trees=10"]


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """The folder of the plugin."""
    folder = tmp_path_factory.mktemp("plugin") / "not" / "there"
    building.install(folder)
    return folder


@pytest.fixture(scope="module")
def environment(plugin):
    """A process's environment in which PDAL finds the plugin."""
    folders = [str(plugin), *os.environ.get("PDAL_DRIVER_PATH", "").split(os.pathsep)]
    folders.append(str(places.plugin_folder()))
    return {**os.environ, "PDAL_DRIVER_PATH": os.pathsep.join(filter(None, folders))}


@pytest.fixture(scope="module")
def stock(environment, pdal_program, tmp_path_factory):
    """Run the program `pdal`; fails unless its exit code is `code`."""

    def run(*words, code=0, **how):
        done = subprocess.run(
            [pdal_program, *map(str, words)],
            env=environment, capture_output=True, text=True, timeout=300, check=False, **how,
        )  # fmt: skip
        assert done.returncode == code, (done.returncode, done.stdout, done.stderr)
        return done

    return run


@pytest.fixture(scope="module")
def pipeline(stock, tmp_path_factory):
    """Run a list of stages with stock `pdal pipeline`."""
    folder = tmp_path_factory.mktemp("jobs")
    count = iter(range(10_000))

    def run(stages, *words, **how):
        path = folder / f"{next(count)}.json"
        path.write_text(json.dumps(pdal_env.adapted(stages)))
        return stock("pipeline", path, *words, **how)

    return run


@pytest.fixture(scope="module")
def python(environment):
    """Run Python code in another process, in which python-pdal finds the plugin; what it prints."""

    def run(code, **more):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**environment, **more}, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, (done.returncode, done.stdout, done.stderr)
        return done.stdout

    return run


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.laz"
    write_town(TownOptions(size=60, density=5, seed=3), path)
    return path


@pytest.fixture(scope="module")
def halves(town, tmp_path_factory):
    """The town in two files."""
    folder = tmp_path_factory.mktemp("halves")
    for half, limits in (("west", "X[:500030]"), ("east", "X(500030:]")):
        ps.Pipeline(
            [
                str(town),
                {"type": "filters.range", "limits": limits},
                {"type": "writers.las", "filename": str(folder / f"{half}.laz")},
            ]
        ).execute()
    return folder


@pytest.fixture(scope="module")
def models(town, tmp_path_factory):
    """The models that pipelines apply, trained by our own command."""
    folder = tmp_path_factory.mktemp("models")
    for name, file in (("train", "classes"), ("train-binary", "buildings"), ("train-on-smrf-ground", "smrf")):
        words = [f"--stage.input.filename={town}", f"--stage.model.filename={folder / file}.model", *QUICK]
        ps.Pipeline(with_words(name, *words)).execute()
    ps.Pipeline(las([str(town), {"type": "filters.hag_minima"}], folder / "heights.laz")).execute()
    return folder


def with_words(name, *words):
    """A ready pipeline with overrides."""
    stages = json.loads(next(path for path in PIPELINES if path.stem == name).read_text())
    return apply_overrides(stages, parse_overrides(words)[0])


def assert_same(one, other):
    """The same bytes; of LAS files the same points and dimensions, since ours keeps records that PDAL writes anew."""
    if one.suffix not in (".las", ".laz"):
        assert one.read_bytes() == other.read_bytes(), one.name
        return
    points, others = laspy.read(one).points, laspy.read(other).points
    assert points.array.dtype == others.array.dtype
    assert points.array.tobytes() == others.array.tobytes()
    assert [*points.scales, *points.offsets] == [*others.scales, *others.offsets]


def las(stages, output):
    return [*stages, {"type": "writers.las", "filename": str(output), "forward": "all", "extra_dims": "all"}]


# ---- what PDAL knows of the stages -------------------------------------------------------------------------


def test_every_stage_is_listed_with_its_options(stock):
    listed = {
        entry["name"]: entry["description"] for entry in json.loads(stock("--drivers", "--showjson").stdout)
    }
    for name, kind in registry.stages().items():
        assert listed[name] == kind.summary
        described = stock("--options", name).stdout
        for option in kind.all_options():
            assert f"\n  {option.name}" in described, (name, option.name)


# ---- the same bytes ----------------------------------------------------------------------------------------

STAGES = {
    "accuracy": {"type": "filters.accuracy", "reference": "Classification", "print": False},
    "bridges": {"type": "filters.bridges", "code": 18},
    "consistency": {"type": "filters.consistency", "lone": False},
    "detachednoise": {"type": "filters.detachednoise"},
    "hag_minima": {"type": "filters.hag_minima", "cell": 10, "resolution": 0.25, "ignore": ["7", "withheld"]},
    "hag_morphological": {"type": "filters.hag_morphological", "ground": True, "openings": [5, 9]},
    "wires": {"type": "filters.wires", "code": 13},
    "objects": {"type": "filters.objects", "refuse": ["low", "small"]},
    "multiscalefeatures": {
        "type": "filters.multiscalefeatures",
        "neighborhoods": ["c1", "kopt(10,30)"],
        "feature_set": "covariance",
    },
}


def test_no_stage_is_forgotten():
    """Each is compared with our command, here or in a ready pipeline; filters.polygons, of a vector file, is not."""
    ready = {stage["type"] for path in PIPELINES for stage in json.loads(path.read_text())}
    tested = ready | {stage["type"] for stage in STAGES.values()} | {"writers.objects", "filters.polygons"}
    assert set(registry.stages()) <= tested


@pytest.mark.parametrize(
    ("name", "where"),
    [*((name, None) for name in STAGES), ("hag_morphological", "X > 500030 && Classification != 6")],
)
def test_a_stage_gives_the_same_bytes(pipeline, town, tmp_path, name, where):
    stage = {**STAGES[name], **({"where": where} if where else {})}
    heights = [
        {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17], "decks": name == "bridges"}
    ]
    stages = [str(town), *(heights if name in ("bridges", "objects", "consistency", "wires") else []), stage]
    pipeline(las(stages, tmp_path / "stock.laz"))
    ps.Pipeline(las(stages, tmp_path / "ours.laz")).execute()
    assert_same(tmp_path / "stock.laz", tmp_path / "ours.laz")


@pytest.mark.parametrize("door", ["program", "python"])
def test_objects_are_written(pipeline, python, town, tmp_path, door):
    """The program of PDAL 2.2 has another GEOS and GDAL than Shapely and pyogrio bring: they work in a process apart."""
    pytest.importorskip("pyogrio")
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
    for name in ("stock", "ours"):
        stages = [
            str(town),
            heights,
            {"type": "writers.objects", "filename": str(tmp_path / f"{name}.geojson")},
        ]
        if name == "ours":
            ps.Pipeline(stages).execute()
        elif door == "program":
            pipeline(stages)
        else:
            python(f"import json, pdal; pdal.Pipeline(json.dumps({stages!r})).execute()")
    layers = sorted(path.name.removeprefix("ours") for path in tmp_path.glob("ours*.geojson"))
    assert "_buildings.geojson" in layers
    for layer in layers:
        stock, ours = (json.loads((tmp_path / f"{name}{layer}").read_text()) for name in ("stock", "ours"))
        assert stock["features"] == ours["features"]
        assert stock["features"] or layer != "_buildings.geojson"


def _words(name, town, halves, models, folder):
    """Overrides that let a ready pipeline run here, its outputs in a folder."""
    out = {"tiles-to-tiles": "o_#.laz", "copc-to-tiles": "o_#.laz", "tile-index-to-tiles": "o_#.laz"}
    source = {
        "tiles-to-tiles": halves / "*.laz",
        "copc-to-tiles": Path(__file__).parent / "data" / "town.copc.laz",
        "tile-index-to-tiles": halves / "survey.gpkg",
    }
    words = [f"--stage.input.filename={source.get(name, town)}"]
    if name.startswith("train"):
        return [*words, f"--stage.model.filename={folder / 'm.model'}", *QUICK]
    if name == "terrain-and-surface":
        words[0] = f"--stage.input.filename={models / 'heights.laz'}"
        return [*words, *(f"--stage.{tag}.filename={folder / tag}.tif" for tag in ("surface", "terrain"))]
    words.append(f"--stage.output.filename={folder / out.get(name, 'o.laz')}")
    if any(stage.get("tag") == "classifier" for stage in with_words(name)):
        words.append(f"--stage.classifier.model={models / ('smrf' if 'smrf' in name else 'classes')}.model")
    if name == "evaluate":
        words += [f"--stage.accuracy.json={folder / 'a.json'}", f"--stage.accuracy.html={folder / 'a.html'}"]
    if name == "tiles-to-tiles":
        words.append("--stage.tiles.length=40")
    return words


# Vector files are compared by what they hold: see test_objects_are_written
@pytest.mark.parametrize(
    "name", [path.stem for path in PIPELINES if "writers.objects" not in path.read_text()]
)
def test_a_ready_pipeline_gives_the_same_bytes(pipeline, environment, town, halves, models, tmp_path, name):
    if name == "tile-index-to-tiles":
        subprocess.run(
            [pdal_env.program(), "tindex", "create", str(halves / "survey.gpkg"), "--stdin", "-f", "GPKG",
             "--lyr_name", "pdal"],
            input="\n".join(map(str, sorted(halves.glob("*.laz")))), text=True, check=True, capture_output=True,
        )  # fmt: skip
    for door in ("stock", "ours"):
        (tmp_path / door).mkdir()
        stages = with_words(name, *_words(name, town, halves, models, tmp_path / door))
        if door == "stock":
            ours = any(stage.get("type") in registry.stages() for stage in stages)
            pipeline(
                stages, *([] if ours else ["--nostream"])
            )  # where PDAL streams, rasters are of other extent
        else:
            ps.Pipeline(stages).execute()
    written = sorted(path.name for path in (tmp_path / "ours").iterdir())
    assert written == sorted(path.name for path in (tmp_path / "stock").iterdir())
    assert written
    for file in written:
        stock, ours = (tmp_path / door / file for door in ("stock", "ours"))
        if name == "copc-to-tiles":  # PDAL 2.2 keeps the octree's record, newer PDAL no order of points
            one, other = laspy.read(stock).points.array, laspy.read(ours).points.array
            if pdal_env.writes_copc():
                one, other = np.sort(one), np.sort(other)
            np.testing.assert_array_equal(one, other)
        else:
            assert_same(stock, ours)


# ---- views -------------------------------------------------------------------------------------------------


def test_points_of_several_readers_see_each_other(pipeline, halves, tmp_path):
    files = [str(halves / "west.laz"), str(halves / "east.laz")]
    for stages in (
        [*files, {"type": "filters.hag_minima"}],
        [
            {"type": "readers.las", "filename": files[0], "tag": "a"},
            {"type": "readers.las", "filename": files[1], "tag": "b"},
            {"type": "filters.hag_minima", "inputs": ["a", "b"]},
        ],
    ):
        pipeline(las(stages, tmp_path / "stock.laz"))
        ps.Pipeline(las(stages, tmp_path / "ours.laz")).execute()
        assert_same(tmp_path / "stock.laz", tmp_path / "ours.laz")


# ---- options, metadata, log --------------------------------------------------------------------------------


def test_options_of_every_pdal_stage(pipeline, town, tmp_path):
    log = tmp_path / "log.txt"
    stage = {"type": "filters.hag_minima", "cell": 10, "where": "X > 500030"}
    stage |= {"user_data": {"a": [1]}, "log": str(log)}
    pipeline(las([str(town), stage], tmp_path / "stock.laz"), "--verbose=4")
    ps.Pipeline(las([str(town), {**stage}], tmp_path / "ours.laz")).execute()
    assert_same(tmp_path / "stock.laz", tmp_path / "ours.laz")
    assert log.exists()


def test_metadata_is_the_report(pipeline, town, tmp_path):
    stages = [str(town), {"type": "filters.hag_minima", "cell": 10}, {"type": "writers.null"}]
    pipeline(stages, f"--metadata={tmp_path / 'm.json'}")
    said = json.loads((tmp_path / "m.json").read_text())["stages"]
    assert "filters.python" not in said
    done = ps.Pipeline(stages)
    done.execute()
    assert said["filters.hag_minima"] == done.metadata["metadata"]["filters.hag_minima"]


def test_an_empty_list_is_none(pipeline, town, tmp_path):
    """PDAL cannot tell an empty list from none given; null, or an empty text, is one."""
    for given, ours in ((None, []), ("", [])):
        files = tmp_path / "stock.txt", tmp_path / "ours.txt"
        for value, run, file in (
            (given, pipeline, files[0]),
            (ours, lambda s: ps.Pipeline(s).execute(), files[1]),
        ):
            stage = {"type": "filters.hag_minima", "ignore": value}
            run([str(town), stage, {"type": "writers.text", "filename": str(file)}])
        assert files[0].read_bytes() == files[1].read_bytes()


# ---- errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"cell": "wide"}, "filters.hag_minima: Invalid value 'wide' for argument 'cell'"),
        ({"sell": 3}, "filters.hag_minima: Unexpected argument 'sell'"),
        ({"cell": -1}, "filters.hag_minima (tag 'h'): option 'cell' must be a number from 0.05"),
        ({"where": "X >"}, "filters.hag_minima (tag 'h'): the 'where' expression"),
        ({"where": "X > 1", "where_merge": False}, "there is no option 'where_merge'"),
        ({"option_file": "nowhere.json"}, "there is no option 'option_file'"),
        ({"horizontal_unit": "furlong"}, "furlong"),
    ],
)
def test_wrong_options(pipeline, town, tmp_path, options, says):
    out = tmp_path / "o.laz"
    done = pipeline(las([str(town), {"type": "filters.hag_minima", "tag": "h", **options}], out), code=1)
    assert says in done.stderr
    assert done.stderr.startswith("PDAL: filters.hag_minima")
    assert not out.exists()
    assert "array" not in done.stderr and "Traceback" not in done.stderr


def test_errors_of_the_work(pipeline, town, models, tmp_path):
    out = tmp_path / "o.laz"
    missing = pipeline(
        las([str(town), {"type": "filters.modelclassifier", "model": str(models / "classes.model")}], out),
        code=1,
    ).stderr
    assert missing.startswith("PDAL: filters.modelclassifier: ")
    assert "filters.hag_morphological" in missing  # the stage that makes it
    required = pipeline(las([str(town), {"type": "filters.modelclassifier"}], out), code=1).stderr
    assert "option 'model' is required" in required
    nan = tmp_path / "nan.txt"
    nan.write_text("X,Y,Z\n1,1,1\nnan,2,2\n")
    reader = {"type": "readers.text", "filename": str(nan)}
    finite = pipeline(las([reader, {"type": "filters.hag_minima"}], out), code=1).stderr
    assert "not finite" in finite and "1 of 2 points" in finite
    assert "numpy" not in missing + required + finite and "of a stage that failed" not in finite
    assert not out.exists()


def test_a_package_that_is_missing(pipeline, environment, town, tmp_path):
    """Without the package, and where it cannot be imported: the cure, not a crash."""
    stages = las([str(town), {"type": "filters.hag_minima"}], tmp_path / "o.laz")
    path = tmp_path / "job.json"
    path.write_text(json.dumps(stages))

    def run(folder):
        done = subprocess.run(
            [pdal_env.program(), "pipeline", str(path)],
            env={**environment, "PYTHONPATH": str(folder)}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 1, (done.returncode, done.stderr)
        return done.stderr

    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "sitecustomize.py").write_text(
        "import sys\nclass Hide:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'pdal_stages':\n            raise ModuleNotFoundError('No module', name=name)\n"
        "sys.meta_path.insert(0, Hide())\n"
    )
    assert "has no package pdal_stages" in (said := run(hidden)) and "pip install pdal-stages" in said
    broken = tmp_path / "broken" / "pdal_stages"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise OSError('cannot open shared object')")
    assert "cannot be imported" in (said := run(broken.parent)) and "cannot open shared object" in said
    (broken / "__init__.py").write_text(  # a package that lacks what the library asks for
        "import sys\nclass Old:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name.startswith('pdal_stages.'):\n            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Old())\n"
    )
    assert "plugin --install" in run(broken.parent)
    assert not (tmp_path / "o.laz").exists()


def test_a_plugin_of_another_version(stock, environment, town, tmp_path, plugin, monkeypatch):
    question = {
        "version": "9.9",
        "digest": "x",
        "stage": "filters.hag_minima",
        "label": "l",
        "step": "prepare",
    }
    module = {"pdalargs": question}
    outs = {}
    assert arrival.arrive(module, {}, outs)
    (leaf,) = module["out_metadata"]["children"]
    assert (
        leaf["name"] == "pdal_stages_error" and "plugin --install" in leaf["value"] and "9.9" in leaf["value"]
    )


def test_without_filters_python(plugin, pdal_program, town, tmp_path):
    """PDAL that has our plugin but not what runs it."""
    path = tmp_path / "job.json"
    path.write_text(json.dumps(las([str(town), {"type": "filters.hag_minima"}], tmp_path / "o.laz")))
    done = subprocess.run(
        [pdal_program, "pipeline", str(path)],
        env={**os.environ, "PDAL_DRIVER_PATH": str(plugin)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "PDAL has no filters.python" in done.stderr and "PDAL_DRIVER_PATH" in done.stderr


# ---- python-pdal, repeated, at the same time ---------------------------------------------------------------


def test_objects_of_python_pdal(python, town):
    said = python(
        "import sys, pdal, numpy as np, pdal_stages as ps\n"
        f"read = pdal.Reader.las({str(town)!r})\n"
        "job = read | pdal.Filter.hag_minima(cell=10) | pdal.Filter.hag_morphological(openings=[5, 17])\n"
        "print(job.execute())\n"
        "ours = read | ps.Filter.hag_minima(cell=10) | ps.Filter.hag_morphological(openings=[5, 17])\n"
        "ours.execute()\n"
        "one, other = job.arrays[0], ours.arrays[0]\n"
        "assert sorted(one.dtype.names) == sorted(other.dtype.names)\n"
        "assert all(np.array_equal(one[name], other[name]) for name in one.dtype.names)\n"
        "print(pdal.Filter.hag_minima.__doc__)\n"
    )
    assert "18034" in said or int(said.split()[0]) > 10000
    assert "coarse" in said


def test_pipelines_of_newer_pdal_have_numbers():
    """PDAL 2.9 writes a stage's options as numbers, truths and lists, older PDAL all as text."""
    text = {"cell": "10", "ignore": "7,withheld", "tag": "h"}
    newer = {"cell": 10, "ignore": [7, "withheld"], "tag": "h"}
    kind = "filters.hag_minima"
    assert arrival._typed({"type": kind, **newer}) == arrival._typed({"type": kind, **text})
    assert arrival._typed({"type": "filters.hag_morphological", "ground": True})["ground"] is True
    assert arrival._typed({"type": "filters.smrf", "cell": 1.5, "window": "18"}) == {
        "type": "filters.smrf", "cell": 1.5, "window": 18,
    }  # fmt: skip


def test_a_notebook_survives_failures(python, town):
    """Fifty failures, each an ordinary exception with our message, then a run that succeeds."""
    said = python(
        "import gc, pdal\n"
        f"read = pdal.Reader.las({str(town)!r})\n"
        "for n in range(50):\n"
        "    job = read | (pdal.Filter.hag_minima(cell=-1) if n % 2 else pdal.Filter.modelclassifier(model='standard'))\n"
        "    try:\n"
        "        job.execute()\n"
        "    except RuntimeError as error:\n"
        "        text = str(error)\n"
        "        assert text.startswith('filters.'), text\n"
        "    else:\n"
        "        raise SystemExit('no failure')\n"
        "    gc.collect()\n"
        "print((read | pdal.Filter.hag_minima()).execute() > 0)\n"
    )
    assert "True" in said


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_ends_pdal_at_once(environment, pdal_program, town, models, tmp_path):
    out = tmp_path / "o.laz"
    stages = [
        str(town),
        {"type": "filters.hag_minima", "cell": 10},
        {"type": "filters.python", "module": "slow", "function": "f",
         "source": "def f(ins, outs):\n    import sys, time\n    print('here', file=sys.__stderr__, flush=True)\n"
                   "    time.sleep(60)\n    return True\n"},
    ]  # fmt: skip
    path = tmp_path / "job.json"
    path.write_text(json.dumps(las(stages, out)))
    running = subprocess.Popen([pdal_program, "pipeline", str(path)], env=environment, stderr=subprocess.PIPE)
    assert running.stderr is not None
    assert running.stderr.readline().strip() == b"here"
    begun = time.monotonic()
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=30) == -signal.SIGINT
    assert time.monotonic() - begun < 10
    running.stderr.close()
    assert not out.exists()


# ---- installing --------------------------------------------------------------------------------------------


def test_install_check_uninstall(tmp_path, plugin, monkeypatch, capsys):
    good, bad = building.check(plugin)
    assert not bad and any("stages in" in line for line in good)
    with monkeypatch.context() as built:
        built.setenv("CXX", "no-such-compiler")
        assert building.check(plugin)[1] == []  # none is needed any more
    folder = tmp_path / "p"
    folder.mkdir()
    assert "not in" in building.check(folder)[1][0]
    for path in plugin.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / building.library_name("filters.hag_minima")).unlink()
    assert "libraries are missing" in building.check(folder)[1][0]
    record = json.loads((folder / building.RECORD).read_text())
    (folder / building.RECORD).write_text(json.dumps({**record, "digest": "old"}))
    assert "out of date" in "".join(building.check(folder)[1])
    (folder / building.RECORD).write_text(json.dumps({**record, "pdal_stages": "0.0.1", "pdal": "1.0.0"}))
    said = "\n".join(building.check(folder)[1])
    assert "of another version" in said and "for another PDAL (found 1.0.0)" in said
    (folder / "libpdal_plugin_filter_former.so").write_text("")
    record["files"] += ["libpdal_plugin_filter_former.so", "../outside.so"]
    (tmp_path / "outside.so").write_text("of somebody else")
    (folder / building.RECORD).write_text(json.dumps(record))
    (folder / "libpdal_plugin_filter_other.so").write_text("of somebody else")
    monkeypatch.setenv("PDAL_DRIVER_PATH", f"{tmp_path}{os.pathsep}{folder}")
    assert building.usual_folder() == folder
    building.uninstall()
    assert [path.name for path in folder.iterdir()] == ["libpdal_plugin_filter_other.so"]
    assert building.uninstall(folder) == []
    assert (tmp_path / "outside.so").exists()


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    _, bad = building.check(tmp_path)
    assert "no C++ compiler" in bad[0] and "apt-get install g++" in bad[0]
    with pytest.raises(ps.StageError, match=r"no C\+\+ compiler"):
        building.install(tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.delenv("CXX")
    monkeypatch.setattr(places, "_PYTHON_FILTER", "libpdal_plugin_filter_none.so")
    with pytest.raises(ps.StageError, match=r"filters\.python is missing"):
        places.plugin_folder()
    monkeypatch.setattr(places, "_library_folder", lambda: tmp_path)
    monkeypatch.setattr(places.sys, "prefix", str(tmp_path))
    if not Path("/usr/include/pdal").exists():
        with pytest.raises(ps.StageError, match=r"headers are missing.*libpdal-dev"):
            places.pdal()
    headers = tmp_path / "include" / "pdal"
    headers.mkdir(parents=True)
    (headers / "Filter.hpp").touch()
    (headers / "pdal_features.hpp").write_text(
        "#define PDAL_VERSION_MAJOR 1\n#define PDAL_VERSION_MINOR 9\n#define PDAL_VERSION_PATCH 0\n"
    )
    monkeypatch.setattr(places, "_library_folder", lambda: headers)
    with pytest.raises(ps.StageError, match="another version than its library"):
        places.pdal()


def test_code_that_does_not_compile_leaves_nothing(tmp_path, monkeypatch):
    source, target = tmp_path / "stage.cpp", tmp_path / "target"
    source.write_text("int broken("), target.mkdir()
    monkeypatch.setattr(building, "SOURCE", source)
    with pytest.raises(ps.StageError, match="does not compile"):
        building.install(target)
    assert not list(target.iterdir())
