"""How finely dimensions are rounded that stages write compactly."""

from __future__ import annotations

#: Parts of the unit: probabilities and the like, and heights.
_PARTS, _PARTS_OF_HEIGHT = 64, 32


def parts_of(name: str) -> int:
    """To which parts of the unit a dimension is rounded."""
    return _PARTS_OF_HEIGHT if name.startswith("Height") else _PARTS
