"""Inputs of models in the words of the field, with their units."""

from __future__ import annotations

from ..base.dimensions import opening_width
from ..features.gap_below import NAME as GAP_BELOW
from ..features.registry import BY_NAME, SHAPES

#: Feature or dimension -> words, and the unit of its values.
_WORDS = {
    "Linearity": ("how linear, 0 to 1", ""),
    "Planarity": ("how planar, 0 to 1", ""),
    "Scattering": ("how scattered, 0 to 1", ""),
    "Omnivariance": ("how scattered (omnivariance)", ""),
    "Anisotropy": ("1 - scattered (anisotropy)", ""),
    "Eigenentropy": ("disorder (eigenentropy)", ""),
    "EigenvalueSum": ("spread (sum of eigenvalues)", "m2"),
    "SurfaceVariation": ("roughness (surface variation)", ""),
    "Density": ("density", ""),
    "Verticality": ("steepness, 0 flat, 1 a wall", ""),
    "HeightRange": ("highest minus lowest", "m"),
    "HeightStd": ("standard deviation of heights", "m"),
    "Radius": ("radius chosen", "m"),
    "HeightAboveLowest": ("height above the lowest", "m"),
    "NormalAgreement": ("agreement of normals, 1 on a plane", ""),
    "SurfaceVariationMin": ("roughness where it is least", ""),
    "SurfaceVariationMean": ("mean roughness", ""),
    "SurfaceVariationStd": ("how the roughness varies", ""),
    "HeightAboveGround": ("height above ground", "m"),
    "Ground": ("ground by the filter: 1 yes, 0 no", ""),
    "MultipleReturn": ("pulses with several returns", ""),
    "EarlierReturn": ("returns before the last", ""),
    GAP_BELOW: ("empty space below, up to 20", "m"),
}
_AROUND = {"c": "cylinder of {} m", "s": "sphere of {} m", "k": "{} nearest points"}
_CELLS = {"box": "3 x 3 x 3 cells of {} m", "column": "3 x 3 columns of {} m"}


def words_for(name: str) -> tuple[str, str]:
    """Return an input in words, and the unit of its values; of an unknown one its own name."""
    if (width := opening_width(name)) is not None:
        return f"height above what a window of {width:g} m leaves", "m"
    feature, _, where = name.partition("_")
    if feature in SHAPES:
        return SHAPES[feature], "share"
    if feature not in _WORDS:
        return (BY_NAME[feature].definition if feature in BY_NAME else name), ""
    words, unit = _WORDS[feature]
    for heads in (_CELLS, _AROUND):
        for head, text in heads.items():
            size = where.removeprefix(head).replace("_", ".")
            if where.startswith(head) and size.replace(".", "").isdecimal():
                return f"{words}, {text.format(size)}", unit
    return f"{words}, {where}" if where else words, unit


def show_value(name: str, value: float) -> str:
    """Return the value of an input with its unit."""
    value = 0.0 if abs(value) < 5e-4 else value
    return f"{value:.3g} {words_for(name)[1]}".rstrip()
