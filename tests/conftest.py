"""Fixtures every test shares, and the rule on skipping.

Fixtures
    data_dir       folder of the real labeled clouds (skips where absent)
    pdal_program   path of a ``pdal`` program that has ``filters.python``
    pdal_module    python-pdal, imported
    random_cloud   function: ``random_cloud(n, seed=0, ...) -> (n, 3) float64``
    write_las      function: ``write_las(path, arrays, point_format=3, ...) -> Path``

Markers
    ``@pytest.mark.pdal``  needs PDAL with ``filters.python``; the test skips (or fails, see below)
                           without it
    ``@pytest.mark.data``  needs the real clouds; the test skips without them
    ``@pytest.mark.slow``  more than about ten seconds; ``-m "not slow"`` leaves it out

Environment
    PDAL_STAGES_DATA     folder of the real clouds; default ``../shared/data`` beside the checkout
    PDAL_STAGES_REQUIRE  comma-separated: ``pdal`` makes a skip for want of PDAL a failure, ``data``
                         one for want of the real clouds, ``torch`` and ``qgis`` one for want of PyTorch or QGIS
                         (continuous integration sets ``pdal``, and ``torch`` where it can be
                         installed)
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from block_scene import ground_and_block
from hypothesis import HealthCheck, settings

# nohup and background jobs of scripts ignore signals, and so would all that tests start and
# interrupt.
for _ignored, _usual in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    _number = getattr(signal, _ignored, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)

# A slow or busy machine is no failure. Continuous integration draws the same examples every time,
# so that a change is judged by what it changed.
settings.register_profile(
    "any machine",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="CI" in os.environ,
)
settings.load_profile("any machine")

# What runs note of their pace is not the user's.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="pdal-stages-cache-of-tests-")

ROOT = Path(__file__).resolve().parent.parent
REQUIRED = {
    word.strip() for word in os.environ.get("PDAL_STAGES_REQUIRE", "").split(",") if word.strip()
}
NO_DATA = "real clouds not found"
NO_TORCH = "PyTorch is not installed"
NO_QGIS = "QGIS is not installed"

# A skip reason that names PDAL itself. "PDAL 2.5" or "PDAL >= 2.5" asks for a version, which is
# another matter, and PDAL_STAGES_DATA is another word.
WANT_OF_PDAL = re.compile(
    r"(\bpdal\b(?!\s*(>=|<=|>|<|\d))|filters\.python|readers\.numpy)", re.IGNORECASE
)


# ---- what is there ---------------------------------------------------------------------------------------


@cache
def find_pdal() -> tuple[Path | None, str]:
    """Find a ``pdal`` program with ``filters.python``, in this environment, then on PATH."""
    seen = []
    names = [
        Path(sys.prefix) / "bin" / "pdal",
        Path(sys.executable).parent / "pdal",
        shutil.which("pdal"),
    ]
    for program in dict.fromkeys(Path(name) for name in names if name):
        if not os.access(program, os.X_OK):
            continue
        answer = subprocess.run(
            [program, "--drivers"],
            capture_output=True,
            text=True,
            timeout=120,
            stdin=subprocess.DEVNULL,
        )
        if answer.returncode == 0 and "filters.python" in answer.stdout:
            return program, ""
        lines = answer.stderr.strip().splitlines()[-1:] or ["no filters.python among its drivers"]
        seen.append(f"{program}: {lines[0]}")
    return None, "PDAL with filters.python not found (" + (
        "; ".join(seen) or "no pdal program on PATH"
    ) + ")"


@cache
def find_data() -> tuple[Path | None, str]:
    """Find the folder of real clouds."""
    named = os.environ.get("PDAL_STAGES_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if folder.is_dir():
        return folder, ""
    if named:
        return None, f"{NO_DATA}: PDAL_STAGES_DATA names {named}, which is no folder"
    return None, f"{NO_DATA}: set PDAL_STAGES_DATA to their folder"


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip marked tests before their fixtures are built."""
    if item.get_closest_marker("data") and find_data()[0] is None:
        pytest.skip(find_data()[1])
    if item.get_closest_marker("pdal") and find_pdal()[0] is None:
        pytest.skip(find_pdal()[1])


# ---- skips that must not happen --------------------------------------------------------------------------


def _forbidden(report) -> str | None:
    """Return the reason of a skip that PDAL_STAGES_REQUIRE does not allow, else None."""
    if not report.skipped or hasattr(report, "wasxfail"):
        return None
    reason = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
    if reason.startswith(f"Skipped: {NO_DATA}"):
        return reason if "data" in REQUIRED else None
    for missing, name in ((NO_TORCH, "torch"), (NO_QGIS, "qgis")):
        if missing in reason:
            return reason if name in REQUIRED else None
    return reason if "pdal" in REQUIRED and WANT_OF_PDAL.search(reason) else None


def _fail(report) -> None:
    reason = _forbidden(report)
    if reason:
        report.outcome = "failed"
        report.longrepr = (
            f"PDAL_STAGES_REQUIRE={','.join(sorted(REQUIRED))} forbids this skip. {reason}"
        )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport():
    outcome = yield
    _fail(outcome.get_result())


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report():
    outcome = yield
    _fail(outcome.get_result())


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--all-pairs", action="store_true", help="all rows of the covering array of test_pairs.py"
    )


def pytest_report_header() -> list[str]:
    program, why = find_pdal()
    data, no = find_data()
    strict = ", ".join(sorted(REQUIRED)) or "nothing"
    return [
        f"pdal: {program or why}",
        f"real clouds: {data or no}",
        f"must not skip for want of: {strict}",
    ]


# ---- fixtures --------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real labeled clouds (montpellier/, delft/, oakland/, isprs_filter/, units/)."""
    folder, why = find_data()
    if folder is None:
        pytest.skip(why)
    return folder


@pytest.fixture(scope="session")
def pdal_program() -> Path:
    """Path of a ``pdal`` program whose ``filters.python`` runs this interpreter's packages."""
    program, why = find_pdal()
    if program is None:
        pytest.skip(why)
    return program


@pytest.fixture(scope="session")
def pdal_module(pdal_program):
    """python-pdal."""
    return pytest.importorskip("pdal")


@pytest.fixture(scope="session")
def random_cloud():
    """Return a function that makes uniform random clouds.

    ``random_cloud(n, seed=0, extent=(20, 20, 5), origin=(0, 0, 0), decimals=3) -> (n, 3) float64``;
    ``origin=(500000, 6000000, 100)`` gives UTM-sized coordinates, ``decimals=None`` leaves them
    unrounded.
    """

    def make(n, seed=0, extent=(20.0, 20.0, 5.0), origin=(0.0, 0.0, 0.0), decimals=3):
        xyz = np.random.default_rng(seed).random((n, 3)) * extent + origin
        return xyz if decimals is None else np.round(xyz, decimals)

    return make


# PDAL's names of LAS dimensions -> laspy's
LASPY_NAMES = {
    "Intensity": "intensity",
    "ReturnNumber": "return_number",
    "NumberOfReturns": "number_of_returns",
    "ScanDirectionFlag": "scan_direction_flag",
    "EdgeOfFlightLine": "edge_of_flight_line",
    "Classification": "classification",
    "Synthetic": "synthetic",
    "KeyPoint": "key_point",
    "Withheld": "withheld",
    "Overlap": "overlap",
    "ScanChannel": "scanner_channel",
    "UserData": "user_data",
    "PointSourceId": "point_source_id",
    "GpsTime": "gps_time",
    "Red": "red",
    "Green": "green",
    "Blue": "blue",
    "Infrared": "nir",
}


@pytest.fixture(scope="session")
def write_las():
    """Return a function that writes LAS or LAZ with laspy, independent of PDAL.

    ``write_las(path, arrays, point_format=3, minor_version=None, scale=0.001, offset=None,
    wkt=None)`` returns the path. ``arrays`` maps PDAL's dimension names (``X``, ``Y``, ``Z``,
    ``Classification``, ...) to equally long arrays; a name LAS does not know becomes an extra-bytes
    dimension of the array's type. ``ScanAngleRank`` is in degrees in every format.
    ``minor_version`` defaults to 2 for formats 0-3, else 4. ``offset`` defaults to the floored
    minimum. ``wkt`` adds an OGC WKT record and sets the header's WKT bit. A path ending in .laz is
    compressed.
    """
    import laspy

    def write(path, arrays, point_format=3, minor_version=None, scale=0.001, offset=None, wkt=None):
        arrays = {name: np.asarray(values) for name, values in arrays.items()}
        if minor_version is None:
            minor_version = 2 if point_format <= 3 else 4
        header = laspy.LasHeader(point_format=point_format, version=f"1.{minor_version}")
        xyz = np.column_stack([arrays.pop(name) for name in "XYZ"]).astype(np.float64)
        header.scales = np.full(3, scale)
        if offset is None:
            offset = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
        header.offsets = np.asarray(offset, dtype=np.float64)
        if wkt:
            header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
            header.global_encoding.wkt = True
        standard = set(header.point_format.dimension_names)
        extra = {n: a for n, a in arrays.items() if n not in LASPY_NAMES and n != "ScanAngleRank"}
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name=n, type=a.dtype) for n, a in extra.items()]
        )
        las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header))
        las.x, las.y, las.z = xyz.T
        for name, values in arrays.items():
            if name == "ScanAngleRank" and "scan_angle" in standard:
                las["scan_angle"] = np.round(values / 0.006)
            elif name == "ScanAngleRank":
                las["scan_angle_rank"] = values
            elif name in extra:
                las[name] = values
            elif LASPY_NAMES[name] in standard:
                las[LASPY_NAMES[name]] = values
            else:
                raise ValueError(f"point format {point_format} has no {name}")
        las.write(str(path))
        return Path(path)

    return write


@pytest.fixture
def run(capsys):
    """Return a function ``run(*words) -> (exit code, output, errors)`` of our command."""
    from pdal_stages.cli import main

    def go(*words):
        code = main([str(word) for word in words])
        return code, *capsys.readouterr()

    return go


@pytest.fixture
def run_job(tmp_path, run):
    """Return ``run_job(stages, *words, command="pipeline")``, which writes a pipeline first."""

    def go(stages, *words, command="pipeline"):
        path = tmp_path / "job.json"
        path.write_text(
            json.dumps([stage if isinstance(stage, dict) else str(stage) for stage in stages])
        )
        return run(command, path, *words)

    return go


# ---- models ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def wide_model(tmp_path_factory, write_las) -> Path:
    """A model of ground and of a class above 31, which tells them by Z: of points some 100 m up."""
    import pdal_stages as ps

    folder = tmp_path_factory.mktemp("wide")
    source = write_las(folder / "train.las", ground_and_block(2000, at=(0, 0, 100)), point_format=6)
    writer = {"type": "writers.classifiermodel", "filename": str(folder / "wide.model")}
    writer |= {"neighborhoods": "c1", "feature_set": "geometric", "dimensions": ["Z"], "count": 100}
    ps.run_pipeline([str(source), {**writer, "trees": 5, "classes": {"2": 2, "6": "64 Shed"}}])
    return folder / "wide.model"


# ---- what the ready pipelines read and apply ---------------------------------------------------------------


@pytest.fixture(scope="session")
def quick() -> list[str]:
    """Words for those that train: a smaller model than the files say; the stages are the same."""
    return [
        "--stage.model.neighborhoods=c2,s2",
        "--stage.model.count=300",
        "--stage.model.trees=10",
    ]


@pytest.fixture(scope="session")
def ready_town(tmp_path_factory) -> Path:
    """A small town, whole."""
    from pdal_stages.synthetic import make_town, write_town

    path = tmp_path_factory.mktemp("town") / "town.laz"
    write_town(make_town(60, 5, seed=3, progress=False), path)
    return path


@pytest.fixture(scope="session")
def ready_halves(ready_town, tmp_path_factory) -> Path:
    """A folder with the town in two files."""
    import laspy

    folder, las = tmp_path_factory.mktemp("halves"), laspy.read(ready_town)
    west = np.asarray(las.x) <= 500_030
    for name, side in (("west", west), ("east", ~west)):
        las[side].write(folder / f"{name}.laz")
    return folder


@pytest.fixture(scope="session")
def ready_models(ready_town, quick, tmp_path_factory) -> Path:
    """A folder with the models that ready pipelines apply, trained by those that train."""
    from pdal_stages.pipeline.json_source import parse_overrides
    from pdal_stages.pipeline.run import Pipeline

    folder = tmp_path_factory.mktemp("models")
    for name, file in (
        ("train", "classes"),
        ("train-binary", "buildings"),
        ("train-on-smrf-ground", "smrf"),
    ):
        words = [
            f"--stage.input.filename={ready_town}",
            f"--stage.model.filename={folder / file}.model",
            *quick,
        ]
        Pipeline(ROOT / "pipelines" / f"{name}.json", parse_overrides(words)[0]).execute()
    return folder
