"""Our stages as PDAL's own, run by the program `pdal` and by python-pdal's own objects.

The plugin is compiled once into a folder of the tests' own, which PDAL is told of, so that what is installed does not
matter.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import laspy
import processes
import pytest
from processes import ended

import pdal_stages as ps
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.json_source import apply_overrides, parse_overrides
from pdal_stages.plugin import calls, declarations, install
from pdal_stages.stages.registry import stage_type, stage_types

pytestmark = pytest.mark.pdal
PIPELINES = sorted((Path(__file__).resolve().parent.parent / "pipelines").glob("*.json"))


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """The folder of the plugin."""
    folder = tmp_path_factory.mktemp("plugin") / "not" / "there"
    install.install(folder)
    return folder


@pytest.fixture(scope="module")
def environment(plugin):
    """A process's environment in which PDAL finds the plugin."""
    folders = [str(plugin), *os.environ.get("PDAL_DRIVER_PATH", "").split(os.pathsep)]
    folders.append(str(install.plugin_folder()))
    return {**os.environ, "PDAL_DRIVER_PATH": os.pathsep.join(filter(None, folders))}


@pytest.fixture(scope="module")
def stock(environment, pdal_program, tmp_path_factory):
    """Run the program `pdal`; fails unless its exit code is `code`."""

    def run(*words, code=0, **how):
        done = ended(pdal_program, *words, env=environment, **how)
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
        path.write_text(json.dumps(pdal_env.for_this_version(pdal_env.with_types(stages))))
        return stock("pipeline", path, *words, **how)

    return run


@pytest.fixture(scope="module")
def python(environment):
    """Run Python code in another process, in which python-pdal finds the plugin; what it prints."""

    return lambda code, **more: processes.python(code, env={**environment, **more})


def with_words(name, *words):
    """A ready pipeline with overrides."""
    stages = json.loads(next(path for path in PIPELINES if path.stem == name).read_text())
    return apply_overrides(stages, parse_overrides(words)[0])


def assert_same(one, other):
    assert one.read_bytes() == other.read_bytes(), one.name


def las(stages, output):
    return [
        *stages,
        {"type": "writers.las", "filename": str(output), "forward": "all", "extra_dims": "all"},
    ]


# ---- what PDAL knows of the stages -------------------------------------------------------------------------


def test_every_stage_is_listed_with_its_options(stock):
    listed = {
        entry["name"]: entry["description"]
        for entry in json.loads(stock("--drivers", "--showjson").stdout)
    }
    for name, kind in stage_types().items():
        assert listed[name] == kind.summary
        described = stock("--options", name).stdout
        for option in kind.all_options():
            assert f"\n  {option.name}" in described, (name, option.name)


# ---- the same bytes: uncompressed, since LAZ of LAS 1.4 is compressed by laspy before PDAL 2.3 ---------------

EVERY = [
    {"type": "filters.detachednoise"},
    {"type": "filters.hag_minima", "cell": 10, "resolution": 0.25, "ignore": ["7", "withheld"]},
    {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]},
    {
        "type": "filters.multiscalefeatures",
        "neighborhoods": ["c1", "kopt(10,30)"],
        "feature_set": "covariance",
    },
    {"type": "filters.bridges", "code": 18},
    {"type": "filters.objects", "building_height": 3},
    {"type": "filters.accuracy", "reference": "Classification", "print": False},
]


def test_all_stages_give_the_same_bytes(pipeline, ready_town, tmp_path):
    """Those of ready pipelines run there; filters.polygons, of a vector file, is not compared."""
    ready = {stage["type"] for path in PIPELINES for stage in json.loads(path.read_text())}
    elsewhere = {stage["type"] for stage in EVERY} | ready | {"writers.objects", "filters.polygons"}
    others = [
        {"type": name, **stage_type(name).example}
        for name in stage_types()
        if name not in elsewhere
    ]
    every = [*EVERY, *others]
    pipeline(las([str(ready_town), *every], tmp_path / "stock.las"))
    ps.Pipeline(las([str(ready_town), *every], tmp_path / "ours.las")).execute()
    assert_same(tmp_path / "stock.las", tmp_path / "ours.las")


@pytest.mark.parametrize("as_list", [True, False])
@pytest.mark.parametrize("door", ["stock", "python-pdal", "pdal-stages"])
def test_one_spelling_of_polygons(pipeline, python, ready_town, tmp_path, door, as_list):
    """A comma in FILE=CODE:FROM,FROM means the same at all doors, in a list and in a text."""
    pytest.importorskip("pyogrio")
    before = laspy.read(ready_town)
    (x0, x1), (y0, y1) = ((float(v.min()), float(v.max())) for v in (before.x, before.y))
    corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    shape = {"type": "Polygon", "coordinates": [corners]}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    features = [{"type": "Feature", "properties": {}, "geometry": shape}]
    lake = tmp_path / "lake.geojson"
    lake.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    polygons = f"{lake}=9:2,6"
    stage = {"type": "filters.polygons", "polygons": [polygons] if as_list else polygons}
    stages = las([str(ready_town), stage], tmp_path / "o.laz")
    if door == "stock":
        pipeline(stages)
    elif door == "python-pdal":
        python(f"import pdal, json; pdal.Pipeline(json.dumps({stages!r})).execute()")
    else:
        ps.run_pipeline(stages)
    codes, old = laspy.read(tmp_path / "o.laz").classification, before.classification
    assert set(old[codes == 9].tolist()) == {2, 6} and not {2, 6} & set(codes.tolist())


def test_objects_are_written(pipeline, ready_town, tmp_path):
    """The program of PDAL 2.2 has another GEOS and GDAL than Shapely and pyogrio bring: they work in a process apart."""
    pytest.importorskip("pyogrio")
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
    for name, run in (("stock", pipeline), ("ours", lambda stages: ps.Pipeline(stages).execute())):
        writer = {"type": "writers.objects", "filename": str(tmp_path / f"{name}.geojson")}
        run([str(ready_town), heights, writer])
    layers = sorted(path.name.removeprefix("ours") for path in tmp_path.glob("ours*.geojson"))
    assert "_buildings.geojson" in layers
    for layer in layers:
        stock, ours = (
            json.loads((tmp_path / f"{name}{layer}").read_text()) for name in ("stock", "ours")
        )
        assert stock["features"] == ours["features"]
        assert stock["features"] or layer != "_buildings.geojson"


READY = {
    "train": ["--stage.model.filename=m.model"],
    "evaluate": ["--stage.classifier.model=MODEL", "--stage.output.filename=o.las", "--stage.accuracy.json=a.json",
                 "--stage.accuracy.html=a.html"],
    "tiles-to-tiles": ["--stage.classifier.model=MODEL", "--stage.output.filename=o_#.las", "--stage.tiles.length=40"],
}  # fmt: skip


@pytest.mark.parametrize("name", READY)
def test_a_ready_pipeline_gives_the_same_bytes(
    pipeline, ready_town, quick, ready_halves, ready_models, tmp_path, name, monkeypatch
):
    for door in ("stock", "ours"):
        (tmp_path / door).mkdir()
        source = ready_halves / "*.laz" if name == "tiles-to-tiles" else ready_town
        words = [
            f"--stage.input.filename={source}",
            *READY[name],
            *(quick if name == "train" else ()),
        ]
        model = str(ready_models / "classes.model")
        stages = with_words(name, *(word.replace("MODEL", model) for word in words))
        if door == "stock":
            pipeline(stages, cwd=tmp_path / door)
        else:
            monkeypatch.chdir(tmp_path / door)
            ps.Pipeline(stages).execute()
    written = sorted(path.name for path in (tmp_path / "ours").iterdir())
    assert written and written == sorted(path.name for path in (tmp_path / "stock").iterdir())
    for file in written:
        assert_same(tmp_path / "stock" / file, tmp_path / "ours" / file)


# ---- views -------------------------------------------------------------------------------------------------


def test_points_of_several_readers_see_each_other(pipeline, ready_halves, tmp_path):
    files, accuracy = (
        [str(ready_halves / f"{side}.laz") for side in ("west", "east")],
        tmp_path / "a.json",
    )
    for stages in (
        [*files, {"type": "filters.hag_minima"}],
        [
            {"type": "readers.las", "filename": files[0], "tag": "a"},
            {"type": "readers.las", "filename": files[1], "tag": "b"},
            {"type": "filters.hag_minima", "inputs": ["a", "b"]},
        ],
        [
            files[0],
            {"type": "filters.splitter", "length": 30},
            {**EVERY[-1], "json": str(accuracy)},
        ],
    ):
        pipeline(las(stages, tmp_path / "stock.las"))
        stock = accuracy.read_text() if accuracy.exists() else ""
        count = ps.Pipeline(las(stages, tmp_path / "ours.las")).execute()
        assert_same(tmp_path / "stock.las", tmp_path / "ours.las")
    merged = json.loads(stock)  # one file of all points
    assert (
        stock == accuracy.read_text() and merged["points"] + merged["left_out"]["points"] == count
    )


# ---- options, metadata, log --------------------------------------------------------------------------------


def test_options_of_every_pdal_stage(pipeline, ready_town, tmp_path):
    log = tmp_path / "log.txt"
    stage = {"type": "filters.hag_minima", "cell": 10, "where": "X > 500030"}
    stage |= {"user_data": {"a": [1]}, "log": str(log)}
    pipeline(las([str(ready_town), stage], tmp_path / "stock.las"), "--verbose=4")
    ps.Pipeline(las([str(ready_town), {**stage}], tmp_path / "ours.las")).execute()
    assert_same(tmp_path / "stock.las", tmp_path / "ours.las")
    assert log.exists()


def test_metadata_is_the_report(pipeline, ready_town, tmp_path):
    stages = [str(ready_town), {"type": "filters.hag_minima", "cell": 10}, {"type": "writers.null"}]
    pipeline(stages, f"--metadata={tmp_path / 'm.json'}")
    stages_metadata = json.loads((tmp_path / "m.json").read_text())["stages"]
    assert "filters.python" not in stages_metadata
    done = ps.Pipeline(stages)
    done.execute()
    assert stages_metadata["filters.hag_minima"] == done.metadata["metadata"]["filters.hag_minima"]


# ---- errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"cell": "wide"}, "filters.hag_minima: Invalid value 'wide' for argument 'cell'"),
        ({"cell": -1}, "filters.hag_minima (tag 'h'): option 'cell' must be a number from 0.05"),
        ({"option_file": "nowhere.json"}, "there is no option 'option_file'"),
    ],
)
def test_wrong_options(pipeline, ready_town, tmp_path, options, says):
    out = tmp_path / "o.laz"
    heights = {"type": "filters.hag_minima", "tag": "h", **options}
    done = pipeline(las([str(ready_town), heights], out), code=1)
    assert says in done.stderr
    assert done.stderr.startswith("PDAL: filters.hag_minima")
    assert not out.exists()
    assert "array" not in done.stderr and "Traceback" not in done.stderr


def test_errors_of_the_work(pipeline, ready_town, ready_models, tmp_path):
    out = tmp_path / "o.laz"
    classifier = {"type": "filters.modelclassifier"}
    model = {"model": str(ready_models / "classes.model")}
    missing = pipeline(las([str(ready_town), {**classifier, **model}], out), code=1).stderr
    assert missing.startswith("PDAL: filters.modelclassifier: ")
    assert "filters.hag_morphological" in missing  # the stage that makes it
    nan = tmp_path / "nan.txt"
    nan.write_text("X,Y,Z\n1,1,1\nnan,2,2\n")
    reader = {"type": "readers.text", "filename": str(nan)}
    finite = pipeline(las([reader, {"type": "filters.hag_minima"}], out), code=1).stderr
    assert "not finite" in finite and "1 of 2 points" in finite
    assert "numpy" not in missing + finite and "of a stage that failed" not in finite
    assert not out.exists()


def test_a_package_that_is_missing(pipeline, environment, ready_town, tmp_path):
    """Without the package, and where it cannot be imported: the cure, not a crash."""
    stages = las([str(ready_town), {"type": "filters.hag_minima"}], tmp_path / "o.laz")
    path = tmp_path / "job.json"
    path.write_text(json.dumps(stages))

    def run(folder):
        done = ended(
            pdal_env.program(), "pipeline", path, env={**environment, "PYTHONPATH": str(folder)}
        )
        assert done.returncode == 1, (done.returncode, done.stderr)
        return done.stderr

    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "sitecustomize.py").write_text(
        "import sys\nclass Hide:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'pdal_stages':\n            raise ModuleNotFoundError('No module', name=name)\n"
        "sys.meta_path.insert(0, Hide())\n"
    )
    assert (
        "has no package pdal_stages" in (errors := run(hidden))
        and "pip install pdal-stages" in errors
    )
    broken = tmp_path / "broken" / "pdal_stages"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise OSError('cannot open shared object')")
    assert (
        "cannot be imported" in (errors := run(broken.parent))
        and "cannot open shared object" in errors
    )
    assert not (tmp_path / "o.laz").exists()


def test_a_plugin_of_another_version():
    question = {"version": "9.9", "digest": "x", "stage": "filters.hag_minima"}
    empty: dict = {"pdalargs": {}}
    assert calls.answer(empty, {}, {}) and "KeyError" in str(empty["out_metadata"])
    module = {"pdalargs": {**question, "label": "l", "step": "prepare"}}
    assert calls.answer(module, {}, {})
    (leaf,) = module["out_metadata"]["children"]
    assert leaf["name"] == "pdal_stages_error" and "9.9" in leaf["value"]
    assert "plugin --install" in leaf["value"]


def test_the_digest_is_of_what_pdal_sees():
    """A help text may be corrected without building the plugin again; names, types and defaults may not."""
    kind = stage_types()["filters.hag_minima"]
    options, digest = kind.all_options(), declarations.digest(kind)

    def changed(**how):
        new = (*options[:1], replace(options[1], **how), *options[2:])
        words = {"all_options": classmethod(lambda cls: new), "summary": "Other words"}
        return declarations.digest(type("Changed", (kind,), words))

    assert changed(help="Other words") == digest
    different = {changed(name="other"), changed(kind="string"), changed(default=7.5)}
    assert len(different | {digest}) == 4


def test_without_filters_python(plugin, pdal_program, ready_town, tmp_path):
    """PDAL that has our plugin but not what runs it."""
    path = tmp_path / "job.json"
    path.write_text(
        json.dumps(las([str(ready_town), {"type": "filters.hag_minima"}], tmp_path / "o.laz"))
    )
    done = ended(pdal_program, "pipeline", path, env={"PDAL_DRIVER_PATH": str(plugin)})
    assert done.returncode == 1
    assert "PDAL has no filters.python" in done.stderr and "PDAL_DRIVER_PATH" in done.stderr


# ---- python-pdal, repeated, at the same time ---------------------------------------------------------------


def test_objects_of_python_pdal(python, ready_town):
    output = python(
        "import sys, pdal, numpy as np, pdal_stages as ps\n"
        f"read = pdal.Reader.las({str(ready_town)!r})\n"
        "job = read | pdal.Filter.hag_minima(cell=10) | pdal.Filter.hag_morphological(openings=[5, 17])\n"
        "print(job.execute())\n"
        "ours = read | ps.Filter.hag_minima(cell=10) | ps.Filter.hag_morphological(openings=[5, 17])\n"
        "ours.execute()\n"
        "one, other = job.arrays[0], ours.arrays[0]\n"
        "assert sorted(one.dtype.names) == sorted(other.dtype.names)\n"
        "assert all(np.array_equal(one[name], other[name]) for name in one.dtype.names)\n"
        "print(pdal.Filter.hag_minima.__doc__)\n"
    )
    assert int(output.split()[0]) == laspy.read(ready_town).header.point_count
    assert "coarse" in output


def test_a_notebook_survives_failures(python, ready_town):
    """Failures, each an ordinary exception with our message, then a run that succeeds."""
    output = python(
        "import gc, pdal\n"
        f"read = pdal.Reader.las({str(ready_town)!r})\n"
        "for n in range(10):\n"
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
    assert "True" in output


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_ends_pdal_at_once(environment, pdal_program, ready_town, tmp_path):
    out = tmp_path / "o.laz"
    stages = [
        str(ready_town),
        {"type": "filters.hag_minima", "cell": 10},
        {"type": "filters.python", "module": "slow", "function": "f",
         "source": "def f(ins, outs):\n    import sys, time\n    print('here', file=sys.__stderr__, flush=True)\n"
                   "    time.sleep(60)\n    return True\n"},
    ]  # fmt: skip
    path = tmp_path / "job.json"
    path.write_text(json.dumps(las(stages, out)))
    running = subprocess.Popen(
        [pdal_program, "pipeline", str(path)], env=environment, stderr=subprocess.PIPE
    )
    assert running.stderr is not None
    assert running.stderr.readline().strip() == b"here"
    begun = time.monotonic()
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=30) == -signal.SIGINT
    assert time.monotonic() - begun < 10
    running.stderr.close()
    assert not out.exists()


# ---- installing --------------------------------------------------------------------------------------------


def test_install_check_uninstall(tmp_path, plugin, monkeypatch):
    good, bad = install.check(plugin)
    assert not bad and any("stages in" in line for line in good)
    with monkeypatch.context() as built:
        built.setenv("CXX", "no-such-compiler")
        assert install.check(plugin)[1] == []  # none is needed any more
    folder = tmp_path / "p"
    folder.mkdir()
    assert "not in" in install.check(folder)[1][0]
    names = install.libraries()
    for name in [*names[1:], "libpdal_plugin_filter_other.so"]:
        (folder / name).write_text("")
    assert f"missing {names[0]}" in install.check(folder)[1][0]
    monkeypatch.setenv("PDAL_DRIVER_PATH", f"{tmp_path}{os.pathsep}{folder}")
    assert install.usual_folder() == folder
    install.uninstall()
    assert [path.name for path in folder.iterdir()] == ["libpdal_plugin_filter_other.so"]
    assert install.uninstall(folder) == []


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    _, bad = install.check(tmp_path)
    assert "no C++ compiler" in bad[0] and "apt-get install g++" in bad[0]
    with pytest.raises(ps.StageError, match=r"no C\+\+ compiler"):
        install.install(tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("CXX", "c++ --no-such-flag")
    with pytest.raises(ps.StageError, match="does not compile"):
        install.install(tmp_path)
    assert not list(tmp_path.iterdir())
