"""Heights of points above the ground: the published minima grid [W18]."""

from .minima import MinimaTerrain, hag_minima

__all__ = ["MinimaTerrain", "hag_minima"]
