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
from . import return_features
from .neighborhoods import (
    AROUND,
    BY_RADIUS,
    LEAST_MEMBERS,
    Neighborhood,
    parse_neighborhoods,
    preset_dimensions,
)
from .registry import BY_NAME, GROUPS, SURFACE_FEATURES

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
    known = {name.lower(): name for name in (*GROUPS, *BY_NAME)}
    found: dict[str, None] = {}
    for word in (w.strip() for w in words):
        if not word:
            continue
        name = known.get(word.lower())
        if name is None:  # a feature of one neighborhood keeps its suffix
            heads = (name for name in BY_NAME if word.lower().startswith(f"{name.lower()}_"))
            head = max(heads, key=len, default=None)
            if head is None:
                cure = suggest(word, (*GROUPS, *BY_NAME))
                single = [one.name for one in BY_NAME.values() if one.group != "shapes"]
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
    #: Full names of the features (``Linearity_c1``), in the order of the columns; never a group.
    features: tuple[str, ...]
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
            Groups (``all``, ``covariance``, ``geometric``, ``shapes``, ``surfaces``, ``A3``,
            ``D1`` .. ``D4``), features (``Linearity``) or features of one neighborhood
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
        given = dimensions.split(",") if isinstance(dimensions, str) else list(dimensions)
        own = (
            preset_dimensions(neighborhoods)
            if any(word in WITH_DIMENSIONS for word in words)
            else ()
        )
        names = dict.fromkeys(own)
        for name in (name.strip() for name in given):
            names.update(
                dict.fromkeys(
                    return_features.NAMES
                    if name == return_features.GROUP
                    else [name]
                    if name
                    else []
                )
            )
        return cls(parsed, _expand(parsed, words), tuple(names))

    @cached_property
    def layout(self) -> tuple[Columns, ...]:
        """The columns of each neighborhood, in the order of the neighborhoods."""
        if not self.features:
            raise OptionError("a feature plan names no feature")
        found = _features_of(self.neighborhoods)
        columns: dict[Neighborhood, dict[str, int]] = {one: {} for one in self.neighborhoods}
        for column, name in enumerate(self.features):
            if name not in found:
                raise OptionError(
                    f"the feature '{name}' belongs to none of the neighborhoods",
                    found=", ".join(n.token for n in self.neighborhoods),
                    cure=suggest(name, found) or None,
                )
            neighborhood, feature = found[name]
            columns[neighborhood][feature] = column
        if len(set(self.names)) < len(self.names):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            what = "is also a computed feature" if twice in found else "is named twice"
            raise OptionError(f"the dimension '{twice}' {what}")
        return tuple(Columns(one, at) for one, at in columns.items())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns: ``Linearity_c1``, ..., then the dimensions."""
        return (*self.features, *self.dimensions)

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

        The largest reach and one cell. ``k50`` and ``kopt`` reach as far as their points lie,
        which no number bounds; for them at least 15 m are asked for, enough for 100 neighbors down
        to 0.15 points a square meter; neighbors' surfaces take a second step from there, by 10
        more. How many queries had to look farther is counted in
        ``FeatureEngine.report.beyond_halo``.
        """
        reach = max((n.reach for n in self.neighborhoods if n.reach is not None), default=0.0)
        reach = max(reach, return_features.reach(self.dimensions))
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
            if any(name in c.at for name in SURFACE_FEATURES)
        ]

    @property
    def copt(self) -> bool:
        """Whether a neighborhood is curvature-adaptive, so that its threshold is needed."""
        return any(c.at and c.neighborhood.kind == "copt" for c in self.layout)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description; :meth:`from_dict` reads it."""
        by_radius = any(one.kind in (*BY_RADIUS, "copt") for one in self.neighborhoods)
        return {
            "neighborhoods": [n.token for n in self.neighborhoods],
            "features": list(self.features),
            "dimensions": list(self.dimensions),
            **({"least_members": self.least_members} if by_radius else {}),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FeaturePlan:
        """Return the plan that :meth:`to_dict` described; OptionError where it is not such a description."""
        lists = ("neighborhoods", "features", "dimensions")
        given: list[Any] = [data.get(name) if isinstance(data, Mapping) else None for name in lists]
        for value in given:
            if not isinstance(value, list | tuple) or not all(
                isinstance(item, str) for item in value
            ):
                raise OptionError(
                    f"a feature plan needs lists of text: {', '.join(lists)}", found=repr(data)[:80]
                )
        tokens, features, dimensions = given
        members = data.get("least_members", LEAST_MEMBERS)
        least = checks.whole("'least_members' of a feature plan", members, 3, 100)
        parsed = tuple(parse_neighborhoods(tokens))
        return cls(parsed, tuple(features), tuple(dimensions), least)


def _features_of(neighborhoods: Sequence[Neighborhood]) -> dict[str, tuple[Neighborhood, str]]:
    """Return the full name of every feature that neighborhoods have -> neighborhood, feature."""
    return {
        f"{feature.name}_{one.suffix}": (one, feature.name)
        for one in neighborhoods
        for feature in BY_NAME.values()
        if not feature.kinds or one.kind in feature.kinds
    }


def _expand(neighborhoods: Sequence[Neighborhood], words: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of the features that words name, in the order of the columns.

    Words are groups, features, or features of one neighborhood. OptionError where no neighborhood
    has one of these.
    """
    known = _features_of(neighborhoods)
    wanted = {name for word in words for name in GROUPS.get(word, (word,))}
    names = tuple(full for full, (_, feature) in known.items() if {full, feature} & wanted)
    tokens = ", ".join(one.token for one in neighborhoods)
    if lost := [word for word in words if word not in {*GROUPS, *BY_NAME, *names}]:
        raise OptionError(
            f"the feature '{lost[0]}' belongs to none of the neighborhoods", found=tokens
        )
    if not names:
        cure = None
        if wanted & {*SURFACE_FEATURES}:
            cure = "Neighbors' surfaces exist for k20 and the like only"
        if "Radius" in wanted:
            cure = "Radius exists for kopt, ropt, rdim and copt only"
        raise OptionError(
            f"none of the neighborhoods has the feature '{', '.join(words)}'",
            found=tokens,
            cure=cure,
        )
    return names
