"""Errors of our stages in stock ``pdal pipeline``: its exit code is 1, and the message is ours;
arrays of odd kinds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from processes import ended
from robustness_kit import HAG
from stage_message import message_of

import pdal_stages as ps

pytestmark = pytest.mark.pdal


def test_errors_through_stock_pdal(tmp_path, pdal_program, cloud, model):
    text, copy = tmp_path / "nan.txt", tmp_path / "m.model"
    text.write_text("X,Y,Z\n1,1,1\nnan,2,2\n")
    copy.write_bytes(model.read_bytes())
    wide = json.loads(ps.Pipeline([str(cloud), HAG]).json)
    wide["pipeline"][1]["pdalargs"]["options"]["cell"] = "wide"
    jobs = {
        "1 of 2 points": ps.Pipeline([{"type": "readers.text", "filename": str(text)}, HAG]).json,
        "must be a number": json.dumps(wide),
        "not a model file": ps.Pipeline(
            [str(cloud), HAG, {"type": "filters.modelclassifier", "model": str(copy)}]
        ).json,
    }
    copy.write_bytes(b"")
    for says, pipeline in jobs.items():
        (tmp_path / "plain.json").write_text(pipeline)
        done = ended(pdal_program, "pipeline", tmp_path / "plain.json")
        text = done.stdout + done.stderr
        assert done.returncode == 1, (
            done.returncode,
            text,
        )  # not a signal: PDAL's own filters abort on NaN
        assert says in text and message_of(text), text


def test_arrays_of_python_pdal(pdal_module):
    x = np.zeros(100, [("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("Intensity", "<u2")])
    x["X"], x["Y"] = np.random.default_rng(0).uniform(0, 30, (2, 100))
    for array in (x[::2], np.frombuffer(x.tobytes(), x.dtype)):  # with gaps, read-only
        pipeline = ps.Filter.hag_minima()
        pipeline.inputs = [array]
        try:
            count = pipeline.execute()
        except (ValueError, RuntimeError, BufferError) as error:
            assert "internal" not in str(error)
            continue
        assert count == len(array) and np.array_equal(pipeline.arrays[0]["X"], array["X"])
        heights = ps.hag_minima(array["X"], array["Y"], array["Z"])
        assert np.allclose(pipeline.arrays[0]["HeightAboveGround"], heights)
