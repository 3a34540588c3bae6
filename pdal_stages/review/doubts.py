"""What speaks against the class of patches of a review: inputs of the model's first pass there."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION
from ..base.grid import begins_run, cell_keys, cell_numbers, cells_around
from ..classifier.feature_forest import FeatureForest
from ..classifier.interface import ModelObserver, PassInputs
from ..classifier.model import Model
from .words import show_value, words_for

#: Inputs that are named.
_COUNT = 2
#: Side in meters of squares: the points of those of patches and of the eight around are looked at.
_SQUARE_M = 64.0


class _Reasons(NamedTuple):
    """Inputs that a pass read of a point, and what they added."""

    probabilities: NDArray[np.float64]  #: (classes,)
    values: NDArray[np.float32]  #: (inputs,)
    added: NDArray[np.float64]  #: (inputs, classes) to the probabilities


@dataclass
class _FirstPass(ModelObserver):
    """Observer of the first pass of a model."""

    model: Model
    reasons: dict[int, _Reasons] = field(default_factory=dict)  #: by the row of a point

    def see_inputs(self, inputs: PassInputs) -> None:
        """Keep what each input adds to the probabilities, where the learner can tell."""
        single = self.model.passes[0]
        if not isinstance(single, FeatureForest):
            return
        if (contributions := single.contributions(inputs.values)) is not None:
            each = zip(inputs.probabilities, inputs.values, contributions[1], strict=True)
            reasons = itertools.starmap(_Reasons, each)
            self.reasons |= zip(inputs.rows.tolist(), reasons, strict=True)

    def describe(self, row: int, code: int) -> str:
        """Return the inputs that lower the probability of a class most, beside its rival's."""
        if row not in self.reasons:
            return ""
        known, reasons = self.model.codes.tolist(), self.reasons[row]
        if code in (LOW_VEGETATION, MEDIUM_VEGETATION) and code not in known:
            code = HIGH_VEGETATION
        of_class = reasons.added[:, known.index(code)] if code in known else 0.0
        shares = np.where(np.array(known) == code, -1.0, reasons.probabilities)
        speaks = of_class - reasons.added[:, int(shares.argmax())]
        names = self.model.plan.names
        worst = [at for at in np.argsort(speaks, kind="stable")[:_COUNT].tolist() if speaks[at] < 0]
        values = {names[at]: float(reasons.values[at]) for at in worst}
        return "; ".join(f"{words_for(n)[0]}: {show_value(n, v)}" for n, v in values.items())


def inputs_against(
    points: Mapping[str, NDArray], places: NDArray[np.float64], side: float, model: Model
) -> Iterator[str]:
    """Yield for each place the inputs that speak most against the class there, in words.

    Only the first pass of the model is computed, and of each place only one point: the least
    reliable one of its cell. The ground that heights are above is found in squares around the
    places. A text is empty where nothing is known.

    Parameters
    ----------
    points : mapping
        Of a file: ``xyz`` (n, 3) in meters, ``codes`` and ``Reliability`` (n,), and return numbers
        where they are known.
    places : (m, 2) float64
        In meters.
    side : float
        Of the cells that the places lie in, meters.
    model : Model
    """
    squares = cells_around(_cells(places, _SQUARE_M))
    near = np.isin(_cells(points["xyz"], _SQUARE_M), squares)
    xyz, codes = points["xyz"][near], points["codes"][near]
    cells, wanted = _cells(xyz, side), _cells(places, side)
    rows = np.flatnonzero(np.isin(cells, wanted))
    rows = rows[np.lexsort((points["Reliability"][near][rows], cells[rows]))]
    rows = rows[begins_run(cells[rows])]
    chosen = np.zeros(len(xyz), np.bool_)
    chosen[rows] = True
    first = model.first_pass
    names = [name for name in first.optional_dimensions if name in points]
    seen = _FirstPass(first)
    first.predict(xyz, {name: points[name][near] for name in names}, chosen, observer=seen)
    row_of_cell = dict(zip(cells[rows].tolist(), rows.tolist(), strict=True))
    for cell in wanted.tolist():
        row = row_of_cell.get(cell)
        yield "" if row is None else seen.describe(row, int(codes[row]))


def _cells(xyz: NDArray[np.float64], side: float) -> NDArray[np.int64]:
    """Return the keys of the cells that points (n, 2 or 3) lie in."""
    return cell_keys(cell_numbers(xyz[:, 0], side), cell_numbers(xyz[:, 1], side))
