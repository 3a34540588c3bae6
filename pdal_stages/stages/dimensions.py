"""What LAS files say of the dimensions that stages make, beside their names: meaning and unit."""

from __future__ import annotations

import re

#: In at most 31 bytes, which is what the file has room for. ``Z unit``: whatever unit the cloud's heights have.
_MEANINGS = {
    "HeightAboveGround": "above ground (Z unit)",
    "Ground": "1: ground, found by a filter",
    "Slope": "of the terrain, degrees",
    "Deck": "1: bridge deck, found by shape",
    "Reliability": "probability of class",
    "Margin": "best minus second",
    "Variance": "of probabilities",
    "ObjectID": "of building, tree, span, deck",
    "ObjectVerdict": "1: sure, 2: to be checked",
    "ObjectHeight": "height of the object (Z unit)",
    "ObjectExtent": "area, m2; of spans length, m",
}
_FAMILIES = (
    (re.compile(r"HeightAboveOpening_(.+)"), r"above \1 m opening (Z unit)"),
    (re.compile(r"Probability_(\d+)"), r"probability of \1"),
)
#: To which parts of the unit values are rounded: probabilities and the like, and heights.
_PARTS, _PARTS_OF_HEIGHT = 64, 32


def parts_of(name: str) -> int:
    """To which parts of the unit a dimension is rounded."""
    return _PARTS_OF_HEIGHT if name.startswith("Height") else _PARTS


def meaning(name: str, rounded: bool = False) -> str:
    """Meaning and unit of a dimension; empty where nothing is known of it."""
    text = _MEANINGS.get(name, "")
    for pattern, family in _FAMILIES:
        if found := pattern.fullmatch(name):
            text = found.expand(family).replace("_", ".")
    if not rounded or not text:
        return text
    return f"{text}, to 1/{parts_of(name)}"
