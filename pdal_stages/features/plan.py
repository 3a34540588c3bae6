"""What to compute: neighborhoods, features and the points' own dimensions, and the columns they become."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ..base import checks
from ..base.errors import OptionError, suggest
from . import returns
from .neighborhoods import (
    AROUND,
    BY_RADIUS,
    LEAST_MEMBERS,
    Neighborhood,
    parse_neighborhoods,
    preset_dimensions,
)

#: Feature -> definition, in the order of the columns.
COVARIANCE = {
    "Linearity": "(e1 - e2) / e1",
    "Planarity": "(e2 - e3) / e1",
    "Scattering": "e3 / e1",
    "Omnivariance": "cube root of e1 e2 e3",
    "Anisotropy": "(e1 - e3) / e1",
    "Eigenentropy": "-(e1 ln e1 + e2 ln e2 + e3 ln e3), 0 ln 0 = 0",
    "EigenvalueSum": "l1 + l2 + l3, square meters",
    "SurfaceVariation": "e3",
}
GEOMETRIC = {
    "Density": "points per square meter of the cylinder's base, or per cubic meter of the sphere",
    "Verticality": "1 - |nz|, n the unit eigenvector of l3",
    "HeightRange": "highest minus lowest z, meters",
    "HeightStd": "standard deviation of z (divisor n), meters",
    "Radius": "the chosen size in meters; kopt, ropt, rdim and copt only",
}
#: What the papers' sets of features lack, and "all" therefore leaves out.
RELATIVE = {
    "HeightAboveLowest": "z of the point minus the lowest z of the neighborhood, meters [HWS16]"
}
#: Of the points around a point, each with the surface that its 10 nearest make (``surfaces.py``). Features of features:
#: of nearest neighbors (``k20``) only, and no part of "all".
SURFACES = {
    "NormalAgreement": "mean |n . n'| of the point's normal n and those of the neighborhood's points",
    "SurfaceVariationMin": "lowest surface variation of the neighborhood's points",
    "SurfaceVariationMean": "mean surface variation of the neighborhood's points",
    "SurfaceVariationStd": "standard deviation of the surface variation of the neighborhood's points (divisor n)",
}
SHAPES = {
    "A3": "angle between two pulled points seen from a third",
    "D1": "distance of a pulled point from the centroid",
    "D2": "distance between two pulled points",
    "D3": "square root of the area of the triangle of three pulled points",
    "D4": "cube root of the volume of the tetrahedron of four pulled points",
}
SHAPE_BINS = 10

#: Columns of the moment kernels, in their order.
MOMENT_FEATURES = (
    *COVARIANCE, "Density", "Verticality", "HeightRange", "HeightStd", "HeightAboveLowest", "Radius",
)  # fmt: skip
SHAPE_FEATURES = tuple(f"{metric}_{b}" for metric in SHAPES for b in range(SHAPE_BINS))

#: Every feature, in order. Radius is of adaptive neighborhoods alone, SURFACES of nearest neighbors.
ALL_FEATURES = (*COVARIANCE, *GEOMETRIC, *SHAPE_FEATURES, *RELATIVE, *SURFACES)

#: Words for several features at once.
GROUPS: dict[str, tuple[str, ...]] = {
    "all": (*COVARIANCE, *GEOMETRIC, *SHAPE_FEATURES),
    "covariance": tuple(COVARIANCE),
    "geometric": tuple(GEOMETRIC),
    "shapes": SHAPE_FEATURES,
    "surfaces": tuple(SURFACES),
    "he2017": (
        "Linearity",
        "Planarity",
        "Scattering",
        "SurfaceVariation",
        "Verticality",
        "HeightRange",
    ),
    **{metric: tuple(f"{metric}_{b}" for b in range(SHAPE_BINS)) for metric in SHAPES},
}

#: Groups that bring a preset's own dimensions (HeightAboveGround, Z) along.
WITH_DIMENSIONS = ("all", "geometric")


def parse_feature_set(spec: str | Iterable[str]) -> tuple[str, ...]:
    """Words of a feature set: groups, features, features of one neighborhood (``Linearity_c1``).

    Case does not matter for groups and features. Returns each word once, spelled as in the tables.

    Raises
    ------
    OptionError
        For a word that is neither; it names the nearest known one.
    """
    if isinstance(spec, str):
        words = spec.split(",")
    else:
        try:
            words = [part for item in spec for part in item.split(",")]
        except (TypeError, AttributeError):
            raise OptionError(
                "'feature_set' must be text or a list of text", found=repr(spec)
            ) from None
    known = {name.lower(): name for name in (*GROUPS, *ALL_FEATURES)}
    found: dict[str, None] = {}
    for word in (w.strip() for w in words):
        if not word:
            continue
        name = known.get(word.lower())
        if name is None:  # a feature of one neighborhood keeps its suffix
            heads = (name for name in ALL_FEATURES if word.lower().startswith(f"{name.lower()}_"))
            head = max(heads, key=len, default=None)
            if head is None:
                cure = suggest(word, (*GROUPS, *ALL_FEATURES))
                single = (*COVARIANCE, *GEOMETRIC, *RELATIVE, *SURFACES)
                raise OptionError(
                    f"unknown feature or group '{word}'",
                    cure=f"{cure}Groups: {', '.join(GROUPS)}; features: {', '.join(single)}",
                )
            name = head + word[len(head) :].lower()
        found[name] = None
    if not found:
        raise OptionError(
            "'feature_set' names no feature", found=repr(spec), cure="Write all, or leave it out"
        )
    return tuple(found)


#: What is computed where nothing is asked for, by the function and the stage alike.
DEFAULT_NEIGHBORHOODS = ("c1", "c2", "c3", "c5", "kopt")
DEFAULT_FEATURES = ("covariance", "geometric")
#: Halo of neighborhoods whose size is a number of points, meters: see :attr:`FeaturePlan.halo_m`.
POINTS_HALO = 15.0


@dataclass(frozen=True)
class Columns:
    """The features wanted of one neighborhood."""

    neighborhood: Neighborhood
    #: Feature (without suffix) -> column in the matrix.
    at: dict[str, int] = field(hash=False)

    @property
    def shapes(self) -> bool:
        """Whether any shape distribution is wanted."""
        return any(name in self.at for name in GROUPS["shapes"])


def columns_of(chosen: Sequence[Columns], features: Collection[str]) -> np.ndarray:
    """Where each feature (column) of each neighborhood (row) goes, int64; -1: nowhere."""
    table = [[one.at.get(feature, -1) for feature in features] for one in chosen]
    return np.array(table, np.int64).reshape(len(chosen), len(features))


@dataclass(frozen=True)
class FeaturePlan:
    """An ordered set of features; make it with :meth:`parse`."""

    neighborhoods: tuple[Neighborhood, ...]
    #: The words of the feature set: groups, features, or features of one neighborhood.
    features: tuple[str, ...] = ("all",)
    #: The points' own dimensions used as features, after all others.
    dimensions: tuple[str, ...] = ()
    #: Points a radius of ``ropt`` and ``copt`` must hold, and the sphere of a curvature [H17].
    least_members: int = LEAST_MEMBERS

    def __post_init__(self) -> None:
        self.layout  # noqa: B018  a plan with unusable words is refused when it is made

    @classmethod
    def parse(
        cls,
        neighborhoods: str | Iterable[str],
        feature_set: str | Iterable[str] = "all",
        dimensions: str | Iterable[str] = (),
    ) -> FeaturePlan:
        """A plan from words.

        Parameters
        ----------
        neighborhoods : str or iterable of str
            Presets and tokens, e.g. ``"weinmann2018"`` or ``"c1, s2, kopt"``.
        feature_set : str or iterable of str
            Groups (``all``, ``covariance``, ``geometric``, ``shapes``, ``surfaces``, ``A3``, ``D1`` .. ``D4``), features
            (``Linearity``) or features of one neighborhood (``Linearity_c1``). Only what is named is computed; columns
            come in the order of ``ALL_FEATURES``, neighborhood by neighborhood.
        dimensions : str or iterable of str
            Dimensions of the points to use as features besides those that a preset brings. A preset brings
            its own (``HeightAboveGround``, ``Z``) with the groups ``all`` and ``geometric``.

        Raises
        ------
        OptionError
            For unknown words, and for features that no chosen neighborhood has.
        """
        words = parse_feature_set(feature_set)
        if isinstance(neighborhoods, Iterable) and not isinstance(neighborhoods, str):
            neighborhoods = list(neighborhoods)
        parsed = tuple(parse_neighborhoods(neighborhoods))
        given = dimensions.split(",") if isinstance(dimensions, str) else list(dimensions)
        own = (
            preset_dimensions(neighborhoods)
            if any(word in WITH_DIMENSIONS for word in words)
            else ()
        )
        names = dict.fromkeys(own)
        for name in (name.strip() for name in given):
            names.update(
                dict.fromkeys(returns.NAMES if name == returns.GROUP else [name] if name else [])
            )
        return cls(parsed, words, tuple(names))

    @cached_property
    def layout(self) -> tuple[Columns, ...]:
        """The columns of each neighborhood, in the order of the neighborhoods."""
        wanted = {name for word in self.features for name in GROUPS.get(word, (word,))}
        result, names = [], list[str]()
        for one in self.neighborhoods:
            at = {}
            for feature in ALL_FEATURES:
                name = f"{feature}_{one.suffix}"
                if has(one, feature) and (feature in wanted or name in wanted):
                    at[feature] = len(names)
                    names.append(name)
            result.append(Columns(one, at))
        if lost := [word for word in self.features if word not in {*GROUPS, *ALL_FEATURES, *names}]:
            raise OptionError(
                f"the feature '{lost[0]}' belongs to none of the neighborhoods",
                found=", ".join(n.token for n in self.neighborhoods),
            )
        if not names:
            cure = (
                "Neighbors' surfaces exist for k20 and the like only"
                if wanted & {*SURFACES}
                else None
            )
            raise OptionError(
                f"none of the neighborhoods has the feature '{', '.join(self.features)}'",
                found=", ".join(n.token for n in self.neighborhoods),
                cure="Radius exists for kopt, ropt, rdim and copt only"
                if "Radius" in wanted
                else cure,
            )
        if clash := {*names} & {*self.dimensions}:
            raise OptionError(f"the dimension '{min(clash)}' is also a computed feature")
        return tuple(result)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all columns: ``Linearity_c1``, ..., then the dimensions."""
        computed = (f"{feature}_{c.neighborhood.suffix}" for c in self.layout for feature in c.at)
        return (*computed, *self.dimensions)

    @property
    def shapes(self) -> bool:
        """Whether shape distributions are computed (so thresholds must be fitted)."""
        return any(columns.shapes for columns in self.layout)

    @cached_property
    def cell(self) -> float:
        """Edge of the grid's cells in meters, a power of two that follows from the largest radius alone.

        1 m for radii from 0.75 to 20 m, finer below, coarser above.
        """
        radii = [n.parameters[0] for n in self.neighborhoods if n.kind in ("cylinder", "sphere")]
        largest = max(radii, default=1.0)
        if largest > 20.0:
            return 2.0 ** math.ceil(math.log2(largest / 20.0))
        if largest < 0.75:
            return 2.0 ** max(math.floor(math.log2(largest / 0.75)), -8)
        return 1.0

    @cached_property
    def halo_m(self) -> float:
        """Meters of surroundings a tile needs for the same result as the whole cloud.

        The largest reach and one cell. ``k50`` and ``kopt`` reach as far as their points lie, which no number
        bounds; for them at least 15 m are asked for, enough for 100 neighbors down to 0.15 points a square
        meter; neighbors' surfaces take a second step from there, by 10 more. How many queries had to look farther is
        counted in ``FeatureEngine.report.beyond_halo``.
        """
        reach = max((n.reach for n in self.neighborhoods if n.reach is not None), default=0.0)
        reach = max(reach, returns.reach(self.dimensions))
        if any(n.reach is None for n in self.neighborhoods):
            reach = max(reach, POINTS_HALO)
        for k in self._surfaced:
            reach = max(reach, POINTS_HALO * (math.sqrt(k) + math.sqrt(AROUND)) / math.sqrt(100))
        return reach + self.cell

    @property
    def _surfaced(self) -> list[int]:
        """The numbers of neighbors whose surfaces are wanted."""
        return [
            int(c.neighborhood.parameters[0])
            for c in self.layout
            if any(name in c.at for name in SURFACES)
        ]

    @property
    def copt(self) -> bool:
        """Whether a neighborhood is curvature-adaptive, so that its threshold is needed."""
        return any(c.at and c.neighborhood.kind == "copt" for c in self.layout)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able description; :meth:`from_dict` reads it."""
        by_radius = any(one.kind in (*BY_RADIUS, "copt") for one in self.neighborhoods)
        return {
            "neighborhoods": [n.token for n in self.neighborhoods],
            "features": list(self.features),
            "dimensions": list(self.dimensions),
            **({"least_members": self.least_members} if by_radius else {}),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FeaturePlan:
        """The plan that :meth:`to_dict` described; OptionError where it is not such a description."""
        lists = ("neighborhoods", "features", "dimensions")
        given: list[Any] = [data.get(name) if isinstance(data, Mapping) else None for name in lists]
        for value in given:
            if not isinstance(value, list | tuple) or not all(
                isinstance(item, str) for item in value
            ):
                raise OptionError(
                    f"a feature plan needs lists of text: {', '.join(lists)}", found=repr(data)[:80]
                )
        tokens, words, dimensions = given
        members = data.get("least_members", LEAST_MEMBERS)
        least = checks.whole("'least_members' of a feature plan", members, 3, 100)
        parsed = tuple(parse_neighborhoods(tokens))
        return cls(parsed, parse_feature_set(words), tuple(dict.fromkeys(dimensions)), least)


def has(neighborhood: Neighborhood, feature: str) -> bool:
    """Whether a neighborhood has a feature: all have, but for the size chosen and what neighbors' surfaces make."""
    if feature == "Radius":
        return neighborhood.adaptive
    return feature not in SURFACES or neighborhood.kind == "knn"
