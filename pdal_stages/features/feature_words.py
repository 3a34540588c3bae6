"""Words of a feature set (groups, features, features of one neighborhood) and full names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ..base.errors import OptionError, suggest
from .neighborhoods import Neighborhood
from .registry import BY_NAME, GROUPS, SURFACE_FEATURES


def parse_feature_set(spec: str | Iterable[str]) -> tuple[str, ...]:
    """Return the words of a feature set, each once, spelled as in the tables.

    Words are groups, features and features of one neighborhood (``Linearity_c1``). Case does not
    matter for groups and features.

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
    names: dict[str, None] = {}
    for word in (w.strip() for w in words):
        if not word:
            continue
        name = known.get(word.lower())
        if name is None:  # a feature of one neighborhood keeps its suffix
            heads = (name for name in BY_NAME if word.lower().startswith(f"{name.lower()}_"))
            head = max(heads, key=len, default=None)
            if head is None:
                cure = suggest(word, (*GROUPS, *BY_NAME))
                single = [f.name for f in BY_NAME.values() if f.group != "shapes"]
                raise OptionError(
                    f"unknown feature or group '{word}'",
                    cure=f"{cure}Groups: {', '.join(GROUPS)}; features: {', '.join(single)}",
                )
            name = head + word[len(head) :].lower()
        names[name] = None
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
    tokens = ", ".join(neighborhood.token for neighborhood in neighborhoods)
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
