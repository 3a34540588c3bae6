"""What a person should look at in classified points, and what he corrected."""

from __future__ import annotations

from .cells import ReviewCells, side_for
from .patches import Patches, find_patches

__all__ = ["Patches", "ReviewCells", "find_patches", "side_for"]
