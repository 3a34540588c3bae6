"""Tokens (``c2``, ``s1``, ``k50``, ``kopt``, ``ropt``, ``rdim``, ``copt``) and presets.

One token is used alike in options, dimension suffixes, model files and documents. Sources: [B16]
Blomley, Jutzi, Weinmann 2016, doi:10.5194/isprsannals-III-3-169-2016; [W18] Weinmann, Blomley,
Weinmann, Jutzi 2018 (DGPF); [H17] He, Chen, Wang, Liu 2017, ISPRS Archives XLII-2/W7.

A new kind of neighborhood has its word in ``_TOKEN``, ``_KNOWN`` and ``_CURE``, its parameters in
``_DEFAULTS`` and ``_parse_adaptive``, its ``reach`` below, and its search in
``adaptive._searches``, which finds it among nested neighborhoods.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from ..base.errors import OptionError, suggest

#: Preset name -> (neighborhood tokens, the points' own dimensions it uses as features).
PRESETS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "blomley2016": (("c1", "c2", "c3", "c5", "kopt"), ("Z",)),
    "weinmann2018": (
        ("c1", "c2", "c3", "c5", "s1", "s2", "s3", "s5", "kopt"),
        ("HeightAboveGround",),
    ),
    "he2017": (("copt",), ()),
}

KOPT_DEFAULT = (10.0, 100.0)  # k_min, k_max [B16]
ROPT_DEFAULT = (0.25, 2.0, 0.05)  # r_min, r_max, step in meters [H17]
#: Kinds that choose a radius: by the lowest eigenentropy, or by the lowest entropy of
#: dimensionality (Demantke et al. 2011), which [H17] cites for its v_r.
BY_RADIUS = ("ropt", "rdim")
#: Kinds whose size is chosen point by point.
ADAPTIVE = ("kopt", *BY_RADIUS, "copt")
_DEFAULTS = {"kopt": KOPT_DEFAULT, **dict.fromkeys(BY_RADIUS, ROPT_DEFAULT), "copt": ()}
#: Members below which [H17]'s inadequate neighborhood begins: radii of ``ropt``, ``rdim`` and
#: ``copt`` with fewer are not candidates, and the curvature is 1/3. The paper gives no number; with
#: ten, its c_t of 0.03 and the counts of its Table 1 come out (docs/papers.md), with three they do
#: not.
RADIUS_MEMBERS = 10
COPT_REACH = 3.0  # meters: the cap of the scattered branch, the largest radius copt looks at [H17]
#: Largest k: 100 times the largest of [B16]; the candidates of a search begin with 52 bytes for
#: each of 4 k, so with 2 MB a thread.
MAX_K = 10_000
#: Nearest neighbors that make the surface of a point, of which the group ``surfaces`` tells. The
#: fewest of ``kopt`` [B16]; not tuned.
AROUND = 10
#: Smallest radius, meters: the step of most surveys' coordinates. Density uses it in place of a
#: smaller distance to the k-th neighbor, which is 0 among copies of a point.
MIN_RADIUS = 0.001
MAX_RADIUS = 100_000.0  #: meters: wider than any tile or file; not tuned
#: Neighborhoods of one plan: a model file of a few kB must not ask for hours of work.
MOST = 64

#: Sides of cells of an absolute grid that can be asked for, meters: powers of two, so that corners
#: are exact. From the default voxel of models, 0.125 m, to 64 m, which need a halo of 128; not
#: tuned.
SIDES = tuple(2.0**k for k in range(-3, 7))

_KNOWN = ("c2", "s1", "k50", *ADAPTIVE, *PRESETS)
_NUMBER = r"(?:\d+(?:\.\d*)?|\.\d+)"
_TOKEN = re.compile(
    rf"(?P<kind>[csk])(?P<size>{_NUMBER})"
    rf"|(?P<adaptive>{'|'.join(ADAPTIVE)})(?:\((?P<values>{_NUMBER}(?:,{_NUMBER})*)\))?"
)
_CURE = (
    "Write c2 (vertical cylinder of 2 m radius), s1 (sphere of 1 m), k50 (50 nearest), "
    "kopt, kopt(10,100), ropt, ropt(0.25,2,0.05), rdim, copt, or a preset: " + ", ".join(PRESETS)
)


@dataclass(frozen=True)
class Neighborhood:
    """One neighborhood definition. Make it with :func:`parse_neighborhoods`."""

    #: ``cylinder``, ``sphere``, ``knn``, ``kopt``, ``ropt``, ``rdim`` or ``copt``.
    kind: str
    #: Cylinder and sphere: (radius in meters,); knn: (k,); kopt: (k_min, k_max); ropt and rdim:
    #: (r_min, r_max, step) in meters; copt: ().
    parameters: tuple[float, ...] = ()

    @property
    def token(self) -> str:
        """The shortest token that parses to this neighborhood, e.g. ``c2.5`` or ``kopt(10,50)``."""
        values = [_number(value) for value in self.parameters]
        if self.kind in ("cylinder", "sphere", "knn"):
            return {"cylinder": "c", "sphere": "s", "knn": "k"}[self.kind] + values[0]
        if self.parameters == _DEFAULTS[self.kind]:
            return self.kind
        return f"{self.kind}({','.join(values)})"

    @cached_property
    def suffix(self) -> str:
        """The token made safe for a dimension name: ``c2_5``, ``kopt``, ``kopt10_50``."""
        return self.token.replace("(", "").replace(")", "").replace(",", "_").replace(".", "_")

    @property
    def reach(self) -> float | None:
        """The farthest a member can be, in meters; ``None`` where a number of points decides."""
        if self.kind in ("cylinder", "sphere"):
            return self.parameters[0]
        if self.kind in BY_RADIUS:
            return self.parameters[1]
        return COPT_REACH if self.kind == "copt" else None

    @property
    def fixed(self) -> bool:
        """True for cylinders and spheres, whose size is a radius."""
        return self.kind in ("cylinder", "sphere")

    @property
    def adaptive(self) -> bool:
        """True where the size is chosen point by point, so that there is a feature ``Radius``."""
        return self.kind in ADAPTIVE

    def __str__(self) -> str:
        """Return the token."""
        return self.token


def parse_neighborhoods(spec: str | Iterable[str]) -> list[Neighborhood]:
    """Parse presets and tokens into neighborhoods, in the order given, each one once.

    Parameters
    ----------
    spec : str or iterable
        ``"weinmann2018"``, ``"c1, c2.5, kopt(10,50)"``, or a list of such words.

    Raises
    ------
    OptionError
        For an unknown word or a parameter that makes no sense; it names the word.

    Examples
    --------
    >>> [str(n) for n in parse_neighborhoods("c2.0, s.5, c2, kopt(10,100)")]
    ['c2', 's0.5', 'kopt']
    """
    parsed: dict[str, Neighborhood] = {}
    for word in split_words(spec):
        for token in PRESETS[word][0] if word in PRESETS else (word,):
            neighborhood = _parse_token(token)
            parsed.setdefault(neighborhood.token, neighborhood)
    if not parsed:
        raise OptionError("no neighborhood was given", found=repr(spec), cure=_CURE)
    if len(parsed) > MOST:
        raise OptionError(f"at most {MOST} neighborhoods can be used together", found=len(parsed))
    suffixes = {neighborhood.suffix for neighborhood in parsed.values()}
    if len(suffixes) < len(parsed):  # ropt(1,2.5,1) and ropt(1.2,5,1) would share dimension names
        raise OptionError(
            "two neighborhoods have the same suffix",
            found=", ".join(parsed),
            cure="Use them in two stages",
        )
    return list(parsed.values())


def preset_dimensions(spec: str | Iterable[str]) -> tuple[str, ...]:
    """Return the points' own dimensions that the presets named in `spec` use as features."""
    used = (PRESETS[word][1] for word in split_words(spec) if word in PRESETS)
    return tuple(dict.fromkeys(name for names in used for name in names))


def split_words(spec: object, what: str = "neighborhoods") -> list[str]:
    """Return the words of text or a list of text, in lower case; OptionError for something else."""
    if isinstance(spec, str):
        # A comma inside parentheses belongs to the token.
        return [w.strip().lower() for w in re.split(r",(?![^()]*\))", spec) if w.strip()]
    items = list(spec) if isinstance(spec, Iterable) else [spec]
    if not all(isinstance(item, str) for item in items):
        raise OptionError(f"'{what}' must be text or a list of text", found=repr(spec)[:80])
    return [word for item in items for word in split_words(item)]


def _parse_token(text: str) -> Neighborhood:
    word = "".join(text.split())
    match = _TOKEN.fullmatch(word)
    if match is None:
        raise OptionError(f"unknown neighborhood '{text}'", cure=suggest(word, _KNOWN) + _CURE)
    kind = match["kind"] or match["adaptive"]
    listed = match["size"] or match["values"]
    values = tuple(map(float, listed.split(","))) if listed else _DEFAULTS[kind]
    if kind in ("k", "kopt"):
        length, least = (1, 1) if kind == "k" else (2, 2)
        whole = len(values) == length and all(v == int(v) for v in values)
        fine = whole and least <= values[0] <= values[-1] <= MAX_K
        rule = f"k must be a whole number from {least} to {MAX_K}, of kopt(k_min,k_max) two of them"
    elif kind == "copt":
        fine, rule = not values, "copt takes no values"
    elif kind in BY_RADIUS:
        fine = len(values) == 3 and MIN_RADIUS <= min(values) <= values[0] <= values[1]
        fine = fine and values[1] <= MAX_RADIUS and (values[1] - values[0]) / values[2] <= 1000
        rule = f"{kind}(r_min,r_max,step) takes at most 1000 radii from {MIN_RADIUS} m on"
    else:
        fine = MIN_RADIUS <= values[0] <= MAX_RADIUS
        rule = f"a radius must be from {MIN_RADIUS} to {MAX_RADIUS:g} meters"
    if not fine:
        raise OptionError(rule, found=text)
    kind = {"c": "cylinder", "s": "sphere", "k": "knn"}.get(kind, kind)
    return Neighborhood(kind, tuple(_rounded(value) for value in values))


def _rounded(value: float) -> float:
    """Return the value that a token prints: equal tokens mean equal radii."""
    return float(_number(value))


def _number(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")
