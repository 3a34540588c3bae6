"""Context: what the pass before said of a point's surroundings, as features of the next pass.

Space is cut into cells of an absolute grid. The probabilities of the pass before, counted in 65535ths, are added as
whole numbers over a point's own cell and the cells around it and divided by the number of points there. So a value
has the same bits for any order of points, number of threads, and in any tile that holds those cells; and a point
costs as much in a dense cloud as in a sparse one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.grid import compact_keys, places_among
from ..base.threads import map_blocks
from ..features.cell_means import WHOLE, cell_means
from ..features.neighborhoods import SIDES

#: Word of a token, which the side of a cell in meters follows: axes of the cells (3 x 3 x 3 around the point's, or 3 x 3
#: columns of any height), and whether it reads the share of votes for each class in place of mean probabilities.
CELLS = {"box": (3, False), "column": (2, False), "boxvotes": (3, True), "columnvotes": (2, True)}

#: The token of the point's own probabilities.
OWN = "own"


@dataclass(frozen=True)
class Context:
    """Which features of the surroundings a pass reads; OptionError for a token that is not one."""

    tokens: tuple[
        str, ...
    ]  #: ``own``, or a word of :data:`CELLS` and a side: ``box1``, ``columnvotes8``

    def __post_init__(self) -> None:
        self.scales  # noqa: B018  refused when it is made

    @classmethod
    def parse(cls, tokens: str | Iterable[str]) -> Context:
        """From a list of tokens, or text with commas between them."""
        parts = tokens.split(",") if isinstance(tokens, str) else list(tokens)
        return cls(tuple(dict.fromkeys(str(part).strip() for part in parts if str(part).strip())))

    @cached_property
    def scales(self) -> dict[str, tuple[float, int, bool]]:
        """Of the tokens that have cells: side, and what :data:`CELLS` says."""
        found = {}
        for token in self.tokens:
            match = re.fullmatch(rf"({'|'.join(CELLS)})(\d+(?:\.\d+)?)", token)
            if token != OWN and (match is None or float(match[2]) not in SIDES):
                raise OptionError(
                    "a token of 'context' is not known",
                    found=repr(token)[:60],
                    cure=f"Write {OWN}, or {', '.join(CELLS)} and a side in meters that is a power of two "
                    f"from {SIDES[0]:g} to {SIDES[-1]:g}: box1, column8",
                )
            if match:
                found[token] = (float(match[2]), *CELLS[match[1]])
        return found

    @property
    def strip(self) -> float:
        """Width in meters of strips such that a point's cells all lie in its own and the two beside it; 0 without cells."""
        return max((side for side, _, _ in self.scales.values()), default=0.0)

    @property
    def reach(self) -> float:
        """Meters, along x or y, to the farthest point that can matter."""
        return 2.0 * self.strip

    def names(self, codes: Sequence[int]) -> tuple[str, ...]:
        """Columns, token by token, in each the classes of these codes: ``Probability_2_box0_5``."""
        return tuple(
            f"Probability_{code}_{token.replace('.', '_')}"
            for token in self.tokens
            for code in codes
        )

    def cell_means(
        self,
        xyz: npt.NDArray[np.float64],
        shares: npt.NDArray[np.uint16],
        threads: int | None = None,
    ) -> CellContext:
        """Return the mean shares of all cells.

        Parameters
        ----------
        xyz : (n, 3) float64
            Meters. Cells of points whose columns will be wanted must be complete, and so must those around them.
        shares : (n, classes) uint16
            Of each point; see :func:`count_shares`.
        """
        jobs = [(xyz[:, :axes], shares, side, votes) for side, axes, votes in self.scales.values()]
        means = map_blocks(_cell_means, jobs, threads)
        return CellContext(self.tokens, shares, dict(zip(self.scales, means, strict=True)))

    def own(self, columns: npt.NDArray[np.float32], classes: int) -> npt.NDArray[np.float64]:
        """(n, classes) of these columns: the point's own probabilities."""
        first = self.tokens.index(OWN) * classes
        said = columns[:, first : first + classes].astype(np.float64)
        return said / np.maximum(said.sum(axis=1, keepdims=True), 1e-9)


@dataclass(frozen=True, eq=False)
class CellContext:
    """Context of the n points of some ground."""

    tokens: tuple[str, ...]
    shares: npt.NDArray[np.uint16]  #: (n, classes) of the points themselves
    #: of the tokens that have cells: (n,) the cell of each point, (cells, classes) the means around each cell
    cells: Mapping[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]]

    def columns(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the columns (b, tokens * classes) of some of the points."""
        classes = self.shares.shape[1]
        out = np.empty((len(rows), len(self.tokens) * classes), np.float32)
        for k, token in enumerate(self.tokens):
            part = out[:, k * classes : (k + 1) * classes]
            if token == OWN:
                part[:] = self.shares[rows] / WHOLE
            else:
                cell, mean = self.cells[token]
                part[:] = mean[cell[rows]]
        return out


def _cell_means(job: tuple[Any, ...]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Call :func:`cell_means` in a worker thread."""
    return cell_means(*job)


def count_shares(probabilities: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Probabilities (n, classes) in 65535ths."""
    return np.rint(np.asarray(probabilities) * WHOLE).astype(np.uint16)


def around(
    xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, context: Context
) -> npt.NDArray[np.int64] | None:
    """Points whose probabilities the context of some points can depend on, ascending; None for all.

    These are whole cells: what of a cell is asked for is all of it.
    """
    if rows is None or not len(rows) or not context.scales:
        return rows
    keys, offsets = compact_keys(xyz[:, :2], context.strip)
    wanted = np.unique(keys[rows])
    near = np.unique(np.add.outer(np.add.outer(wanted, offsets), np.array([-1, 0, 1])))
    found = np.flatnonzero(places_among(near, keys)[1])
    return None if len(found) == len(xyz) else found
