"""Feature names, their order and groups, and what each is: the one table that plans, docs and schemas read.

Definitions use the eigenvalues l1 >= l2 >= l3 >= 0 of a neighborhood's covariance matrix (divisor n) and
e_i = l_i / (l1 + l2 + l3). Sources: [B16] Blomley et al. 2016; [W18] Weinmann et al. 2018; [H17] He et al. 2017;
[HWS16] Hackel, Wegner, Schindler 2016, ISPRS Annals III-3 (their "height below").
"""

from __future__ import annotations

from collections.abc import Iterable

from ..base.errors import OptionError, suggest

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
    "Radius": "the chosen size in meters; kopt, ropt and copt only",
}
#: What the papers' sets of features lack, and "all" therefore leaves out.
RELATIVE = {"HeightAboveLowest": "z of the point minus the lowest z of the neighborhood, meters [HWS16]"}
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
    "he2017": ("Linearity", "Planarity", "Scattering", "SurfaceVariation", "Verticality", "HeightRange"),
    **{metric: tuple(f"{metric}_{b}" for b in range(SHAPE_BINS)) for metric in SHAPES},
}

#: Groups that bring a preset's own dimensions (HeightAboveGround, Z) along.
WITH_DIMENSIONS = ("all", "geometric")

#: Words of PDAL's own filters that mean something else here, in small letters: (PDAL's spelling, what to write).
OF_PDAL = {
    "dimensionality": (
        "Dimensionality",
        "Write Linearity,Planarity,Scattering; PDAL's fourth, its own Verticality, is not computed here (Verticality is "
        "1 - |nz|, PDAL's DemantkeVerticality)",
    ),
    "demantkeverticality": ("DemantkeVerticality", "It is Verticality here, 1 - |nz|"),
    "optimalknn": ("OptimalKNN", "PDAL's filters.optimalneighborhood writes it"),
    "optimalradius": ("OptimalRadius", "Write Radius, with kopt among the neighborhoods"),
}


def describe(feature: str) -> str:
    """One line of what a feature is, for docs and schemas."""
    metric, _, number = feature.partition("_")
    if metric in SHAPES and number:
        return f"share of 255 pulls in bin {number} of 10: {SHAPES[metric]}"
    return {**COVARIANCE, **GEOMETRIC, **SHAPES, **RELATIVE, **SURFACES}[feature]


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
            raise OptionError("'feature_set' must be text or a list of text", found=repr(spec)) from None
    known = {name.lower(): name for name in (*GROUPS, *ALL_FEATURES)}
    found: dict[str, None] = {}
    for word in (w.strip() for w in words):
        if not word:
            continue
        name = known.get(word.lower())
        if name is None:  # a feature of one neighborhood keeps its suffix
            head = _longest_feature(word)
            if word.lower() in OF_PDAL:
                theirs, cure = OF_PDAL[word.lower()]
                raise OptionError(f"'{theirs}' is PDAL's word, not a feature", cure=cure)
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


def _longest_feature(word: str) -> str | None:
    found = (name for name in ALL_FEATURES if word.lower().startswith(name.lower() + "_"))
    return max(found, key=len, default=None)
