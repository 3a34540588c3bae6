"""How many points of a cell are wrong, as far as can be told without knowing: learned from surveys a model had not seen.

Two steps, both tables of numbers. Reliability and height say of a point of a class how often such points are wrong.
What lies around its cell makes that more or less: each signal has bins, each bin a factor, and factors are multiplied.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cells import BINS, GROUPS, HEIGHT, RELIABILITY, Records
from .signals import JUDGED, Signals, signals

#: Bounds of the bins of each signal.
BOUNDS: dict[str, tuple[float, ...]] = {
    "own_around": (0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99),
    "building_around": (0.01, 0.05, 0.2, 0.5, 0.8),
    "vegetation_around": (0.01, 0.05, 0.2, 0.5, 0.8),
    "rate": (0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.35),
    "rate_around": (0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.35),
    "raised": (0.5, 1.0, 2.0, 4.0),
    "void": (0.1, 5.0, 10.0, 20.0),
    "full": (0.5, 0.75, 0.95),
    "relief": (0.5, 1.0, 2.0, 4.0, 8.0),
    "tall": (0.5, 2.0, 5.0, 10.0, 20.0),
    "doubtful": (0.02, 0.2),
    "contrary": (0.01, 0.05, 0.2),
    "strips": (0.02, 0.1, 0.3),
}
#: Bounds of what is looked at to say whether a cell is like any that was learned from.
KINDS: dict[str, tuple[float, ...]] = {
    "density": (0.2, 0.8, 3.0, 12.0, 50.0, 200.0),
    "tall": (0.5, 3.0, 10.0, 25.0, 60.0),
    "relief": (1.0, 4.0, 12.0),
}
#: Shares of wrong points are between these.
LEAST, MOST = 1e-5, 0.97
_FORMAT = "pdal-stages review calibration"


def columns_of(found: Signals, group: int) -> dict[str, NDArray[np.float64]]:
    """The value of each signal of :data:`BOUNDS` for the points of a group, (n,)."""
    return {
        "own_around": found.around[:, group],
        "building_around": found.around[:, 2],
        "vegetation_around": found.around[:, 1],
        "rate": found.rate[:, group],
        "rate_around": found.rate_around[:, group],
        **{
            name: getattr(found, name)
            for name in ("raised", "void", "full", "relief", "tall", "doubtful", "contrary", "strips")
        },
    }


def binned(found: Signals, group: int) -> NDArray[np.int64]:
    """(n, signals) the bin of each signal."""
    columns = columns_of(found, group)
    return np.stack(
        [np.searchsorted(bounds, columns[name], side="right") for name, bounds in BOUNDS.items()], axis=1
    )


def kinds_of(found: Signals) -> NDArray[np.int64]:
    """(n,) a number for the kind of each cell: its density, the heights in it, its slope, what most points are."""
    out = found.around[:, :3].argmax(axis=1)
    for name, bounds in KINDS.items():
        out = out * (len(bounds) + 1) + np.searchsorted(bounds, getattr(found, name), side="right")
    return out


@dataclass(frozen=True)
class Calibration:
    """What was learned from held-out surveys.

    Attributes
    ----------
    rates : (4, reliabilities, heights) float64
        Share of wrong points in each bin.
    factors : for each of ground, vegetation and building a tuple with one array for each signal
        What the rate is multiplied by.
    base : (3,) float64
        By which it is multiplied in any case.
    known : frozenset of int
        Kinds of cells that were there; see :func:`kinds_of`.
    about : dict
        What it was learned from.
    """

    rates: NDArray[np.float64]
    factors: tuple[tuple[NDArray[np.float64], ...], ...]
    base: NDArray[np.float64]
    known: frozenset[int]
    about: Mapping[str, Any]

    def shares(self, found: Signals) -> NDArray[np.float64]:
        """(n, 3) share of the points of each group in each cell that are expected wrong."""
        out = np.empty((len(found.raised), len(JUDGED)))
        for group in JUDGED:
            bins, factor = binned(found, group), np.full(len(out), self.base[group])
            for column, values in enumerate(self.factors[group]):
                factor *= values[bins[:, column]]
            out[:, group] = np.minimum(found.rate[:, group] * factor, MOST)
        return out

    def to_json(self) -> str:
        """As text; numbers have four digits."""

        def short(values: NDArray) -> Any:
            return json.loads(
                json.dumps(values.tolist()), parse_float=lambda text: float(f"{float(text):.4g}")
            )

        return json.dumps(
            {
                "format": _FORMAT,
                "version": 1,
                "about": dict(self.about),
                "groups": GROUPS,
                "reliability": RELIABILITY,
                "height": HEIGHT,
                "rates": short(self.rates),
                "signals": {name: list(bounds) for name, bounds in BOUNDS.items()},
                "base": short(self.base),
                "factors": [[short(one) for one in group] for group in self.factors],
                "known": sorted(self.known),
            },
            indent=None,
            separators=(",", ":"),
        ).replace('],"', '],\n"')

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """What :meth:`to_json` gave."""
        said = json.loads(text)
        same = said["signals"] == {name: list(bounds) for name, bounds in BOUNDS.items()}
        assert said["format"] == _FORMAT and same, "the calibration is of another version"
        return cls(
            np.array(said["rates"]).reshape(len(GROUPS), *BINS),
            tuple(tuple(np.array(one) for one in group) for group in said["factors"]),
            np.array(said["base"]),
            frozenset(said["known"]),
            said["about"],
        )


@lru_cache(maxsize=1)
def standard_calibration() -> Calibration:
    """That of the shipped model, on surveys it was not trained on."""
    return Calibration.from_json(Path(__file__).with_name("standard.json").read_text(encoding="utf-8"))


@dataclass
class Outlook:
    """What is expected of each cell.

    Attributes
    ----------
    records : Records
    found : Signals
    errors : (n, 3) float64
        Points of each group expected wrong.
    unknown : (n,) bool
        Cells like none that was learned from.
    """

    records: Records
    found: Signals
    errors: NDArray[np.float64]
    unknown: NDArray[np.bool_]

    @property
    def total(self) -> NDArray[np.float64]:
        """(n,) points expected wrong."""
        return self.errors.sum(axis=1)


def outlook(records: Records, calibration: Calibration) -> Outlook:
    """What is expected of each cell of the records."""
    found = signals(records)
    errors = calibration.shares(found) * records.points[:, : len(JUDGED)]
    unknown = ~np.isin(kinds_of(found), np.fromiter(calibration.known, np.int64))
    return Outlook(records, found, errors, unknown)
