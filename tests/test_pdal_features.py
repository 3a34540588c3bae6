"""Our features beside those of PDAL's filters.covariancefeatures and filters.optimalneighborhood: the table in the docs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import pdal_stages as ps

DOCS = Path(__file__).parents[1] / "docs" / "pdal-users.md"
#: Ours -> (PDAL's name, modes of PDAL's under which both are equal, PDAL's value for ours of n points)
TABLE = {
    "Linearity": ("Linearity", ("raw", "normalized"), lambda v, n: v),
    "Planarity": ("Planarity", ("raw", "normalized"), lambda v, n: v),
    "Scattering": ("Scattering", ("raw", "normalized"), lambda v, n: v),
    "Anisotropy": ("Anisotropy", ("raw", "normalized"), lambda v, n: v),
    "Omnivariance": ("Omnivariance", ("normalized",), lambda v, n: v),
    "Eigenentropy": ("Eigenentropy", ("normalized",), lambda v, n: v),
    "SurfaceVariation": ("SurfaceVariation", ("raw",), lambda v, n: v),
    "EigenvalueSum": (
        "EigenvalueSum",
        ("raw", "sqrt", "normalized"),
        lambda v, n: v * n / np.maximum(n - 1, 1),
    ),
    "Verticality": ("DemantkeVerticality", ("raw", "sqrt", "normalized"), lambda v, n: v),
}


@pytest.fixture(scope="module")
def cloud(tmp_path_factory, write_las):
    """A roof, a wall and a bush: no two points at one distance."""
    rng = np.random.default_rng(4)
    flat = rng.uniform(0, 6, (400, 3)) * [1, 1, 0.02] + [0, 0, 3]
    wall = rng.uniform(0, 6, (400, 3)) * [1, 0.02, 0.5]
    bush = rng.normal([3, 4, 1], 0.8, (400, 3))
    xyz = np.concatenate([flat, wall, bush])
    arrays = dict(zip("XYZ", xyz.T, strict=True))
    return write_las(
        tmp_path_factory.mktemp("features") / "in.las", arrays, scale=1e-6, offset=[0, 0, 0]
    )


@pytest.mark.pdal
@pytest.mark.parametrize("mode", ["raw", "sqrt", "normalized"])
@pytest.mark.parametrize(("token", "size"), [("k10", {"knn": 10}), ("s0.9", {"radius": 0.9})])
def test_the_table_holds(cloud, mode, token, size):
    theirs = {"type": "filters.covariancefeatures", "feature_set": "all", "mode": mode, **size}
    theirs["feature_set"] = ",".join(name for name, _, _ in TABLE.values())
    ours = {
        "type": "filters.multiscalefeatures",
        "neighborhoods": token,
        "feature_set": ",".join([*TABLE, "Density"]),
    }
    array = ps.run_pipeline([str(cloud), theirs, ours]).arrays[0]
    suffix = token.replace(".", "_")
    many = np.full(len(array), 11.0)
    if token[0] == "s":
        many = np.rint(array[f"Density_{suffix}"].astype(float) * 4 / 3 * np.pi * 0.9**3)
    enough = many >= 4  # PDAL leaves out points with fewer than three neighbors
    assert np.count_nonzero(enough) > 900
    for name, (named, modes, scaled) in TABLE.items():
        inside = scaled(array[f"{name}_{suffix}"].astype(float), many)[enough]
        same = np.allclose(inside, array[named][enough], rtol=2e-4, atol=2e-5)
        assert same == (mode in modes), (name, mode, np.abs(inside - array[named][enough]).max())


@pytest.mark.pdal
def test_the_optimal_neighborhood_of_pdal(cloud):
    """PDAL counts the point itself: its min_k and max_k are one more than ours."""
    stages = [
        {"type": "filters.optimalneighborhood", "min_k": 11, "max_k": 41},
        {
            "type": "filters.multiscalefeatures",
            "neighborhoods": "kopt(10,40)",
            "feature_set": "Radius,Density",
        },
    ]
    array = ps.run_pipeline([str(cloud), *stages]).arrays[0]
    radius = array["Radius_kopt10_40"].astype(float)
    number = np.rint(array["Density_kopt10_40"] * 4 / 3 * np.pi * radius**3)
    same = number == array["OptimalKNN"]
    assert np.mean(same) > 0.999  # the entropies of two sizes may tie
    assert np.allclose(radius[same], array["OptimalRadius"][same], rtol=1e-5)
    assert {11, 41} <= set(number.tolist())


def test_the_table_of_the_docs_is_this_one():
    text = DOCS.read_text(encoding="utf-8")
    part = text[text.index("## Features of the same name") :].partition("\n## ")[0]
    for name, (named, modes, _) in TABLE.items():
        (row,) = [
            line
            for line in part.splitlines()
            if line.startswith("|") and f"`{name}`" in line.split("|")[1]
        ]
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        assert f"`{named}`" in cells[1] or cells[1] == "the same", row
        output = set(re.findall(r"`(\w+)`", cells[2])) or {"raw", "sqrt", "normalized"}
        assert output == set(modes), row
