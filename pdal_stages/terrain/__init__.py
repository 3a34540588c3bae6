"""Heights of points above the ground: the published minima grid [W18], and filtered ground [P13]."""

from .minima import MinimaTerrain, hag_minima
from .morphological import filtered_ground

__all__ = ["MinimaTerrain", "filtered_ground", "hag_minima"]
