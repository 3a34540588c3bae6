"""Context of a pass: probabilities of the pass before around a point, as features.

Space is cut into cells of an absolute grid. The probabilities of the pass before, counted in
65535ths, are added as whole numbers over a point's own cell and the cells around it and divided by
the number of points there. So a value has the same bits for any order of points, number of threads,
and in any tile that holds those cells; and a point costs as much in a dense cloud as in a sparse
one.

What a token means has no version in model files: a change gets a new token (CONTRIBUTING.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..base.asprs import GROUND
from ..base.errors import ModelError, OptionError
from ..base.grid import compact_keys, places_among
from ..base.threads import map_blocks
from ..features.cell_means import WHOLE, cell_means
from ..features.neighborhoods import SIDES
from . import lines, segments
from .lines import LineContext, describe_lines
from .segments import SegmentContext, describe_segments

#: Word of a token, before the side of a cell in meters: axes of the cells (3 x 3 x 3 around the
#: point's, or 3 x 3 columns of any height), and whether it reads shares of votes for each class in
#: place of mean probabilities.
CELLS = {"box": (3, False), "column": (2, False), "boxvotes": (3, True), "columnvotes": (2, True)}

#: The token of the point's own probabilities.
OWN = "own"
#: Word of a token, which the code of a class follows: what its segments are like.
SEGMENTS = "segments"
#: Word of a token, which the code of a class follows: what its lines are like.
LINES = "lines"
#: Dimension that segments read.
HEIGHT = "HeightAboveGround"


@dataclass(frozen=True)
class Context:
    """Features of the surroundings that a pass reads; OptionError for an unknown token."""

    #: ``own``, a word of :data:`CELLS` and a side (``box1``, ``columnvotes8``), ``segments6`` or
    #: ``lines14``
    tokens: tuple[str, ...]

    def __post_init__(self) -> None:
        """Raise an OptionError for an unknown token."""
        self.scales  # noqa: B018  refused when it is made

    @classmethod
    def parse(cls, tokens: str | Iterable[str]) -> Context:
        """Return the context of a list of tokens, or of text with commas between them."""
        parts = tokens.split(",") if isinstance(tokens, str) else list(tokens)
        return cls(tuple(dict.fromkeys(str(part).strip() for part in parts if str(part).strip())))

    @cached_property
    def scales(self) -> dict[str, tuple[float, int, bool]]:
        """Side of the cells, axes, and whether votes are read, by token that has cells."""
        scales = {}
        for token in self.tokens:
            if token == OWN or token in {**self.segment_codes, **self.line_codes}:
                continue
            match = re.fullmatch(rf"({'|'.join(CELLS)})(\d+(?:\.\d+)?)", token)
            if match is None or float(match[2]) not in SIDES:
                raise OptionError(
                    "a token of 'context' is not known",
                    found=repr(token)[:60],
                    cure=f"Write {OWN}, or {', '.join(CELLS)} and a side in meters that is a power "
                    f"of two from {SIDES[0]:g} to {SIDES[-1]:g}: box1, column8; or {SEGMENTS} or "
                    f"{LINES} and the code of a class",
                )
            scales[token] = (float(match[2]), *CELLS[match[1]])
        return scales

    @cached_property
    def segment_codes(self) -> dict[str, int]:
        """Class of the tokens of segments."""
        return self._codes(SEGMENTS)

    @cached_property
    def line_codes(self) -> dict[str, int]:
        """Class of the tokens of lines."""
        return self._codes(LINES)

    def _codes(self, word: str) -> dict[str, int]:
        """Return the class of the tokens that are a word and a code."""
        matches = {token: re.fullmatch(rf"{word}(\d{{1,3}})", token) for token in self.tokens}
        return {token: int(match[1]) for token, match in matches.items() if match}

    @property
    def strip(self) -> float:
        """Width in meters of strips: a point reads three of them; 0 without context."""
        sides = [side for side, _, _ in self.scales.values()]
        blocks = [segments.RULES.block] * bool(self.segment_codes)
        blocks += [lines.RULES.block] * bool(self.line_codes)
        return max(sides + blocks, default=0.0)

    @property
    def reach(self) -> float:
        """Meters, along x or y, to the farthest point that can matter."""
        return 2.0 * self.strip

    def names(self, codes: Sequence[int]) -> tuple[str, ...]:
        """Return names of columns like ``Probability_2_box0_5``, by classes of the pass before."""
        names: list[str] = []
        for token in self.tokens:
            features: Sequence[str] = [f"Probability_{code}" for code in codes]
            if token in self.segment_codes:
                features = segments.COLUMNS
            elif token in self.line_codes:
                features = lines.COLUMNS
            names += [f"{feature}_{token.replace('.', '_')}" for feature in features]
        return tuple(names)

    def cell_means(
        self,
        xyz: npt.NDArray[np.float64],
        shares: npt.NDArray[np.uint16],
        threads: int | None = None,
        codes: Sequence[int] = (),
        height: npt.ArrayLike | None = None,
    ) -> CellContext:
        """Return the mean shares of all cells, the segments and the lines.

        Parameters
        ----------
        xyz : (n, 3) float64
            Meters. Cells of points whose columns will be wanted must be complete, and so must those
            around them.
        shares : (n, classes) uint16
            Of each point; see :func:`count_shares`.
        codes : sequence of int
            Classes of the shares; only segments and lines need them.
        height : (n,) array_like
            Heights above ground in meters; only segments need them.
        """
        ground = codes.index(GROUND) if GROUND in codes else None

        def compute(token: str) -> CellMeans | SegmentContext | LineContext:
            if token in self.line_codes:
                return describe_lines(xyz, shares, codes.index(self.line_codes[token]), ground)
            if token in self.segment_codes:
                assert height is not None
                # Votes for ground do not count against those of a segment.
                heights, target = np.asarray(height, np.float64), self.segment_codes[token]
                return describe_segments(xyz, shares, heights, codes.index(target), ground)
            side, axes, votes = self.scales[token]
            return CellMeans(*cell_means(xyz[:, :axes], shares, side, votes))

        tokens = [token for token in self.tokens if token != OWN]
        parts = map_blocks(compute, tokens, threads)
        return CellContext(self.tokens, shares, dict(zip(tokens, parts, strict=True)))

    def check_codes(self, codes: Sequence[int], dimensions: Sequence[str]) -> None:
        """Raise a ModelError where segments or lines need what is not there.

        `codes` are the classes of the pass before, `dimensions` what the pass reads of the points.
        """
        for token, code in self.segment_codes.items():
            if code not in codes or HEIGHT not in dimensions:
                raise ModelError(
                    f"the context '{token}' needs class {code} and the dimension {HEIGHT}",
                    found=f"classes {list(codes)}; dimensions {', '.join(dimensions)}"[:200],
                    cure=f"Name {HEIGHT} among the dimensions, or leave '{token}' out of the "
                    "context",
                )
        for token, code in self.line_codes.items():
            if code not in codes:
                raise ModelError(
                    f"the context '{token}' needs class {code}",
                    found=f"classes {list(codes)}"[:200],
                    cure=f"Train on wires, or leave '{token}' out of the context",
                )

    def own_probabilities(
        self, columns: npt.NDArray[np.float32], classes: int
    ) -> npt.NDArray[np.float64]:
        """Return the point's own probabilities (n, classes) among these columns."""
        before = Context(self.tokens[: self.tokens.index(OWN)])
        first = len(before.names(range(classes)))
        p = columns[:, first : first + classes].astype(np.float64)
        return p / np.maximum(p.sum(axis=1, keepdims=True), 1e-9)


@dataclass(frozen=True, eq=False)
class CellMeans:
    """Means over cells and those around each, as the n points of a cloud read them."""

    cell: npt.NDArray  #: (n,) row of each point's cell in the table
    means: npt.NDArray  #: (cells, classes)

    def columns(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the means (b, classes) around some of the points."""
        return self.means[self.cell[rows]]


@dataclass(frozen=True, eq=False)
class CellContext:
    """Context of the n points of some ground."""

    tokens: tuple[str, ...]
    shares: npt.NDArray[np.uint16]  #: (n, classes) of the points themselves
    #: of the tokens that look farther than the point
    surroundings: Mapping[str, CellMeans | SegmentContext | LineContext]

    def columns(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return the columns (b, columns) of some of the points, token by token."""
        parts = [
            self.shares[rows] / WHOLE if token == OWN else self.surroundings[token].columns(rows)
            for token in self.tokens
        ]
        return np.concatenate(parts, axis=1, dtype=np.float32)


def count_shares(probabilities: npt.NDArray) -> npt.NDArray[np.uint16]:
    """Return probabilities (n, classes) in 65535ths."""
    return np.rint(np.asarray(probabilities) * WHOLE).astype(np.uint16)


def rows_needed(
    xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, context: Context
) -> npt.NDArray[np.int64] | None:
    """Return the rows, ascending, that the context of some rows depends on; None for all.

    A row brings all rows of its cell.
    """
    if rows is None or not len(rows) or not context.strip:
        return rows
    keys, offsets = compact_keys(xyz[:, :2], context.strip)
    wanted = np.unique(keys[rows])
    near = np.unique(np.add.outer(np.add.outer(wanted, offsets), np.array([-1, 0, 1])))
    needed = np.flatnonzero(places_among(near, keys)[1])
    return None if len(needed) == len(xyz) else needed
