"""Errors of our stages in stock ``pdal pipeline``: its exit code is 1, and the message is ours."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from stage_message import message_of

import pdal_stages as ps

pytestmark = pytest.mark.pdal
HAG = {"type": "filters.hag_minima"}


def stock(pdal_program, folder, pipeline, *says):
    plain = folder / "plain.json"
    plain.write_text(pipeline)
    done = subprocess.run([pdal_program, "pipeline", plain], capture_output=True, text=True, timeout=300)
    text = done.stdout + done.stderr
    assert done.returncode == 1, (done.returncode, text)  # not a signal: PDAL's own filters abort on NaN
    for word in says:
        assert word in text, (word, text)
    assert message_of(text), text


def test_errors_through_stock_pdal(tmp_path, pdal_program, cloud, model):
    text = tmp_path / "nan.txt"
    text.write_text("X,Y,Z\n1,1,1\nnan,2,2\n")
    stock(pdal_program, tmp_path, ps.Pipeline([{"type": "readers.text", "filename": str(text)}, HAG]).json,
          "not finite", "1 of 2 points")  # fmt: skip
    judge = ps.Pipeline([str(cloud), {"type": "filters.accuracy", "tag": "judge"}]).json
    stock(
        pdal_program,
        tmp_path,
        judge,
        "filters.accuracy (tag",
        "is missing",
    )
    plain = json.loads(ps.Pipeline([str(cloud), HAG]).json)
    plain["pipeline"][1]["pdalargs"]["options"]["cell"] = "wide"
    stock(pdal_program, tmp_path, json.dumps(plain), "must be a number")
    copy = tmp_path / "m.model"
    copy.write_bytes(model.read_bytes())
    classify = ps.Pipeline([str(cloud), HAG, {"type": "filters.modelclassifier", "model": str(copy)}]).json
    copy.write_bytes(b"")
    stock(pdal_program, tmp_path, classify, "not a model file")


def test_arrays_of_python_pdal(pdal_module):
    """Arrays of odd kinds, given to PDAL from Python."""
    import pdal

    x = np.zeros(100, [("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("Intensity", "<u2")])
    x["X"], x["Y"] = np.random.default_rng(0).uniform(0, 30, (2, 100))
    for case, array in {
        "an array with gaps (every second point)": x[::2],
        "an array that is read-only": np.frombuffer(x.tobytes(), x.dtype),
    }.items():
        pipeline = ps.Filter.hag_minima()
        pipeline.inputs = [array]
        try:
            count = pipeline.execute()
        except (ValueError, RuntimeError, BufferError) as error:
            assert "internal" not in str(error)
            continue
        assert count == len(array)
        assert np.array_equal(pipeline.arrays[0]["X"], array["X"]), case
        assert np.allclose(
            pipeline.arrays[0]["HeightAboveGround"], ps.hag_minima(array["X"], array["Y"], array["Z"])
        )
    assert pdal
