"""The registry of features: names, groups, units and definitions, in the order of the columns.

A new feature is one entry here and its value in ``features/moments.py``, without which its column
is NaN and tests/test_every_feature.py fails; what goes with it is in CONTRIBUTING.md, "Checklists".
Columns, groups and kernel rows follow. Model files name their features one by one, so none of them
needs to be trained again.

[B16], [W18] and [H17] are cited in :mod:`.neighborhoods`; [HWS16] is Hackel, Wegner, Schindler
2016, ISPRS Annals III-3, 177-184.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from ..base.errors import OptionError, suggest
from .neighborhoods import ADAPTIVE, Neighborhood, split_words

#: Raise it when values of existing features change: models that were trained with another version
#: then warn. tests/test_algorithm_versions.py compares values of all kinds of neighborhoods and
#: features with stored ones; run as a program, it stores those of the new version.
ALGORITHM_VERSION = 1
#: Bins of a shape distribution's histogram [B16 3.2.2]. With another number, models and files of
#: thresholds that have shapes are refused and must be made again.
SHAPE_BINS = 10
#: Groups whose features are computed from the moments of a neighborhood, by ``moments.finish``.
_OF_MOMENTS = ("covariance", "geometric", "relative")


@dataclass(frozen=True)
class Feature:
    """A feature of a neighborhood."""

    name: str  #: without the neighborhood's suffix
    group: str  #: covariance, geometric, shapes, relative or surfaces
    unit: str  #: 1 for ratios
    definition: str
    #: Kinds of neighborhoods that have the feature; empty for all.
    kinds: tuple[str, ...] = ()


#: Shape distribution -> what is measured [B16 3.2.2].
SHAPES = {
    "A3": "angle between two pulled points seen from a third",
    "D1": "distance of a pulled point from the centroid",
    "D2": "distance between two pulled points",
    "D3": "square root of the area of three pulled points",
    "D4": "cube root of the volume of four pulled points",
}

#: Every feature, in the order of the columns. e1 >= e2 >= e3 are the eigenvalues l1, l2, l3
#: divided by their sum, n is the unit eigenvector of l3.
FEATURES = (
    Feature("Linearity", "covariance", "1", "(e1 - e2) / e1"),
    Feature("Planarity", "covariance", "1", "(e2 - e3) / e1"),
    Feature("Scattering", "covariance", "1", "e3 / e1"),
    Feature("Omnivariance", "covariance", "1", "cube root of e1 e2 e3"),
    Feature("Anisotropy", "covariance", "1", "(e1 - e3) / e1"),
    Feature("Eigenentropy", "covariance", "1", "-(e1 ln e1 + e2 ln e2 + e3 ln e3), 0 ln 0 = 0"),
    Feature("EigenvalueSum", "covariance", "m²", "l1 + l2 + l3"),
    Feature("SurfaceVariation", "covariance", "1", "e3"),
    Feature("Density", "geometric", "1/m² or 1/m³",
            "n / (π r²) of cylinders, n / (4/3 π r³) of the rest"),
    Feature("Verticality", "geometric", "1", "1 - abs(nz)"),
    Feature("HeightRange", "geometric", "m", "highest minus lowest z"),
    Feature("HeightStd", "geometric", "m", "standard deviation of z (divisor n)"),
    Feature("Radius", "geometric", "m", "the chosen radius; kopt, ropt, rdim and copt only",
            ADAPTIVE),
    *(
        Feature(f"{metric}_{number}", "shapes", "1", f"share of pulls in bin {number}: {measured}")
        for metric, measured in SHAPES.items()
        for number in range(SHAPE_BINS)
    ),
    Feature("HeightAboveLowest", "relative", "m",
            "z of the point minus lowest z of the neighborhood [HWS16]"),
    Feature("NormalAgreement", "surfaces", "1",
            "mean abs(n·n′) of the normals of the point and its neighbors", ("knn",)),
    Feature("SurfaceVariationMin", "surfaces", "1",
            "lowest surface variation of the neighbors", ("knn",)),
    Feature("SurfaceVariationMean", "surfaces", "1",
            "mean surface variation of the neighbors", ("knn",)),
    Feature("SurfaceVariationStd", "surfaces", "1",
            "standard deviation of the neighbors' surface variation", ("knn",)),
)  # fmt: skip

BY_NAME = {feature.name: feature for feature in FEATURES}


def _names(*groups: str) -> tuple[str, ...]:
    """Return the names of the features of groups, in the order of the columns."""
    return tuple(feature.name for feature in FEATURES if feature.group in groups)


#: Features that ``moments.finish``, the shape kernels and ``neighbor_surfaces.agreement``
#: compute, in the order of their rows.
MOMENT_FEATURES = _names(*_OF_MOMENTS)
SHAPE_FEATURES = _names("shapes")
SURFACE_FEATURES = _names("surfaces")

#: Words for several features at once. "all" is what the papers have: neither relative features nor
#: surfaces.
GROUPS: dict[str, tuple[str, ...]] = {
    "all": _names("covariance", "geometric", "shapes"),
    **{group: _names(group) for group in ("covariance", "geometric", "shapes", "surfaces")},
    "he2017": (
        "Linearity", "Planarity", "Scattering", "SurfaceVariation", "Verticality", "HeightRange",
    ),
    **{metric: tuple(f"{metric}_{b}" for b in range(SHAPE_BINS)) for metric in SHAPES},
}  # fmt: skip


def rows_of(*names: str) -> Any:
    """Return the rows of a kernel's table by name: a named tuple, whose values kernels see."""
    return namedtuple("Rows", names)(*range(len(names)))


def parse_feature_set(spec: str | Iterable[str]) -> tuple[str, ...]:
    """Return the words of a feature set, each once, spelled as in the tables.

    Words are groups, features and features of one neighborhood (``Linearity_c1``). Case does not
    matter for groups and features.

    Raises
    ------
    OptionError
        For a word that is neither; it names the nearest known one.
    """
    known = {name.lower(): name for name in (*GROUPS, *BY_NAME)}
    names: dict[str, None] = {}
    for word in split_words(spec, "feature_set"):
        heads = [head for head in known if f"{word}_".startswith(f"{head}_")]
        if not heads:
            single = [f.name for f in BY_NAME.values() if f.group != "shapes"]
            raise OptionError(
                f"unknown feature or group '{word}'",
                cure=f"{suggest(word, (*GROUPS, *BY_NAME))}Groups: {', '.join(GROUPS)}; "
                f"features: {', '.join(single)}",
            )
        head = max(heads, key=len)  # a feature of one neighborhood keeps its suffix
        names[known[head] + word[len(head) :]] = None
    if not names:
        raise OptionError(
            "'feature_set' names no feature", found=repr(spec), cure="Write all, or leave it out"
        )
    return tuple(names)


def features_of(neighborhoods: Sequence[Neighborhood]) -> dict[str, tuple[Neighborhood, str]]:
    """Return the full name of every feature that neighborhoods have -> neighborhood, feature."""
    return {
        f"{feature.name}_{neighborhood.suffix}": (neighborhood, feature.name)
        for neighborhood in neighborhoods
        for feature in BY_NAME.values()
        if not feature.kinds or neighborhood.kind in feature.kinds
    }


def expand_words(neighborhoods: Sequence[Neighborhood], words: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of the features that words name, in the order of the columns.

    Words are groups, features, or features of one neighborhood. OptionError where no neighborhood
    has one of these.
    """
    known = features_of(neighborhoods)
    wanted = {name for word in words for name in GROUPS.get(word, (word,))}
    names = tuple(full for full, (_, feature) in known.items() if {full, feature} & wanted)
    lost = [word for word in words if word not in {*GROUPS, *BY_NAME, *names}]
    if lost or not names:
        kinds = {kind for name in wanted & BY_NAME.keys() for kind in BY_NAME[name].kinds}
        raise OptionError(
            f"none of the neighborhoods has the feature '{', '.join(lost or words)}'",
            found=", ".join(neighborhood.token for neighborhood in neighborhoods),
            cure=f"It exists for {', '.join(sorted(kinds))} only" if kinds and not lost else None,
        )
    return names
