"""Surface materials: reflectance at 1064 nm and colour, so that intensity and RGB look like a scan's."""

from __future__ import annotations

import numpy as np

_TABLE: tuple[tuple[str, float, tuple[int, int, int]], ...] = (
    ("asphalt", 0.14, (92, 92, 97)),
    ("paving", 0.28, (158, 152, 144)),
    ("lawn", 0.48, (104, 132, 70)),
    ("soil", 0.30, (138, 112, 84)),
    ("gravel", 0.30, (150, 146, 138)),
    ("water", 0.04, (58, 82, 92)),
    ("stone", 0.30, (140, 134, 124)),
    ("tile", 0.32, (168, 86, 62)),
    ("slate", 0.16, (84, 86, 94)),
    ("flat_roof", 0.26, (152, 150, 146)),
    ("metal", 0.52, (176, 182, 188)),
    ("plaster", 0.55, (222, 212, 192)),
    ("brick", 0.36, (156, 98, 80)),
    ("leaf", 0.50, (72, 112, 52)),
    ("needle", 0.40, (48, 84, 58)),
    ("bark", 0.30, (104, 88, 70)),
    ("cable", 0.30, (70, 70, 74)),
    ("steel", 0.36, (128, 134, 138)),
    ("paint", 0.42, (150, 44, 48)),
    ("concrete", 0.36, (176, 172, 166)),
    ("grass", 0.52, (140, 150, 84)),
    ("air", 0.20, (230, 230, 230)),
    ("glass", 0.10, (96, 112, 122)),
)

NAMES = tuple(name for name, _, _ in _TABLE)
REFLECTANCE = np.array([r for _, r, _ in _TABLE])
RGB = np.array([c for _, _, c in _TABLE], dtype=np.uint8)
CODE = {name: code for code, name in enumerate(NAMES)}
