"""The commands of docs/operator.md, one after the other, on a generated town."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.cli import main
from pdal_stages.synthetic import write_town

PAGE = Path(__file__).resolve().parent.parent / "docs" / "operator.md"


@pytest.mark.pdal
def test_the_hour_of_an_operator(tmp_path, monkeypatch, capsys):
    pyogrio, shapely = pytest.importorskip("pyogrio"), pytest.importorskip("shapely")
    monkeypatch.chdir(tmp_path)
    write_town(ps.make_town(64.0, 4.0, seed=5, progress=False), tmp_path / "truth.laz")
    truth = laspy.read("truth.laz")
    raw = laspy.read("truth.laz")
    raw.classification[:] = 0
    raw.write("raw.laz")
    text = "\n".join(re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))
    lines = [
        line.split("#")[0].strip() for line in text.splitlines() if line.startswith("pdal-stages")
    ]
    assert [line.split()[1] for line in lines] == [
        "classify", "review", "corrections", "train", "classify", "review", "accuracy", "classify",
    ]  # fmt: skip
    for line in lines:
        words = shlex.split(line)[1:]
        if words[0] == "corrections":
            # What the operator does: the worst patches become as they are in truth, and are marked as done.
            about, _, geometry, fields = pyogrio.raw.read("review.gpkg", layer="patches")
            columns = dict(zip(about["fields"], fields, strict=True))
            columns["done"] = (columns["rank"] <= 6).astype(np.int32)
            las = laspy.read("classified.laz")
            x, y = np.asarray(las.x), np.asarray(las.y)
            seen = np.zeros(len(x), bool)
            for shape in shapely.from_wkb(geometry)[columns["done"] == 1]:
                seen |= shapely.intersects_xy(shape, x, y)
            known = np.isin(truth.classification, (2, 5, 6))
            las.classification[seen & known] = np.asarray(truth.classification)[seen & known]
            las.points = las.points[np.arange(len(x))[::-1]]
            las.write("corrected.laz")
            pyogrio.raw.write("review.gpkg", geometry, list(columns.values()), list(columns), layer="patches",
                              driver="GPKG", geometry_type="MultiPolygon", crs=about["crs"], append=False)  # fmt: skip
        assert main(words) == 0, (line, capsys.readouterr().err)
    checked = np.asarray(laspy.read("checked.laz")["Checked"]) == 1
    assert (checked >= seen).all() and seen.sum() > 100
    for name in ("second.laz", "sure.laz"):  # what a person decided stays
        last, kept = laspy.read(name), laspy.read("checked.laz")
        assert (last.classification[checked] == kept.classification[checked]).all()
        assert (last["Checked"] == checked).all() and (last["Reliability"][checked] == 1).all()
    assert "to be right in 90 % of the points of each class" in capsys.readouterr().err
