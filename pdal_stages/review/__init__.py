"""What a person should look at in classified points, and what he corrected."""

from __future__ import annotations

from .cells import Records, Settings, side_for
from .expected import Calibration, Outlook, outlook, standard_calibration
from .patches import Patches, find_patches

__all__ = [
    "Calibration",
    "Outlook",
    "Patches",
    "Records",
    "Settings",
    "find_patches",
    "outlook",
    "side_for",
    "standard_calibration",
]
