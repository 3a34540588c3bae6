"""Outputs of files that are alike: what is written without PDAL is what PDAL writes, byte for byte."""

from __future__ import annotations

import errno
import filecmp
import os
from dataclasses import replace

import laspy
import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.synthetic.townfile import wkt
from pdal_stages.tiling import alike, extract
from pdal_stages.tiling.file_task import FileTask
from pdal_stages.tiling.kept import save_arrays
from pdal_stages.tiling.sources import InputSource

pytestmark = pytest.mark.pdal
FILES = 5


@pytest.fixture
def tasks(tmp_path, write_las, monkeypatch):
    """A function that makes tasks of like files: of a format, with what stages made of their points."""
    monkeypatch.setattr(alike, "_known", type(alike._known)())

    def make(suffix, point_format, *, out="laz", dropped=0, minor=None, **writer):
        rng = np.random.default_rng(point_format)
        made = []
        for number in range(FILES):
            count = 40 + 25 * number
            arrays = {name: rng.random(count) * 50 + number for name in "XYZ"}
            for name, most in (("Intensity", 2**16), ("UserData", 256), ("PointSourceId", 2**16)):
                arrays[name] = rng.integers(0, most, count)
            arrays["ReturnNumber"] = rng.integers(1, 6, count)
            arrays["NumberOfReturns"] = rng.integers(1, 6, count)
            arrays["Withheld"] = rng.integers(0, 2, count)
            arrays |= {
                "Kept": rng.integers(0, 99, count, np.int16),
                "Reliability": rng.random(count, np.float32),
            }
            path = write_las(
                tmp_path / f"in{number}.{suffix}",
                arrays,
                point_format,
                minor,
                offset=(0, 0, 7),
                wkt=wkt("EPSG:25832"),
            )
            source = InputSource(str(path), {"type": "readers.las", "use_eb_vlr": True}, "las")
            index = np.sort(rng.permutation(count)[: count - dropped])
            values = {
                "Classification": rng.integers(0, 30, len(index)).astype(np.uint8),
                "Reliability": rng.random(len(index), np.float32),
                "HeightAboveGround": rng.random(len(index), np.float32),
            }
            content = {f"{source.key}/index": index, f"{source.key}/core": np.array(count)}
            content |= {f"{source.key}/dim/{name}": column for name, column in values.items()}
            (tmp_path / "scratch").mkdir(exist_ok=True)
            save_arrays(tmp_path / f"tile{number}.npz", content, str(tmp_path / "scratch"))
            tail = [{"type": "writers.las", "filename": f"#.{out}", "forward": "all", **writer}]
            beside = {"HeightAboveGround": "float", "Reliability": "float"}
            results = [str(tmp_path / f"tile{number}.npz")]
            output = str(tmp_path / f"out{number}.{out}")
            meanings = {"Reliability": "probability of class"}
            made.append(
                FileTask(source, count, results, tail, beside, [output], str(tmp_path / "scratch"), meanings)
            )
        return made

    return make


def _without_pdal(tasks, monkeypatch):
    """Run tasks; the numbers of those that PDAL did not write."""
    found = []
    with_pdal = FileTask._write_with_pdal

    def counted(self, *rest):
        found.append(self)
        return with_pdal(self, *rest)

    monkeypatch.setattr(FileTask, "_write_with_pdal", counted)
    records = [task.run() for task in tasks]
    monkeypatch.setattr(FileTask, "_write_with_pdal", with_pdal)
    return [number for number, task in enumerate(tasks) if task not in found], records


def _by_pdal(task, monkeypatch):
    """The output as PDAL writes it."""
    with monkeypatch.context() as context:
        context.setattr(alike, "kind_of", lambda *rest: None)
        named = replace(task, outputs=[task.outputs[0].replace("/out", "/pdal")])
        return named.outputs[0], named.run()


@pytest.mark.parametrize(
    "suffix, point_format, made",
    [
        ("las", 6, {"out": "las"}),
        ("laz", 6, {"dropped": 3}),
        ("laz", 7, {"out": "las"}),
        ("las", 8, {}),
        ("las", 1, {"out": "las"}),
        ("laz", 3, {"out": "las", "dropped": 2}),
        ("las", 3, {"out": "las", "minor": 4}),
        ("laz", 0, {"out": "las"}),
    ],
)
def test_what_is_written_without_pdal_is_what_pdal_writes(tasks, monkeypatch, suffix, point_format, made):
    these = tasks(suffix, point_format, **made)
    without, records = _without_pdal(these, monkeypatch)
    pdal_is_new = alike_needs_pdal(these)
    assert without == ([] if pdal_is_new else [2, 3, 4])
    for task, record in zip(these, records, strict=True):
        expected, of_pdal = _by_pdal(task, monkeypatch)
        assert filecmp.cmp(task.outputs[0], expected, shallow=False)
        assert record["classes"] == of_pdal["classes"] and record["written"] == of_pdal["written"]
        assert len(laspy.read(task.outputs[0])) == record["written"]
    assert not os.listdir(these[0].scratch)


def alike_needs_pdal(tasks) -> bool:
    """Whether this PDAL writes what cannot be told: it compresses by itself, or parts classes from flags."""
    from pdal_stages.pipeline import pdal as pdal_env

    return pdal_env.version() >= (2, 3, 0) and not any(
        isinstance(way, alike._Way) for way in alike._known.values()
    )


def test_other_writers_are_pdals(tasks, monkeypatch):
    without, _ = _without_pdal(tasks("las", 6, forward="vlr"), monkeypatch)
    assert not without and not alike._known


def test_a_writer_with_ways_of_its_own_stays(tasks, monkeypatch):
    """One that a few real points do not give away, but random ones do: user data above 250 come out as 250."""
    from pdal_stages.tiling import file_task

    tail = file_task.run_tail

    def lower(readers, new, *rest):
        las = laspy.read(readers[0]["filename"])
        las.user_data = np.minimum(las.user_data, 250)
        las.write(readers[0]["filename"])
        return tail(readers, new, *rest)

    these = tasks("las", 6)
    for task in these:
        las = laspy.read(task.source.path)
        las.user_data = las.user_data // 2
        las.write(task.source.path)
    monkeypatch.setattr(file_task, "run_tail", lower)
    without, _ = _without_pdal(these, monkeypatch)
    assert not without and list(alike._known.values()) == [False]


def test_another_kind_is_learned_anew(tasks, monkeypatch):
    these = tasks("las", 6)
    las = laspy.read(these[3].source.path)
    las.header.system_identifier = "another"
    las.write(these[3].source.path)
    without, _ = _without_pdal(these, monkeypatch)
    assert without == ([] if alike_needs_pdal(these) else [2, 4])
    assert laspy.read(these[3].outputs[0]).header.system_identifier == "another"


def test_nothing_is_left_of_what_could_not_be_written(tasks, monkeypatch):
    these = tasks("las", 6, out="las")
    for task in these[:2]:
        task.run()
    assert isinstance(next(iter(alike._known.values())), alike._Way)

    def full(number):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(alike.os, "fsync", full)
    with pytest.raises(StageError, match="could not be written") as failed:
        these[2].run()
    assert "Make room" in str(failed.value)
    assert not os.path.exists(these[2].outputs[0])


def test_a_file_that_changed_is_pdals_to_tell(tasks):
    these = tasks("las", 6)
    for task in these[:2]:
        task.run()
    las = laspy.read(these[2].source.path)
    las.points = las.points[:-1]
    las.write(these[2].source.path)
    with pytest.raises(StageError, match="points of"):
        these[2].run()
    assert not os.path.exists(these[2].outputs[0])


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [0, 3, 6, 8])
def test_small_files_are_read_as_laspy_reads_them(tmp_path, random_cloud, write_las, suffix, point_format):
    arrays = dict(zip("XYZ", random_cloud(500, origin=(5e5, 6e6, 0)).T, strict=True))
    arrays |= {"Intensity": np.arange(500), "Height": np.random.default_rng(0).random(500, np.float32)}
    path = str(write_las(tmp_path / f"a.{suffix}", arrays, point_format))
    las = laspy.read(path)
    assert extract.read_small(path, 499) is None
    found = extract.read_small(path, 500)
    assert found.array.dtype == las.points.array.dtype and found.array.tobytes() == las.points.array.tobytes()
    assert np.array_equal(found.x, las.x) and np.array_equal(found.y, las.y)
    assert extract.records_of(path, "", 500).tobytes() == las.points.array.tobytes()
    with open(path, "r+b") as file:
        file.truncate(os.path.getsize(path) - 30)
    assert suffix == "laz" or extract.read_small(path, 500) is None
