"""The labeled surveys as they are trained on and scored, and thinner or poorer copies of them.

Poorer: without return numbers, or with one return of each pulse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np
from scipy.spatial import cKDTree
from surveys import GROUND, SHRUBS, SURVEYS, TESTS, VEGETATION, LabeledSurvey

from pdal_stages.base.hashing import hash_rows
from pdal_stages.stages.preprocessing import PREPARATION
from pdal_stages.terrain import filtered_ground

#: Meters from the middle of a survey beyond which a point is a mistake.
FAR = 5000.0


@dataclass(frozen=True)
class ShrubRules:
    """What of everything else are shrubs; lengths in meters. Not tuned but `low`."""

    #: 0.4 gained as much in French towns, but scree in the alps became vegetation (98.5 -> 97.0)
    low: float = 0.8
    high: float = 2.0  #: above it everything else is vegetation by `LabeledSurvey.tall`
    radius: float = 1.5  #: of a column of neighbors: hardly wider than a car
    neighbors_low: float = 0.3  #: neighbors are above the ground ...
    neighbors_high: float = 4.0  #: ... and not in the crown of a tree
    #: least share of neighbors that are one of several returns; on cars it is 0.1 to 0.3
    min_multiple: float = 0.4


SHRUB_RULES = ShrubRules()


@dataclass(frozen=True)
class SkinRules:
    """The edge of a survey, where only the skin of crowns was seen; lengths in meters. Not tuned."""

    width: float = 15.0  #: of the strip along the edge
    inside: float = 15.0  #: of what lies beside the strip
    cell: float = 2.0  #: in which the highest point hides others ...
    depth: float = 1.5  #: ... this much lower


SKIN_RULES = SkinRules()


def slug(name: str) -> str:
    """Return a survey's or a group's name as that of a file."""
    return name.replace(" ", "-").replace("'", "").replace(",", "")


def model_without(folder: Path, survey: str) -> Path:
    """Return the model that knows nothing of the survey's group (`leave_one_out.py --save`)."""
    return folder / f"{slug(SURVEYS[survey].group)}.model"


def true_classes(
    survey: LabeledSurvey, x: np.ndarray, y: np.ndarray, codes: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """Return the classes (n,) uint8 that errors are counted against; 0 where they are not known."""
    truth = _relabeled(survey, codes)
    for given, least in survey.tall.items():
        # Else vegetation would be judged only where it is none.
        truth[(codes == given) & (height >= least)] = VEGETATION
    for given, most in survey.low.items():
        truth[(codes == given) & (height < most)] = GROUND
    truth[mislabeled(survey, x, y)] = 0
    return truth


def mislabeled(survey: LabeledSurvey, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return which points (n,) lie where the labels were looked at and are wrong."""
    inside = np.zeros(len(x), np.bool_)
    for west, south, east, north in survey.mislabeled:
        inside |= (x >= west) & (x <= east) & (y >= south) & (y <= north)
    return inside


def _relabeled(survey: LabeledSurvey, codes: np.ndarray) -> np.ndarray:
    labels = np.zeros(len(codes), np.uint8)
    for given, ours in survey.labels.items():
        labels[codes == given] = ours
    return labels


@dataclass(frozen=True, eq=False)
class Cloud:
    """A survey, or a copy of it, with heights.

    Attributes
    ----------
    survey, name : str
    xyz : (n, 3) float64
        Meters.
    labels : (n,) uint8
        2, 3, 5, 6, or 0: what is trained on.
    truth : (n,) uint8
        2, 5, 6, or 0: what is scored.
    dimensions : dict
        What the models read beside coordinates.
    """

    survey: str
    name: str
    xyz: np.ndarray
    labels: np.ndarray
    truth: np.ndarray
    dimensions: dict[str, np.ndarray]

    def part(self, rows: np.ndarray, name: str, xyz: np.ndarray | None = None) -> Cloud:
        """Return some of the points, with heights of their own; `xyz`: where they are now."""
        return with_heights(
            Cloud(
                self.survey,
                name,
                self.xyz[rows] if xyz is None else xyz,
                self.labels[rows],
                self.truth[rows],
                {key: self.dimensions[key][rows] for key in ("ReturnNumber", "NumberOfReturns")},
            )
        )

    def taken(self, rows: np.ndarray) -> Cloud:
        """Return some of the points, with the heights they have."""
        return replace(
            self,
            xyz=self.xyz[rows],
            labels=self.labels[rows],
            truth=self.truth[rows],
            dimensions={name: values[rows] for name, values in self.dimensions.items()},
        )

    @property
    def density(self) -> float:
        """Median of the points per square meter of 4 m cells that hold more than one."""
        _, number = np.unique(np.floor(self.xyz[:, :2] / 4.0), axis=0, return_counts=True)
        return float(np.median(number[number > 1]) / 16.0)


def published(
    data: Path, known: LabeledSurvey
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return a survey's coordinates (n, 3), its own codes (n,), and its return numbers."""
    parts = [laspy.read(data / name) for name in known.files]
    xyz = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts]).astype(float)
    codes = np.concatenate([np.asarray(p[known.dimension]) for p in parts]).astype(np.uint8)
    dimensions = {
        name: np.concatenate([np.asarray(p[word]) for p in parts]).astype(np.uint8)
        for name, word in (
            ("ReturnNumber", "return_number"),
            ("NumberOfReturns", "number_of_returns"),
        )
    }
    # Hamburg has a point that is hundreds of kilometers away.
    near = (np.abs(xyz - np.median(xyz, axis=0)) < FAR).all(axis=1)
    return xyz[near], codes[near], {name: values[near] for name, values in dimensions.items()}


def load_test(data: Path, survey: str) -> Cloud:
    """Return the test part of a survey, which was not trained on."""
    return load(data, survey, replace(SURVEYS[survey], files=TESTS[survey]))


def load(data: Path, survey: str, known: LabeledSurvey | None = None) -> Cloud:
    """Return a survey as published, with heights above filtered ground; `known`: other files."""
    known = known or SURVEYS[survey]
    xyz, code, dimensions = published(data, known)
    kept = ~np.isin(code, known.dropped)
    xyz, code = xyz[kept], code[kept]
    labels = _relabeled(known, code)
    kept_dimensions = {name: values[kept] for name, values in dimensions.items()}
    cloud = with_heights(Cloud(survey, survey, xyz, labels, labels.copy(), kept_dimensions))
    for given, height in known.tall.items():
        tall = (code == given) & (cloud.dimensions["HeightAboveGround"] >= height)
        cloud.labels[tall] = VEGETATION
        if known.tall_scored:
            cloud.truth[tall] = VEGETATION
    for given, height in known.low.items():
        low = (code == given) & (cloud.dimensions["HeightAboveGround"] < height)
        cloud.labels[low] = cloud.truth[low] = GROUND
    cloud.labels[find_shrubs(cloud, np.isin(code, known.shrubs))] = SHRUBS
    wrong = mislabeled(known, *xyz[:, :2].T)
    cloud.labels[wrong] = cloud.truth[wrong] = 0
    return cloud


def find_shrubs(cloud: Cloud, rest: np.ndarray) -> np.ndarray:
    """Return rows (m,) of shrubs among `rest` (n,), the points of everything else.

    Where only what is tall is labeled vegetation, models learn that what is low is none.
    """
    rules, height = SHRUB_RULES, np.asarray(cloud.dimensions["HeightAboveGround"])
    rows = np.flatnonzero(rest & (height > rules.low) & (height < rules.high))
    if not len(rows):
        return rows
    above = rest & (height > rules.neighbors_low) & (height < rules.neighbors_high)
    is_multiple = cloud.dimensions["NumberOfReturns"][above] > 1
    tree = cKDTree(cloud.xyz[above, :2])
    near = tree.query_ball_point(cloud.xyz[rows, :2], rules.radius)
    share = np.array([is_multiple[neighbors].mean() for neighbors in near])
    return rows[share >= rules.min_multiple]


def with_heights(cloud: Cloud) -> Cloud:
    """Return the cloud with the dimensions that the model's preprocessing makes of it."""
    (stage,) = PREPARATION
    made = filtered_ground(*np.ascontiguousarray(cloud.xyz.T), openings=stage["openings"])
    return replace(cloud, dimensions={**cloud.dimensions, **made})


def thinned(cloud: Cloud, density: float) -> Cloud | None:
    """Return a copy of this density, chosen by coordinates; None if it is hardly denser itself."""
    share = density / cloud.density
    if share > 0.87:
        return None
    kept = np.flatnonzero(hash_rows(cloud.xyz.T, 0) < np.uint64(share * 2.0**64))
    return cloud.part(kept, f"{cloud.name}, {density:g} points per m2")


def without_returns(cloud: Cloud) -> Cloud:
    """Return a copy that has no return numbers."""
    none = np.zeros(len(cloud.xyz), np.uint8)
    return replace(
        cloud,
        name=f"{cloud.name}, no returns",
        dimensions={**cloud.dimensions, "ReturnNumber": none, "NumberOfReturns": none},
    )


def one_return(cloud: Cloud, last: bool) -> Cloud:
    """Return a copy with the first or last return of each pulse alone, as some are delivered."""
    number, of = cloud.dimensions["ReturnNumber"], cloud.dimensions["NumberOfReturns"]
    kept = number >= of if last else number <= 1
    name = f"{cloud.name}, {'last' if last else 'first'} returns"
    return without_returns(cloud.part(np.flatnonzero(kept), name))


def with_skin(cloud: Cloud) -> Cloud:
    """Return a copy that ends, in the middle of its vegetation, at a strip of the skin of crowns."""
    rules, x = SKIN_RULES, cloud.xyz[:, 0]
    end = float(np.median(x[cloud.labels == VEGETATION]))
    _, cell = np.unique(np.floor(cloud.xyz[:, :2] / rules.cell), axis=0, return_inverse=True)
    highest = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(highest, cell, cloud.xyz[:, 2])
    hidden = (x < end + rules.width) & (cloud.xyz[:, 2] < highest[cell] - rules.depth)
    part = cloud.part(np.flatnonzero((x >= end) & ~hidden), f"{cloud.name}, ends at crowns")
    return part.taken(np.flatnonzero(part.xyz[:, 0] < end + rules.width + rules.inside))
