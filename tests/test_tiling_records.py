"""Records of jobs come back from the work folder as they were saved, and damaged ones not at all."""

from __future__ import annotations

import json
from dataclasses import fields

import numpy as np
import pytest

from pdal_stages.base.messages import Message, Topic
from pdal_stages.pipeline.workers import Cost
from pdal_stages.surfaces.cells import TileFigures
from pdal_stages.tiling.inputs import CloudIndex, InputSource
from pdal_stages.tiling.jobs import InputJob, OutputJob, Store, TileJob, messages_of
from pdal_stages.tiling.options import TileGrid
from pdal_stages.tiling.records import (
    FilesRecord,
    OutputRecord,
    RunGrids,
    SharedPoints,
    TileRecord,
    WrittenFile,
    describe_written,
)
from pdal_stages.tiling.tile_records import LonePoint

FILE = WrittenFile("out/a.laz", 1000, 1_700_000_000_123_456_789, "ab12")
TILE = TileRecord(
    points=10,
    read=25,
    halo_m=31.25,
    short=False,
    widened=True,
    dropped=1,
    classes={"2": 6, "6": 4},
    messages=[Message("a message", Topic.METERS_ASSUMED, "filters.a"), Message("another")],
    point_counts={"filters.a.kept": 3},
    shared=[SharedPoints("a.laz", "b.laz", 2)],
)
RECORDS = [
    FilesRecord([FILE]),
    OutputRecord([FILE], 10, {"2": 10}),
    OutputRecord([]),
    TILE,
    TileRecord(**{**vars(TILE), "outputs": [FILE], "written": 9}),
    TileFigures([1, 2, 3, 4], 5, lone=[LonePoint("a.laz", 1.5, 2.5)]),
    RunGrids(250.0, 12.5, 3),
]


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_records_come_back_from_json(record):
    saved = json.loads(json.dumps({**record.to_json(), "fingerprint": "x", "seconds": 1.0}))
    again = type(record).from_json(saved)
    assert again == record
    kinds = [
        [type(value) for value in (getattr(r, f.name) for f in fields(r))] for r in (again, record)
    ]
    assert kinds[0] == kinds[1]
    with pytest.raises(TypeError):
        type(record).from_json({})


def test_an_index_comes_back_without_its_copy():
    cells = np.array([[0, 1, 0, 7], [2, 3, 7, 5]])
    squares, grid = np.array([[0, 0, 12]]), TileGrid(25.0, 3.5)
    box = (0.5, 1.5, 70.25, 90.0)
    index = CloudIndex(12, box, [(0, 0, 7), (1, 1, 5)], cells, grid, "ab12", 17, squares, "copy")
    again = CloudIndex.from_json(json.loads(json.dumps(index.to_json())))
    assert again.copy == "" and again.grid == index.grid and again.tiles == index.tiles
    assert (again.count, again.box, again.digest, again.changed_ns) == (12, box, "ab12", 17)
    assert np.array_equal(again.cells, cells) and np.array_equal(again.squares, squares)


def test_a_job_is_kept_by_the_next_run(tmp_path):
    out = tmp_path / "out.laz"
    out.write_bytes(b"points")
    record = OutputRecord(describe_written([out]), 10, {"2": 10})
    source, cost = InputSource("in.laz", {}), Cost(1.5, 2.5, 300.0)
    first = OutputJob("a", source=source, digest="d", state="done", record=record, cost=cost)
    with Store(tmp_path) as store:
        store.finish(first.name, first.to_json(), first.digest)
        store.finish("run", RunGrids(250.0, 0.0, 3).to_json())
        again = OutputJob("a", source=source, digest="d")
        assert store.finished("a", "other") is None
        again.keep(store.finished("a", "d"))
        assert (again.state, again.record, again.cost) == ("kept", record, cost)
        assert again.to_dict() == {**first.to_dict(), "state": "kept"}
        assert store.grids() == RunGrids(250.0, 0.0, 3) and not store.edited("a")
        assert store.left_over([]) == [str(out)] and store.left_over([str(out)]) == []
        out.write_bytes(b"edited points")
        assert store.finished("a", "d") is None and store.edited("a") == [str(out)]


def test_a_record_that_is_not_what_was_saved_is_none(tmp_path):
    """It is valid, and names the same digest, but a value is another."""
    with Store(tmp_path) as store:
        store.finish("a", TILE.to_json(), "d")
        saved = store.record("a", "d")
        assert TileRecord.from_json(saved) == TILE and store.record("a", "e") is None
        path = store.kept / "a.json"
        for name, value in (("points", 11), ("classes", {}), ("fingerprint", "e"), ("more", 1)):
            path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
            assert store.record("a", "d") is store.record("a", "e") is None
            store.finish("a", TILE.to_json(), "d")


@pytest.mark.parametrize(
    "text", ["", "[]", '{"outputs": 5}', '{"outputs": [[1]]}', '{"outputs": {}}']
)
def test_damaged_records_are_none(tmp_path, text):
    with Store(tmp_path) as store:
        for name in ("a", "run"):
            (store.kept / f"{name}.json").write_text(text)
        assert store.finished("a", "d") is None and store.grids() is None
        assert store.edited("a") == store.left_over([]) == []
        for job in (TileJob("a"), InputJob("a", source=InputSource("in.laz", {}))):
            job.keep(store.note("a"))
            assert job.state == "kept" and job.record is None and job.to_dict() == {"state": "kept"}


def jobs_with(messages_of_each, state="done"):
    """Return jobs of tiles that have messages."""
    return [
        TileJob(
            str(n),
            state=state,
            record=TileRecord(**{**vars(TILE), "messages": messages, "shared": []}),
        )
        for n, messages in enumerate(messages_of_each)
    ]


def shown_messages(tiles, rounds=(), inputs=()):
    """Return the messages of a run whose tiles and earlier rounds have some."""
    return messages_of(jobs_with(tiles), [*map(jobs_with, rounds)], inputs, 1000)


def test_messages_of_tiles_come_once_frequent_ones_first():
    rare, often = Message("rare", place="filters.a"), Message("often", place="filters.a")
    assert shown_messages([[rare, often], [often]]) == [
        "filters.a: often (2 tiles)",
        "filters.a: rare (1 tile)",
    ]
    several = Message("often")
    assert shown_messages([[often], [several]]) == ["often (1 tile)"]
    assert shown_messages([[often]], inputs=[Message("odd", Topic.INPUT)]) == [
        "odd",
        "filters.a: often (1 tile)",
    ]


def test_that_nothing_matches_is_told_where_it_holds_for_all_tiles():
    nothing = Message("no points", Topic.NOTHING_MATCHES)
    assert shown_messages([[nothing], []]) == [] and shown_messages([[nothing], [nothing]]) == [
        "no points (2 tiles)"
    ]
    assert shown_messages([[], []], [[[nothing]], [[], []]]) == ["no points (1 tile)"]
    assert shown_messages([[], []], [[[nothing], []]]) == []
    kept = jobs_with([[]], state="kept")
    assert messages_of([*jobs_with([[nothing]]), *kept], [], [], 1000) == []


def test_what_the_inputs_tell_better_is_left_out():
    assumed = Message("meters", Topic.METERS_ASSUMED, "filters.a")
    assert shown_messages([[assumed]]) == ["filters.a: meters (1 tile)"]
    one_has_none = Message("b.laz has none", Topic.NO_REFERENCE)
    assert shown_messages([[assumed]], inputs=[one_has_none]) == ["b.laz has none"]
