"""A file through stages without PDAL's table gives the file that PDAL would write, byte for byte."""

from __future__ import annotations

import json
import logging
import struct

import laspy
import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.las import read_header
from pdal_stages.base.lasrecords import blocks, record_type
from pdal_stages.pipeline import direct, likefile
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.tiling import run_tiled

pytestmark = pytest.mark.pdal
#: Formats whose classes are read by PDAL alone where it splits flags from them.
SPLIT = (0, 1, 2, 3)


def every_value(path, point_format, version, count=120_000, extra=()):
    """A file with every value of every field of 16 bits or less, in more than one chunk of LAZ."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001, 0.001, 0.01], [500_000.0, 5_400_000.0, -0.0]
    for name, kind in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind))
    las = laspy.LasData(header)
    rng = np.random.default_rng(point_format)
    points = np.zeros(count, header.point_format.dtype())
    for name in points.dtype.names:
        if points.dtype[name].kind == "f":
            points[name] = rng.uniform(-1e5, 1e5, count)
        elif points.dtype[name].itemsize <= 2:
            points[name] = (np.arange(count) + rng.integers(0, 9)).astype(points.dtype[name])
            rng.shuffle(points[name])
    for axis in "XYZ":
        points[axis] = rng.integers(0, 60_000 if axis == "Z" else 400_000, count)
    las.points = laspy.ScaleAwarePointRecord(points, header.point_format, header.scales, header.offsets)
    las.write(path)
    return path


def stages_of(source, target, **writer):
    return [
        {"type": "readers.las", "filename": str(source), "use_eb_vlr": True, "tag": "input"},
        {"type": "filters.detachednoise", "where": "Z > 3"},
        {"type": "filters.multiscalefeatures", "neighborhoods": "k5", "feature_set": "Linearity"},
        {"type": "writers.las", "filename": str(target), "forward": "all", **writer},
    ]


def ran(monkeypatch, stages, within=True):
    """Run a pipeline; whether it ran without PDAL's table, and its metadata."""
    taken = []
    real = direct.execute

    def execute(given):
        taken.append(False)
        found = real(given)
        taken[-1] = True
        return found

    with monkeypatch.context() as patched:
        patched.setattr(direct, "execute", execute)
        if not within:
            patched.setattr(direct, "may_run", lambda stages: False)
        pipeline = Pipeline(stages)
        count = pipeline.execute(arrays=False)
    return bool(taken and taken[0]), count, pipeline


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    "point_format, version",
    [(0, "1.2"), (1, "1.2"), (2, "1.3"), (3, "1.4"), (6, "1.4"), (7, "1.4"), (8, "1.4")],
)
def test_the_file_is_the_one_that_pdal_writes(tmp_path, monkeypatch, point_format, version, suffix):
    extra = [("Mine", "f4"), ("Other", "u2")] if point_format != 2 else []
    source = every_value(tmp_path / f"in.{suffix}", point_format, version, extra=extra)
    writer = {
        "extra_dims": "Linearity_k5=float"
        + "".join(f",{n}={'float' if k == 'f4' else 'uint16'}" for n, k in extra)
    }
    old, new = tmp_path / "old" / f"out.{suffix}", tmp_path / "new" / f"out.{suffix}"
    for path in (old, new):
        path.parent.mkdir()
    with_table, count, before = ran(monkeypatch, stages_of(source, old, **writer), within=False)
    without, again, after = ran(monkeypatch, stages_of(source, new, **writer))
    assert not with_table and count == again == 120_000
    if not (point_format in SPLIT and pdal_env.splits_class_flags()):
        assert without
    assert old.read_bytes() == new.read_bytes()
    # What it says is the same too, but for the names.
    texts = [json.dumps(p.metadata).replace(str(path), "out") for p, path in ((before, old), (after, new))]
    assert texts[0] == texts[1]
    assert before.log_lines == after.log_lines and before.messages == after.messages


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_records_are_those_that_laspy_reads(tmp_path, suffix):
    path = every_value(tmp_path / f"a.{suffix}", 7, "1.4", 210_000, extra=[("Mine", "f8")])
    header = read_header(path)
    dtype = record_type(path, header)
    expected = laspy.read(path).points.array
    found = np.concatenate(list(blocks(path, header, dtype)))
    assert found.dtype.names == expected.dtype.names
    assert np.array_equal(found.view(np.uint8), expected.view(np.uint8))
    few = np.concatenate(list(blocks(path, header, dtype, ["Z", "classification"], count=60_001)))
    assert len(few) == 60_001
    for name in ("X", "Y", "Z", "classification", "bit_fields"):
        assert np.array_equal(few[name], expected[name][:60_001])


def small(tmp_path, write_las, count=3000, **options):
    rng = np.random.default_rng(3)
    arrays = {axis: rng.uniform(0, 30, count) for axis in "XYZ"}
    return write_las(tmp_path / "small.las", arrays, point_format=6, **options)


@pytest.mark.parametrize(
    "writer",
    [
        {"forward": "header"},  # other scales
        {"offset_x": "auto"},
        {"where": "Z > 3"},
        {"extra_dims": "Linearity_k5=double"},  # as another type
        {"minor_version": 4, "dataformat_id": 7},
        {"minor_version": 2, "dataformat_id": 1},
    ],
    ids=str,
)
def test_what_looks_at_all_points_or_changes_them_is_left_to_pdal(tmp_path, write_las, monkeypatch, writer):
    if "where" in writer and pdal_env.version() < (2, 9, 0):
        pytest.skip("PDAL >= 2.9 knows 'where' in writers")
    source = small(tmp_path, write_las)
    out = {}
    for within in (False, True):
        target = tmp_path / f"{within}" / "out.las"
        target.parent.mkdir()
        direct_way, _, _ = ran(monkeypatch, stages_of(source, target, **writer), within=within)
        assert not direct_way
        out[within] = target.read_bytes()
    assert out[True] == out[False]


def test_a_pipeline_of_other_stages_is_left_to_pdal(tmp_path, write_las):
    source = str(small(tmp_path, write_las))
    ours = stages_of(source, tmp_path / "out.las")
    lowered = [
        Pipeline(stages).lowered.stages
        for stages in (
            [ours[0], {"type": "filters.stats"}, *ours[1:]],
            [ours[0], ours[0] | {"tag": "again"}, *ours[1:]],
            [{**ours[0], "count": 10}, *ours[1:]],
            ours[:-1],
            [*ours, {**ours[-1], "filename": str(tmp_path / "two.las")}],
            [*ours[:-1], {"type": "writers.text", "filename": str(tmp_path / "out.txt")}],
        )
    ]
    assert not any(map(direct.may_run, lowered))
    assert direct.may_run(Pipeline(ours).lowered.stages)


def test_points_are_written_by_pdal_where_ours_would_be_others(tmp_path, write_las, monkeypatch):
    source = small(tmp_path, write_las)
    wanted, target = tmp_path / "wanted.las", tmp_path / "out.las"
    ran(monkeypatch, stages_of(source, wanted), within=False)
    real = likefile._Totals.put
    monkeypatch.setattr(
        likefile._Totals, "put", lambda self, head, end: real(self, head, end).replace(b"\1", b"\2")
    )
    without, _, pipeline = ran(monkeypatch, stages_of(source, target))
    assert not without and target.read_bytes() == wanted.read_bytes()
    assert [len(each) for _, each in pipeline.reports] == [1, 1]


def test_scaled_extra_dimensions_and_coordinates_beyond_floats_are_left_to_pdal(tmp_path, monkeypatch):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.01] * 3, [0.0] * 3
    header.add_extra_dim(
        laspy.ExtraBytesParams("Mine", "u2", scales=np.array([0.1]), offsets=np.array([0.0]))
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.random.default_rng(0).uniform(0, 30, (3, 500))
    las["Mine"] = np.arange(500) / 10
    source = tmp_path / "a.las"
    las.write(source)
    assert record_type(source, read_header(source)) is None
    without, _, _ = ran(monkeypatch, stages_of(source, tmp_path / "b.las", extra_dims="all"))
    assert not without and np.allclose(laspy.read(tmp_path / "b.las")["Mine"], np.arange(500) / 10)
    far = read_header(source)
    assert direct._comes_back(far)
    assert not direct._comes_back(type(far)(**{**far.__dict__, "scales": (1e-9,) * 3, "offsets": (6e6,) * 3}))


@pytest.mark.parametrize("place", ["first", "last"])
def test_damaged_points_are_refused_where_pdal_does_so_too(tmp_path, monkeypatch, place):
    """Also where the damage is in a part of the points that stages do not look at; newer PDAL takes more for points."""
    source = every_value(tmp_path / "a.laz", 6, "1.4", 60_000)
    raw = bytearray(source.read_bytes())
    at = len(raw) // 3 if place == "first" else len(raw) - 3000
    raw[at : at + 2000] = b"\xff" * 2000
    source.write_bytes(raw)
    ends = []
    for within in (False, True):
        target = tmp_path / f"{within}.laz"
        try:
            ran(monkeypatch, stages_of(source, target), within=within)
            ends.append("written")  # what no decoder notices, each reads as other points
        except StageError as error:
            ends.append(error.what)
            assert not target.exists()
    assert ends[1] in (ends[0], "the LAS file is damaged: its points cannot be decoded")


def test_points_that_can_be_read_only_in_part_are_read_by_pdal_in_the_end(tmp_path, monkeypatch):
    source = every_value(tmp_path / "a.laz", 6, "1.4", 60_000)
    wanted, target = tmp_path / "wanted.laz", tmp_path / "out.laz"
    ran(monkeypatch, stages_of(source, wanted), within=False)
    real, calls = direct.blocks, []

    def failing(*given, **more):
        calls.append(more)
        if len(calls) > 1:
            yield next(real(*given, **more))[:1000]
            raise StageError("the points cannot be read")
        yield from real(*given, **more)

    monkeypatch.setattr(direct, "blocks", failing)
    without, _, _ = ran(monkeypatch, stages_of(source, target))
    assert len(calls) == 2 and not without and target.read_bytes() == wanted.read_bytes()


def test_without_room_for_temporary_files_pdal_runs(tmp_path, write_las, monkeypatch):
    source = small(tmp_path, write_las)

    def none(**given):
        raise PermissionError("no")

    monkeypatch.setattr(direct, "TemporaryDirectory", none)
    without, count, _ = ran(monkeypatch, stages_of(source, tmp_path / "out.las"))
    assert not without and count == 3000


def test_a_stage_s_error_is_its_own(tmp_path, write_las, monkeypatch):
    source = small(tmp_path, write_las)
    stages = stages_of(source, tmp_path / "out.las")
    stages[2]["where"] = "Mine > 1"
    said = []
    for within in (False, True):
        with pytest.raises(StageError) as caught:
            ran(monkeypatch, stages, within=within)
        said.append(str(caught.value))
    assert said[0] == said[1] and "'Mine'" in said[0] and not (tmp_path / "out.las").exists()


def test_who_wants_arrays_or_pdal_s_whole_log_gets_them(tmp_path, write_las, monkeypatch):
    source = small(tmp_path, write_las)
    monkeypatch.setattr(direct, "execute", lambda stages: pytest.fail("PDAL's table is wanted"))
    pipeline = Pipeline(stages_of(source, tmp_path / "out.las"))
    pipeline.execute()
    assert len(pipeline.arrays[0]) == 3000
    Pipeline(stages_of(source, tmp_path / "out.las")).execute(arrays=False, loglevel=logging.INFO)


def test_a_stream_that_ends_too_early_is_refused_by_name(tmp_path, write_las):
    """Of a LAZ file of the old formats: newer PDAL decodes anything, without an error."""
    rng = np.random.default_rng(2)
    source = write_las(tmp_path / "a.laz", {name: rng.random(9_000) * 90 for name in "XYZ"}, point_format=1)
    raw = bytearray(source.read_bytes())
    middle = len(raw) // 2
    raw[middle : middle + 400] = rng.integers(0, 256, 400, np.uint8).tobytes()
    source.write_bytes(raw)
    heights = {"type": "filters.hag_minima"}
    target = tmp_path / "out.laz"
    run = Pipeline([str(source), heights, {"type": "writers.las", "filename": str(target), "forward": "all"}])
    try:
        run.execute(arrays=False)
    except StageError as error:
        assert str(source) in str(error) and "damaged" in str(error) and error.cure
        assert not target.exists()
    else:  # this damage happens to be a stream of points: they lie anywhere
        assert any("beyond the box" in warning for warning in run.messages)


@pytest.mark.parametrize("tiles", [False, True])
def test_points_beyond_the_header_s_box_are_said(tmp_path, write_las, tiles):
    rng = np.random.default_rng(3)
    source = write_las(tmp_path / "a.laz", {name: rng.random(3_000) * 40 for name in "XYZ"}, point_format=1)
    stages = [
        str(source),
        {"type": "filters.hag_minima"},
        {"type": "writers.las", "filename": str(tmp_path / "out.laz"), "forward": "all"},
    ]

    def said():
        if tiles:
            return run_tiled(stages, 25, workers=0).messages
        run = Pipeline(stages)
        run.execute(arrays=False)
        return run.messages

    assert not any("beyond the box" in line for line in said())
    raw = bytearray(source.read_bytes())
    struct.pack_into("<d", raw, 179, 10.0)  # the largest x
    source.write_bytes(raw)
    (line,) = (line for line in said() if "beyond the box" in line)
    assert str(source) in line and "the header says x 0" in line and " to 10," in line
