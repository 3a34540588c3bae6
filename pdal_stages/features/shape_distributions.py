"""Shape distributions A3, D1, D2, D3, D4 by random pulls [B16 3.2.2; Osada et al. 2002].

A pull draws four different members a, b, c, d. All five metrics are taken from it:

==== =================================================== ===================
A3   angle at a between b and c                          radians
D1   distance of a from the centroid                     meters
D2   distance of a and b                                 meters
D3   square root of the area of the triangle a b c       meters
D4   cube root of the volume of the tetrahedron a b c d  meters
==== =================================================== ===================

Each metric's distribution is what separate pulls would give; only the metrics of one neighborhood
share their chance, for a third of the memory traffic. Where members run out (n < 4) the first
drawn ones take the empty places: c, d = a, b for two members, d = a for three, so areas or volumes
are 0, as they are. The angle is 0 where b or c coincides with a.

A new metric is an entry of ``registry.SHAPES``, a line in :func:`measure` and an entry of
:data:`COMPARABLE`; columns, groups and the size of every array follow. Models that were
trained with shapes before hold no thresholds of it and are refused: they must be trained again.

**No order matters.** Pull i of a neighborhood draws from a counter-based hash of (seed, the query's
float64 coordinates, the neighborhood's token, i) and members come in a canonical order, so counts
have the same bits for any order of points, tile or number of threads.

**No root is taken.** Metrics are compared with their thresholds as squares (D1, D2), as 4 area^2
(D3: 4 t^4), as 6 volume (D4: 6 t^3) and as the negative signed square of the cosine (A3); all
ascend with the metric.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..base.errors import OptionError
from ..base.hashing import GOLDEN, finalize
from ..base.jit import device, njit
from ..base.json_types import JsonObject
from .plan import Columns, columns_of
from .registry import MOMENT_FEATURES, SHAPE_BINS, SHAPE_FEATURES, SHAPES, rows_of

#: x, y and z of points, (m,) float64 each.
Axes = tuple[np.ndarray, np.ndarray, np.ndarray]

#: Random pulls per neighborhood [B16].
PULLS = 255

#: Arrays are padded to whole vectors.
ROOM = 256

#: Points that a pull draws.
DRAWN = 4

#: Rows of the metrics, by name, and their number.
ROW = rows_of(*SHAPES)
METRICS = len(ROW)

#: Inner thresholds of a metric's bins.
INNER = SHAPE_BINS - 1

#: Features of a neighborhood.
FEATURES = METRICS * SHAPE_BINS

#: Sample neighborhoods to which bins are fitted [B16 3.2.2].
SAMPLES = 500
#: Points that are hashed at a time to choose them.
_BATCH = 1_000_000

#: Product of two squared lengths (m^4) below which an angle is not defined, and 0.
NO_ANGLE = 1e-30
#: The metrics, in the order of the rows of all threshold arrays.
METRIC_NAMES = tuple(SHAPES)
#: How a metric in radians or meters becomes the value that kernels compare, and the way back.
COMPARABLE: dict[str, tuple[Callable, Callable]] = {
    "A3": (
        lambda t: -np.cos(t) * np.abs(np.cos(t)),
        lambda v: np.arccos(np.clip(-np.sign(v) * np.sqrt(np.abs(v)), -1, 1)),
    ),
    "D1": (np.square, np.sqrt),
    "D2": (np.square, np.sqrt),
    "D3": (lambda t: 4 * t**4, lambda v: (v / 4) ** 0.25),
    "D4": (lambda t: 6 * t**3, lambda v: np.cbrt(v / 6)),
}

_WRONG = (
    f"must be {INNER} finite, ascending numbers for each of {', '.join(METRIC_NAMES)}: angles from "
    "0 to pi, lengths not below 0"
)
_CURE = "Fit the thresholds again, or take them from the model file as it was written"


class ShapeBins:
    """Bins of A3 (radians) and D1, D2, D3, D4 (meters) for each neighborhood.

    Bin i holds the values with ``threshold[i - 1] < value <= threshold[i]``; the first and the
    last bin are open.

    Parameters
    ----------
    thresholds : mapping of str to (METRICS, INNER) array
        Neighborhood token -> ascending inner thresholds of each metric, in radians and meters.

    Raises
    ------
    OptionError
        Where thresholds are not METRICS x INNER finite, ascending numbers, angles outside 0..pi or
        lengths below 0.
    """

    def __init__(self, thresholds: JsonObject) -> None:
        self._thresholds = {token: np.array(rows, float) for token, rows in thresholds.items()}
        for token, rows in self._thresholds.items():
            if not (
                rows.shape == (METRICS, INNER)
                and np.isfinite(rows).all()
                and (np.diff(rows) >= 0).all()
                and rows.min() >= 0
                and rows[ROW.A3].max() <= math.pi
            ):
                raise OptionError(f"the shape thresholds of '{token}' {_WRONG}", cure=_CURE)

    @classmethod
    def fit(cls, values: Mapping[str, np.ndarray]) -> ShapeBins:
        """Return thresholds that cut sample values into SHAPE_BINS parts of equal size.

        A threshold is one of the values, so values that often repeat (areas of 0 on a line) make
        equal thresholds and empty bins, and nothing else does. `values` are the pulls (m, METRICS,
        PULLS) of m sample neighborhoods by neighborhood token, in the comparable form of
        :func:`shape_distributions.shape_values`. NaN (neighborhoods without points) is left out;
        where nothing is left, the thresholds are 0.
        """
        result = {}
        for token, sample in values.items():
            rows = np.zeros((len(METRIC_NAMES), INNER))
            rows[ROW.A3] = -1.0  # an angle of 0
            for m in range(len(METRIC_NAMES)):
                column = np.asarray(sample)[:, m, :].ravel()
                column = np.sort(column[np.isfinite(column)]).astype(np.float64)
                if len(column):
                    place = np.ceil(len(column) * np.arange(1, SHAPE_BINS) / SHAPE_BINS)
                    rows[m] = column[place.astype(int) - 1]
            result[token] = [
                COMPARABLE[name][1](row) for name, row in zip(METRIC_NAMES, rows, strict=True)
            ]
        return cls(result)

    def thresholds(self, token: str) -> np.ndarray:
        """Return thresholds (METRICS, INNER) float64 of one neighborhood, in radians and meters."""
        if token not in self._thresholds:
            raise OptionError(
                f"there are no shape thresholds for the neighborhood '{token}'",
                found=", ".join(self._thresholds) or "none at all",
                cure="Fit them for the same neighborhoods that are computed",
            )
        return self._thresholds[token].copy()

    def comparable(self, token: str) -> np.ndarray:
        """Return thresholds as the kernels compare them: (METRICS, INNER) float32."""
        rows = zip(METRIC_NAMES, self.thresholds(token), strict=True)
        return np.array([COMPARABLE[name][0](row) for name, row in rows], np.float32)

    def to_dict(self) -> JsonObject:
        """Return ``{"c1": {"A3": [INNER numbers], "D1": ...}, ...}``, JSON-able and exact."""
        return {
            token: dict(zip(METRIC_NAMES, rows.tolist(), strict=True))
            for token, rows in self._thresholds.items()
        }

    @classmethod
    def from_dict(cls, data: JsonObject) -> ShapeBins:
        """Return the bins that :meth:`to_dict` described; OptionError for another description."""
        try:
            return cls({t: [rows[name] for name in METRIC_NAMES] for t, rows in data.items()})
        except (AttributeError, KeyError, TypeError, ValueError):
            raise OptionError(f"shape thresholds {_WRONG}", cure=_CURE) from None

    def __eq__(self, other: object) -> bool:
        """Return whether all thresholds are equal."""
        return isinstance(other, ShapeBins) and self.to_dict() == other.to_dict()


class Work(NamedTuple):
    """Scratch of one thread."""

    draws: np.ndarray  # (DRAWN * ROOM,) uint32: members drawn, all a, then all b, ...
    points: np.ndarray  # (DRAWN * 4 * ROOM,) float32: their records
    values: np.ndarray  # (METRICS * ROOM,) float32: the metrics, comparable
    above: np.ndarray  # (METRICS, INNER) float32


class Shapes(NamedTuple):
    """The shape distributions wanted of k neighborhoods for m queries, and what they take."""

    shaped: np.ndarray  # (k,) bool: which neighborhoods have some
    columns: np.ndarray  # (k, FEATURES) int64: columns of the output, or -1
    thresholds: np.ndarray  # (k, METRICS, INNER) float32: of the bins, comparable
    seeds: np.ndarray  # (k, m) uint64: ``point_seeds`` of the queries, used where `shaped`
    # (k, m, METRICS, PULLS) float32: takes the pulls' metrics in place of the output; m = 0: none
    values: np.ndarray
    counts: np.ndarray  # (FEATURES,) float32: scratch
    work: Work


def make_work() -> Work:
    """Return scratch for one thread."""
    u, f = np.uint32, np.float32
    return Work(
        np.zeros(DRAWN * ROOM, u),
        np.zeros(DRAWN * 4 * ROOM, f),
        np.zeros(METRICS * ROOM, f),
        np.zeros((METRICS, INNER), f),
    )


class Fitted(NamedTuple):
    """Values that were fitted to a cloud, or passed in, beside a plan."""

    bins: ShapeBins | None = None  #: thresholds of the shape distributions, where shapes are wanted
    copt_threshold: float | None = None  #: curvature that parts scattered from regular points
    seed: int = 0  #: of the random pulls


class NeighborhoodGroup:
    """Neighborhoods of a plan that one kind of kernel computes."""

    def __init__(self, chosen: list[Columns]) -> None:
        self.chosen = chosen
        #: In the order of what ``fill`` counts.
        self.tokens = [columns.neighborhood.token for columns in chosen]
        self.columns = columns_of(chosen, MOMENT_FEATURES)

    def __len__(self) -> int:
        """Return the number of neighborhoods."""
        return len(self.chosen)

    def shapes(self, points: Axes, fitted: Fitted) -> Shapes | None:
        """Return what kernels take to compute shapes of points; None where none are wanted.

        Pulls are counted in the fitted bins; without, the metrics of all pulls are written, to
        which bins are fitted.
        """
        if not any(columns.shapes for columns in self.chosen):
            return None
        k, m, bins = len(self.chosen), len(points[0]), fitted.bins
        thresholds, seeds = np.zeros((k, METRICS, INNER), np.float32), np.zeros((k, m), np.uint64)
        for number, columns in enumerate(self.chosen):
            if columns.shapes:
                token = columns.neighborhood.token
                seeds[number] = point_seeds(*points, fitted.seed, token)
                if bins is not None:
                    thresholds[number] = bins.comparable(token)
        values = np.empty((k, m if bins is None else 0, METRICS, PULLS), np.float32)
        shaped = np.array([columns.shapes for columns in self.chosen])
        features = columns_of(self.chosen, SHAPE_FEATURES)
        counts = np.empty(FEATURES, np.float32)
        return Shapes(shaped, features, thresholds, seeds, values, counts, make_work())

    def fill(
        self,
        points: Axes,
        copies: np.ndarray,
        fitted: Fitted,
        shapes: Shapes | None,
        out: np.ndarray,
    ) -> tuple[dict[str, int], dict[str, int], float]:
        """Compute the columns of these neighborhoods for a block of queries.

        Parameters
        ----------
        points : (x, y, z), (m,) float64 each
            Queries, neighbors at best, those of one cell of the grid one after the other.
        copies : (m,) int64
            How many of the user's queries each one stands for.
        fitted : Fitted
        shapes : Shapes or None
            See :meth:`shapes`.
        out : (m, F) float32

        Returns
        -------
        few : dict
            By token, numbers of queries with fewer than three points.
        far : dict
            By token, numbers of queries whose result depends on points farther than the plan's
            halo, where there are any.
        reach : float
            Meters to the farthest point that matters to neighborhoods without a fixed radius.
        """
        raise NotImplementedError

    def shape_values(self, points: Axes, fitted: Fitted) -> dict[str, np.ndarray]:
        """Return by token comparable metrics (m, METRICS, PULLS) of all pulls round points.

        `fitted` has no bins.
        """
        shapes, m = self.shapes(points, fitted), len(points[0])
        if shapes is None:
            return {}
        width = 1 + max(max(columns.at.values()) for columns in self.chosen)
        scratch = np.empty((m, width), np.float32)
        self.fill(points, np.ones(m, np.int64), fitted, shapes, scratch)
        return {self.tokens[k]: shapes.values[k] for k in np.flatnonzero(shapes.shaped)}


def point_seeds(x: np.ndarray, y: np.ndarray, z: np.ndarray, seed: int, token: str) -> np.ndarray:
    """Return the seeds (m,) uint64 of queries from their coordinates, a seed and the token.

    Every bit of the coordinates (m,) counts, except that -0.0 is 0.0.
    """
    h: Any = np.uint64(
        int.from_bytes(hashlib.sha256(f"{int(seed)}:{token}".encode()).digest()[:8], "little")
    )
    bits = [(np.ascontiguousarray(v, dtype=np.float64) + 0.0).view(np.uint64) for v in (x, y, z)]
    h = finalize(h + bits[0])
    h = finalize(h + GOLDEN + bits[1])
    return finalize(h + GOLDEN + bits[2])


def smallest_hashes(xyz: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the SAMPLES smallest hashes (m,) of seed and coordinates, and their points (m,).

    Hashes ascend; copies of a point count once.
    """
    hashes, rows = np.zeros(0, np.uint64), np.zeros(0, np.int64)
    for start in range(0, len(xyz), _BATCH):
        part = np.asarray(xyz[start : start + _BATCH])
        x, y, z = part.T
        hashes = np.concatenate((hashes, point_seeds(x, y, z, seed, "samples")))
        rows = np.concatenate((rows, np.arange(start, start + len(part))))
        hashes, first = np.unique(hashes, return_index=True)
        hashes, rows = hashes[:SAMPLES], rows[first[:SAMPLES]]
    return hashes, rows


@device
def write_shapes(shapes, number, q, record, n, centroid, out):
    """Write the shapes of neighborhood `number` of query q, of n members, to row q of `out`."""
    seed = shapes.seeds[number, q]
    if shapes.values.shape[1]:
        shapes.values[number, q] = np.nan
        if n > 0:
            shape_values(record, n, centroid, seed, shapes.work, shapes.values[number, q])
        return
    counts = shapes.counts
    counts[:] = 0.0
    if n > 0:
        shape_counts(record, n, centroid, seed, shapes.thresholds[number], shapes.work, counts)
    for f in range(FEATURES):
        if shapes.columns[number, f] >= 0:
            out[q, shapes.columns[number, f]] = counts[f]


@device(forceinline=True)
def _mix32(h):
    """Return a bijective 32-bit hash of low bias (Wellons 2018: "lowbias32")."""
    h = np.uint32(h ^ np.uint32(h >> np.uint32(16)))
    h = np.uint32(h * np.uint32(0x7FEB352D))
    h = np.uint32(h ^ np.uint32(h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x846CA68B))
    return np.uint32(h ^ np.uint32(h >> np.uint32(16)))


@device(forceinline=True)
def _below(h, n):
    """Return a number in 0 .. n - 1 from 32 random bits (multiply-high)."""
    return np.uint32((np.uint64(h) * np.uint64(n)) >> np.uint64(32))


@njit
def draw(seed, n, draws):
    """Draw four members of n for every pull, different ones while there are enough."""
    low, high = np.uint32(seed & np.uint64(0xFFFFFFFF)), np.uint32(seed >> np.uint64(32))
    if n < DRAWN:
        _draw_few(low, high, n, draws)
        return
    n0, n1, n2, n3 = np.uint32(n), np.uint32(n - 1), np.uint32(n - 2), np.uint32(n - 3)
    for i in range(ROOM):
        u = _mix32(np.uint32(low + np.uint32(np.uint32(i) * np.uint32(0x9E3779B9))))
        v = _mix32(np.uint32(u + high))
        w = _mix32(np.uint32(u ^ np.uint32(v + np.uint32(0x85EBCA6B))))
        t = _mix32(np.uint32(v ^ np.uint32(u + np.uint32(0xC2B2AE35))))
        a, b, c, d = _below(u, n0), _below(v, n1), _below(w, n2), _below(t, n3)
        # Each later draw skips the members already taken, in ascending order.
        b = np.uint32(b + (np.uint32(1) if b >= a else np.uint32(0)))
        s0, s1 = (a, b) if a < b else (b, a)
        c = np.uint32(c + (np.uint32(1) if c >= s0 else np.uint32(0)))
        c = np.uint32(c + (np.uint32(1) if c >= s1 else np.uint32(0)))
        t0 = s0 if s0 < c else c
        m = s0 if s0 > c else c
        t1 = s1 if s1 < m else m
        t2 = s1 if s1 > m else m
        d = np.uint32(d + (np.uint32(1) if d >= t0 else np.uint32(0)))
        d = np.uint32(d + (np.uint32(1) if d >= t1 else np.uint32(0)))
        d = np.uint32(d + (np.uint32(1) if d >= t2 else np.uint32(0)))
        draws[i] = a
        draws[ROOM + i] = b
        draws[2 * ROOM + i] = c
        draws[3 * ROOM + i] = d


@device
def _draw_few(low, high, n, draws):
    """Draw from fewer than four members: the first drawn ones take the empty places."""
    for i in range(ROOM):
        u = _mix32(np.uint32(low + np.uint32(np.uint32(i) * np.uint32(0x9E3779B9))))
        v = _mix32(np.uint32(u + high))
        a = _below(u, n)
        b = c = d = a
        if n >= 2:
            b = np.uint32((a + np.uint32(1) + _below(v, n - 1)) % np.uint32(n))
            c, d = a, b
        if n == 3:
            c, d = np.uint32(np.uint32(3) - a - b), a
        draws[i] = a
        draws[ROOM + i] = b
        draws[2 * ROOM + i] = c
        draws[3 * ROOM + i] = d


@device
def fetch(record, draws, points):
    """Copy the drawn members' records one after another, 16 bytes at once."""
    for i in range(DRAWN * ROOM):
        p = draws[i]
        x, y, z, w = record[p, 0], record[p, 1], record[p, 2], record[p, 3]
        points[4 * i] = x
        points[4 * i + 1] = y
        points[4 * i + 2] = z
        points[4 * i + 3] = w


@device
def measure(points, centroid, values):
    """Write the metrics of every pull, comparable."""
    gx, gy, gz = centroid
    for i in range(ROOM):
        a, b, c, d = 4 * i, 4 * (ROOM + i), 4 * (2 * ROOM + i), 4 * (3 * ROOM + i)
        ax, ay, az = points[a], points[a + 1], points[a + 2]
        bx, by, bz = points[b] - ax, points[b + 1] - ay, points[b + 2] - az
        cx, cy, cz = points[c] - ax, points[c + 1] - ay, points[c + 2] - az
        dx, dy, dz = points[d] - ax, points[d + 1] - ay, points[d + 2] - az
        ex, ey, ez = ax - gx, ay - gy, az - gz
        bb = bx * bx + by * by + bz * bz
        cc = cx * cx + cy * cy + cz * cz
        bc = bx * cx + by * cy + bz * cz
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        both = bb * cc
        defined = both > np.float32(NO_ANGLE)
        cosine = -bc * abs(bc) / (both if defined else np.float32(1.0))
        values[ROW.A3 * ROOM + i] = cosine if defined else np.float32(-1.0)
        values[ROW.D1 * ROOM + i] = ex * ex + ey * ey + ez * ez
        values[ROW.D2 * ROOM + i] = bb
        values[ROW.D3 * ROOM + i] = nx * nx + ny * ny + nz * nz
        values[ROW.D4 * ROOM + i] = abs(nx * dx + ny * dy + nz * dz)


@device
def pull(record, n, centroid, seed, work):
    """Write the metrics of all pulls into work.values."""
    draw(seed, n, work.draws)
    fetch(record, work.draws, work.points)
    measure(work.points, centroid, work.values)
    for m in range(METRICS):  # the last places pad to whole vectors: above no threshold
        for i in range(PULLS, ROOM):
            work.values[m * ROOM + i] = -np.inf


@device(fastmath={"reassoc", "nsz"})  # sums of ones are exact in any order, so LLVM vectorizes them
def count_above(values, t, above):
    """Count the values of each metric above each threshold (no scatter: compare and add)."""
    for m in range(METRICS):
        for b in range(INNER):
            threshold, count = t[m, b], np.float32(0.0)
            for i in range(ROOM):
                count += np.float32(1.0) if values[m * ROOM + i] > threshold else np.float32(0.0)
            above[m, b] = count


@njit
def shape_counts(record, n, centroid, seed, thresholds, work, out):
    """Write the shape features of one neighborhood: shares of the pulls in the bins of each metric.

    Bin i holds the pulls with threshold[i - 1] < value <= threshold[i].

    Parameters
    ----------
    record : ndarray of float32, shape (at least n, 4)
        Offsets x, y, z of the members from the query, in canonical order; the fourth column is not
        used.
    n : int
        Members, at least 1.
    centroid : tuple of float32
        Offset x, y, z of their centroid.
    seed : uint64
        See :func:`point_seeds`.
    thresholds : ndarray of float32, shape (METRICS, INNER)
        See :meth:`ShapeBins.comparable`.
    work : Work
    out : ndarray of float32, shape (FEATURES,)
    """
    pull(record, n, centroid, seed, work)
    above = work.above
    count_above(work.values, thresholds, above)
    for m in range(METRICS):
        before = np.float32(PULLS)
        for b in range(INNER):
            out[SHAPE_BINS * m + b] = (before - above[m, b]) / np.float32(PULLS)
            before = above[m, b]
        out[SHAPE_BINS * m + INNER] = before / np.float32(PULLS)


@njit
def shape_values(record, n, centroid, seed, work, out):
    """Write the metrics of the pulls that :func:`shape_counts` counts, (METRICS, PULLS)."""
    pull(record, n, centroid, seed, work)
    for m in range(METRICS):
        for i in range(PULLS):
            out[m, i] = work.values[m * ROOM + i]
