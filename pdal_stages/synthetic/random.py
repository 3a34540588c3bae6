"""Counter-based random numbers: a function of the seed and of what is asked, never of order or threads."""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_TO_UNIT = 1.0 / 9007199254740992.0  # 2 ** -53


@njit(inline="always")
def mix(value):
    """One splitmix64 step (Steele, Lea, Flood 2014): uint64 in, well-mixed uint64 out."""
    value = value + _GOLDEN
    value = (value ^ (value >> _S30)) * _M1
    value = (value ^ (value >> _S27)) * _M2
    return value ^ (value >> _S31)


@njit(inline="always")
def unit(key):
    """A float in [0, 1) from a mixed key."""
    return float(key >> _S11) * _TO_UNIT


@njit(inline="always")
def gauss(key):
    """A standard normal number from a mixed key (Box-Muller)."""
    a = 1.0 - unit(key)
    b = unit(mix(key))
    return math.sqrt(-2.0 * math.log(a)) * math.cos(2.0 * math.pi * b)


@njit
def lattice(i, j, k, key):
    """A float in [0, 1) for a whole-numbered place in space."""
    h = mix(key ^ np.uint64(np.int64(i)))
    h = mix(h ^ np.uint64(np.int64(j)))
    return unit(mix(h ^ np.uint64(np.int64(k))))


@njit
def value_noise(x, y, key):
    """Smooth noise in [0, 1] over the plane, one value per unit square corner."""
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    low = lattice(i, j, 0, key) * (1.0 - fx) + lattice(i + 1, j, 0, key) * fx
    high = lattice(i, j + 1, 0, key) * (1.0 - fx) + lattice(i + 1, j + 1, 0, key) * fx
    return low * (1.0 - fy) + high * fy
