"""What to compute: neighborhoods, features, dimensions of the points, and their columns."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..base.errors import OptionError, suggest
from ..base.json_types import JsonObject
from . import gap_below, return_features
from .neighborhoods import (
    AROUND,
    RADIUS_MEMBERS,
    Neighborhood,
    parse_neighborhoods,
    preset_dimensions,
)
from .registry import (
    GROUPS,
    SURFACE_FEATURES,
    expand_words,
    features_of,
    parse_feature_set,
)

#: Groups that bring a preset's own dimensions (HeightAboveGround, Z) along.
WITH_DIMENSIONS = ("all", "geometric")


#: Default neighborhoods of ``compute_features`` and of ``filters.multiscalefeatures``: those of
#: [B16].
DEFAULT_NEIGHBORHOODS = ("c1", "c2", "c3", "c5", "kopt")
#: Their default features: all but the shape distributions, which cost most.
DEFAULT_FEATURES = ("covariance", "geometric")
#: Halo of neighborhoods whose size is a number of points, meters: it holds 100 of them, the most of
#: ``kopt``, down to 0.15 points a square meter; see :attr:`FeaturePlan.halo_m`.
POINTS_HALO = 15.0


@dataclass(frozen=True)
class Columns:
    """The features wanted of one neighborhood."""

    neighborhood: Neighborhood
    #: Feature (without suffix) -> column in the matrix.
    at: dict[str, int] = field(hash=False)

    @property
    def shapes(self) -> bool:
        """True where a shape distribution is wanted."""
        return any(name in self.at for name in GROUPS["shapes"])


def columns_of(chosen: Sequence[Columns], features: Collection[str]) -> np.ndarray:
    """Return the column of each feature (column) of each neighborhood (row), int64; or -1."""
    table = [[columns.at.get(feature, -1) for feature in features] for columns in chosen]
    return np.array(table, np.int64).reshape(len(chosen), len(features))


@dataclass(frozen=True)
class FeaturePlan:
    """An ordered set of features; make it with :meth:`parse`."""

    neighborhoods: tuple[Neighborhood, ...]
    #: Full names of the features (``Linearity_c1``), in the order of the columns; never a group.
    features: tuple[str, ...]
    #: The points' own dimensions used as features, after all others.
    dimensions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a plan with unusable names when it is made."""
        self.layout  # noqa: B018

    @classmethod
    def parse(
        cls,
        neighborhoods: str | Iterable[str],
        feature_set: str | Iterable[str] = "all",
        dimensions: str | Iterable[str] = (),
    ) -> FeaturePlan:
        """Return a plan from words.

        Parameters
        ----------
        neighborhoods : str or iterable of str
            Presets and tokens, e.g. ``"weinmann2018"`` or ``"c1, s2, kopt"``.
        feature_set : str or iterable of str
            Groups (``all``, ``covariance``, ``geometric``, ``shapes``, ``surfaces``, ``he2017``,
            ``A3``, ``D1`` .. ``D4``), features (``Linearity``) or features of one neighborhood
            (``Linearity_c1``). Only what is named is computed; columns come in the order of the
            registry, neighborhood by neighborhood.
        dimensions : str or iterable of str
            Dimensions of the points to use as features besides those that a preset brings. A
            preset brings its own (``HeightAboveGround``, ``Z``) with the groups ``all`` and
            ``geometric``.

        Raises
        ------
        OptionError
            For unknown words, and for features that no chosen neighborhood has.
        """
        words = parse_feature_set(feature_set)
        if isinstance(neighborhoods, Iterable) and not isinstance(neighborhoods, str):
            neighborhoods = list(neighborhoods)
        parsed = tuple(parse_neighborhoods(neighborhoods))
        names: list[str] = []
        if any(word in WITH_DIMENSIONS for word in words):
            names += preset_dimensions(neighborhoods)
        split = dimensions.split(",") if isinstance(dimensions, str) else list(dimensions)
        for name in filter(None, map(str.strip, split)):
            names += return_features.NAMES if name == return_features.GROUP else [name]
        return cls(parsed, expand_words(parsed, words), tuple(dict.fromkeys(names)))

    @cached_property
    def layout(self) -> tuple[Columns, ...]:
        """The columns of each neighborhood, in the order of the neighborhoods."""
        if not self.features:
            raise OptionError("a feature plan names no feature")
        known = features_of(self.neighborhoods)
        columns: dict[Neighborhood, dict[str, int]] = {n: {} for n in self.neighborhoods}
        for column, name in enumerate(self.features):
            if name not in known:
                raise OptionError(
                    f"the feature '{name}' belongs to none of the neighborhoods",
                    found=", ".join(n.token for n in self.neighborhoods),
                    cure=suggest(name, known) or None,
                )
            neighborhood, feature = known[name]
            columns[neighborhood][feature] = column
        if len(set(self.names)) < len(self.names):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            what = "is also a computed feature" if twice in known else "is named twice"
            raise OptionError(f"the dimension '{twice}' {what}")
        return tuple(Columns(neighborhood, at) for neighborhood, at in columns.items())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns: ``Linearity_c1``, ..., then the dimensions."""
        return (*self.features, *self.dimensions)

    @property
    def shapes(self) -> bool:
        """True where shape distributions are computed, so that thresholds must be fitted."""
        return any(columns.shapes for columns in self.layout)

    @cached_property
    def cell(self) -> float:
        """Edge of the grid's cells in meters, a power of two.

        It follows from the largest radius alone: 1 m for radii from 0.75 to 20 m, finer below,
        coarser above. So a radius spans 20 cells at most, as each costs a step of the search, and
        0.75 at least, as large cells hold many points that are no members; 2**-8 m is 4 mm, which
        hold a point or none. None of these is tuned.
        """
        radii = [n.parameters[0] for n in self.neighborhoods if n.fixed]
        largest = max(radii, default=1.0)
        if largest > 20.0:
            return 2.0 ** math.ceil(math.log2(largest / 20.0))
        if largest < 0.75:
            return 2.0 ** max(math.floor(math.log2(largest / 0.75)), -8)
        return 1.0

    @cached_property
    def halo_m(self) -> float:
        """Meters of surroundings a tile needs for the same result as the whole cloud.

        The largest reach and one cell. ``k50`` and ``kopt`` reach as far as their points lie,
        which no number bounds; for them at least 15 m are asked for, enough for 100 neighbors down
        to 0.15 points a square meter; neighbors' surfaces take a second step from there, by 10
        more. How many queries had to look farther is counted in
        ``FeatureEngine.report.beyond_halo``.
        """
        reach = max((n.reach for n in self.neighborhoods if n.reach is not None), default=0.0)
        reach = max(reach, self.reach_of_dimensions)
        if any(n.reach is None for n in self.neighborhoods):
            reach = max(reach, POINTS_HALO)
        for columns in self.layout:
            if any(name in columns.at for name in SURFACE_FEATURES):
                steps = math.sqrt(columns.neighborhood.parameters[0]) + math.sqrt(AROUND)
                # POINTS_HALO holds 100; a distance grows with the root of the number of points.
                reach = max(reach, POINTS_HALO * steps / math.sqrt(100))
        return reach + self.cell

    @property
    def reach_of_dimensions(self) -> float:
        """Meters, along x or y, to the farthest point that matters to return features and gaps."""
        gap = gap_below.REACH if gap_below.NAME in self.dimensions else 0.0
        return max(gap, return_features.reach(self.dimensions))

    @property
    def copt(self) -> bool:
        """True where a neighborhood is curvature-adaptive, so that its threshold is needed."""
        return any(c.at and c.neighborhood.kind == "copt" for c in self.layout)

    def to_dict(self) -> JsonObject:
        """Return a JSON-able description; :meth:`from_dict` reads it."""
        return {
            "neighborhoods": [n.token for n in self.neighborhoods],
            "features": list(self.features),
            "dimensions": list(self.dimensions),
        }

    @classmethod
    def from_dict(cls, data: JsonObject) -> FeaturePlan:
        """Return the plan that :meth:`to_dict` described; OptionError for unknown words."""
        if data.get("least_members", RADIUS_MEMBERS) != RADIUS_MEMBERS:  # of earlier versions
            raise OptionError(f"'least_members' of a feature plan must be {RADIUS_MEMBERS}")
        parsed = tuple(parse_neighborhoods(data["neighborhoods"]))
        return cls(parsed, tuple(data["features"]), tuple(data["dimensions"]))
