"""Heights of points above the ground: the published minima grid [W18], and filtered ground [P13]; noise around it."""

from .detached import detached_noise
from .minima import MinimaTerrain, hag_minima
from .morphological import filtered_ground

__all__ = ["MinimaTerrain", "detached_noise", "filtered_ground", "hag_minima"]
