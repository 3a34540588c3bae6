"""Results of the stages that models depend on are bound to the versions of their algorithms."""

import json
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

from pdal_stages.features.registry import SHAPE_FEATURES
from pdal_stages.features.return_features import NAMES, return_features
from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.registry import stage_type, stage_types

DATA = Path(__file__).parent / "data"
#: Dimensions of return features, as laspy calls them.
RETURNS = {"ReturnNumber": "return_number", "NumberOfReturns": "number_of_returns"}
#: type -> version -> clip and dimension -> (PARTS,) means over points.
STORED = DATA / "algorithm_versions.json"
PARTS = 8
#: Real clips, and how much of the first features are computed of, in meters around its middle.
CLIPS, MIDDLE = ("canals", "riverbank", "woods"), 12.0
#: A different processor rounds the last digits otherwise; a mean that moves by more is another result.
TOLERANCE = 2e-3
#: The options that results are stored for, where they are not those of the example on its page.
OPTIONS = {
    "filters.hag_minima": {},
    "filters.hag_morphological": {"ground": True, "terrain_slope": True, "openings": [5, 17]},
    "filters.multiscalefeatures": {
        "neighborhoods": "c2,s3,k20,kopt,ropt,rdim,copt",
        "feature_set": [
            *("covariance", "geometric", "HeightAboveLowest", "surfaces"),
            *(f"{name}_{kind}" for name in SHAPE_FEATURES for kind in ("s3", "copt")),
        ],
    },
}


#: All stages that a model may carry, and the features that forests read.
KINDS = sorted({name for name in stage_types() if stage_type(name).in_models} | {*OPTIONS})


def results(kind: str) -> dict[str, list[float]]:
    """Return the means of each dimension that a stage makes of the clips, over parts of their points by x + y."""
    stage, result = stage_type(kind)(OPTIONS.get(kind, stage_type(kind).example)), {}
    for clip in CLIPS:
        las = laspy.read(DATA / f"{clip}.laz")
        xyz = np.asarray(las.xyz)
        if kind == "filters.multiscalefeatures":
            middle = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
            near = np.abs(xyz - middle)[:, :2].max(axis=1) < MIDDLE
            xyz, las = xyz[near], las[near]
        output = {name: np.zeros(len(xyz)) for name in stage.creates()}
        columns = {**dict(zip("XYZ", xyz.T, strict=True)), **output}
        if stage.reads():  # of classes and heights, for stages that are not the first
            columns["Classification"] = np.asarray(las.classification)
            columns["HeightAboveGround"] = xyz[:, 2] - xyz[:, 2].min()
        out = stage.run(stage.points(columns), WHOLE_CLOUD)
        if kind == "filters.multiscalefeatures":  # models have these as well
            out = out | return_features(
                NAMES, xyz, {name: las[dimension] for name, dimension in RETURNS.items()}
            )
        parts = np.array_split(np.argsort(xyz[:, 0] + xyz[:, 1], kind="stable"), PARTS)
        for name in out:
            means = [round(float(np.mean(out[name][part])), 5) for part in parts]
            result[f"{clip} {name}"] = means
        if kind == "filters.multiscalefeatures":
            break
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_results_change_with_the_version_only(kind):
    version = str(stage_type(kind).algorithm_version)
    known = json.loads(STORED.read_text()).get(kind, {})
    result = results(kind)
    cure = f"raise algorithm_version of {kind} and run: python tests/test_algorithm_versions.py"
    assert version in known, cure
    assert result.keys() == known[version].keys(), cure
    changed = [
        name
        for name, values in known[version].items()
        if not np.allclose(values, result[name], rtol=TOLERANCE, atol=TOLERANCE)
    ]
    assert not changed, f"changed: {changed[:5]}. {cure}"


if __name__ == "__main__":  # stores the results of versions that have none, or of named stages anew
    stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    for name in KINDS:
        versions = stored.setdefault(name, {})
        version = str(stage_type(name).algorithm_version)
        if name in sys.argv[1:] or version not in versions:
            versions[version] = results(name)
    STORED.write_text(json.dumps(stored, indent=1) + "\n")
