"""A stage that fails, again and again in one process: an exception that reached filters.python would end it."""

from __future__ import annotations

import os

import pytest
from processes import python

import pdal_stages as ps
from pdal_stages.pipeline import runtime

pytestmark = pytest.mark.pdal

CLOUD = """
import gc, json, sys
import numpy as np
import pdal, pdal_stages as ps

rng = np.random.default_rng(0)
for name in ("good.txt", "bad.txt"):
    rows = [f"{x:.2f},{y:.2f},{x:.2f},2" for x, y in rng.uniform(0, 30, (100, 2))]
    rows[7] = rows[7] if name == "good.txt" else "nan,1,1,2"
    with open(name, "w") as file:
        file.write("\\n".join(["X,Y,Z,Classification", *rows, ""]))
good, bad = ({"type": "readers.text", "filename": name} for name in ("good.txt", "bad.txt"))
failures = 0
"""
#: Each fails once per turn, for several reasons, and counts the failures whose message is ours.
OBJECTS = """
kept = pdal.Reader(**bad) | ps.Filter.hag_minima(tag="kept")
for turn in range(12):
    for pipeline, says in (
        (pdal.Reader(**bad) | ps.Filter.hag_minima(), "not finite"),
        (kept, "(tag 'kept')"),
        (pdal.Reader(**good) | ps.Filter.accuracy(merge=False), "'Reference' is missing"),
    ):
        try:
            pipeline.execute()
        except RuntimeError as error:
            failures += says in str(error)
        assert sys.stdout is sys.__stdout__
    gc.collect()
    (pdal.Reader(**good) | ps.Filter.hag_minima()).execute()
assert failures == 36, failures
"""
RUNNER = """
for turn in range(12):
    for stages, says in (
        ([bad, {"type": "filters.hag_minima"}], "not finite"),
        ([good, {"type": "filters.accuracy"}], "'Reference' is missing"),
        ([good, {"type": "filters.hag_minima", "where": "Height > 2"}], "'Height'"),
    ):
        try:
            ps.run_pipeline(stages)
        except ps.StageError as error:
            failures += says in str(error)
        assert sys.stdout is sys.__stdout__
    gc.collect()
    ps.run_pipeline([good, {"type": "filters.hag_minima"}])
assert failures == 36, failures
"""
TEXTS = """
for turn in range(12):
    stages = ps.Pipeline([good, {"type": "filters.hag_minima"}]).expanded.stages
    stages[1]["pdalargs"]["options"]["cell"] = "wide " + str(turn)
    try:
        pdal.Pipeline(json.dumps(stages)).execute()
    except RuntimeError as error:
        failures += "must be a number" in str(error)
    gc.collect()
assert failures == 12, failures
"""


#: Ctrl-C in a notebook: PDAL at work or a stage of ours, the process goes on with KeyboardInterrupt.
INTERRUPTED = """
import os, signal, subprocess
big = {"type": "readers.faux", "count": 1_000_000, "mode": "ramp", "bounds": "([0,30],[0,30],[0,3])"}
ps.run_pipeline([good, {"type": "filters.hag_minima"}])  # Numba is imported, which Ctrl-C would break off
for wait in (0.1, 0.3, 1):
    kill = subprocess.Popen(["sh", "-c", f"sleep {wait}; kill -INT {os.getpid()}"])
    try:
        ps.run_pipeline([big, {"type": "filters.hag_minima"}])
        kill.wait()
        signal.pause()
    except KeyboardInterrupt:
        failures += 1
    kill.wait()
assert failures == 3, failures
ps.run_pipeline([good, {"type": "filters.hag_minima"}])
"""
UNIX = pytest.mark.skipif(os.name == "nt", reason="signals of Unix")


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(OBJECTS, id="python-pdal objects"),
        pytest.param(RUNNER, id="the runner"),
        pytest.param(TEXTS, id="expanded JSON"),
        pytest.param(INTERRUPTED, id="Ctrl-C", marks=UNIX),
    ],
)
def test_failing_pipelines(tmp_path, body):
    script = CLOUD + body + "gc.collect()\nprint('survived')\n"
    assert python(script, cwd=tmp_path) == "survived\n"


def test_stages_that_pdal_leaves_out(tmp_path, monkeypatch):
    """Newer PDAL does not call a filter where there are no points: what a stage says of that is said all the same."""
    text = tmp_path / "in.txt"
    text.write_text("X,Y,Z,Classification\n1,1,1,2\n2,2,2,2\n")
    none = [
        {"type": "readers.text", "filename": str(text)},
        {"type": "filters.range", "limits": "Z[5:]"},
    ]
    train = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m")}
    for stop in (False, True):
        if stop:  # as if it had not been called
            monkeypatch.setattr(runtime, "_run_interruptible", lambda *_: None)
        job = ps.run_pipeline(
            [*none, {"type": "filters.hag_minima"}, {"type": "filters.multiscalefeatures"}]
        )
        assert job.reports[0][1][0].figures["points"] == 0
        with pytest.raises(ps.StageError, match=r"writers\.classifiermodel.*no points to train on"):
            ps.run_pipeline([*none, {"type": "filters.hag_minima"}, train])
        with pytest.raises(ps.StageError, match="no points to compare"):
            ps.run_pipeline([*none, {"type": "filters.accuracy", "reference": "Classification"}])
