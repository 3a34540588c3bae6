"""Points in text files: what PDAL would misread is refused; LAS files hold their coordinates."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.text_points import check_text
from pdal_stages.cli import main

GOOD = "X,Y,Z\n1.5,2.25,3\n4,5e1,6\n"


def text(tmp_path, content, name="in.csv"):
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    return path


@pytest.mark.parametrize("wrong", ["1,9", "1.5abc", "0x10", "1'234.5", "", "1_000", "--1"])
def test_what_is_no_number_is_refused(tmp_path, capsys, wrong):
    path = text(tmp_path, f"X;Y;Z\n1;2;3\n\n4;{wrong};6\n")
    for command in (["classify", str(path), str(tmp_path / "o.las")],):
        assert main(command) == 1
        said = capsys.readouterr().err
        assert "in.csv" in said and "line 4" in said and (wrong in said or not wrong)
    assert not (tmp_path / "o.las").exists()


@pytest.mark.parametrize("header", ["\ufeffX,Y,Z", "// X,Y,Z", "#X,Y,Z"])
def test_headers_of_other_programs_are_refused_with_the_cure(tmp_path, header):
    path = text(tmp_path, GOOD.replace("X,Y,Z", header))
    with pytest.raises(StageError, match=r"--readers\.text\.skip=1"):
        check_text(str(path), {})
    assert check_text(str(path), {"skip": 1, "header": "X,Y,Z"}).count == 2


def test_lines_of_another_length_are_refused(tmp_path):
    with pytest.raises(StageError, match=r"line 3: 2 fields, 3 dimensions"):
        check_text(str(text(tmp_path, "X,Y,Z\n1,2,3\n4,5\n")), {})


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_separators(tmp_path, separator):
    path = text(tmp_path, GOOD.replace(",", separator))
    assert check_text(str(path), {}).count == 2
    quoted = GOOD.replace("X,Y,Z", '"X","Y","Z"')
    assert check_text(str(text(tmp_path, quoted, "q.csv")), {}).decimals == {"X": 1, "Y": 2, "Z": 0}


@pytest.mark.pdal
@pytest.mark.parametrize("decimals", [0, 2, 3, 6])
def test_las_holds_the_coordinates(tmp_path, decimals):
    """25 million meters from the origin, in steps as fine as the text has them."""
    rng = np.random.default_rng(decimals)
    steps = rng.integers(0, 2000, (500, 3)) + np.array([25_496_500, 6_670_000, 0]) * 10**decimals
    rows = [
        ",".join(
            f"{value // 10**decimals}.{value % 10**decimals:0{decimals or 1}d}" for value in row
        )
        for row in steps.tolist()
    ]
    path = text(tmp_path, "X,Y,Z\n" + "\n".join(rows) + "\n")
    assert main(["classify", str(path), str(tmp_path / "o.laz")]) == 0
    las = laspy.read(tmp_path / "o.laz")
    assert las.header.scales[0] == float(f"1e-{decimals}")
    offsets = np.rint(las.header.offsets * 10**decimals).astype(np.int64)
    assert np.array_equal(np.column_stack([las.X, las.Y, las.Z]) + offsets, steps)
