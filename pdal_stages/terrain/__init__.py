"""Heights of points above the ground, and noise around it.

The published minima grid [W18] and filtered ground [P13].
"""

from .heights import filtered_ground
from .minima import hag_minima
from .noise import detached_noise

__all__ = ["detached_noise", "filtered_ground", "hag_minima"]
