"""Classifying a cloud: what may be asked, the points that are computed, and the results by point.

Rows of points live in three orders, which names tell apart: ``rows_in_cloud`` of the cloud as it
was given, ``rows_in_work`` of the points that are computed (:class:`WorkingCloud`), and
``rows_in_block`` of a block of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..base.asprs import GROUND, UNCLASSIFIED
from ..base.errors import OptionError
from ..base.json_types import JsonObject
from ..base.messages import Report
from ..base.options import Settings, setting
from ..features.point_grid import CellGrid, build_grid
from ..features.voxels import Members, Representatives
from .calibration import ReliabilityLimits
from .interface import Block, ClassStep, ModelObserver, Observe, PassInputs
from .line_evidence import RULES


@dataclass(frozen=True)
class PredictionOptions(Settings):
    """Options of classifying a cloud."""

    threads: int | None = None
    memory_mb: float = setting(256.0, "number", "Memory for blocks of points", 1, None, unit="MB")
    probabilities: bool = setting(
        False, "boolean", "Also write the probability of each class, as Probability_<code>"
    )
    margin: bool = setting(
        False, "boolean", "Also write Margin: the winning probability minus the second highest"
    )
    variance: bool = setting(
        False,
        "boolean",
        "Also write Variance: how much the probabilities vary over a network's batches (networks "
        "only)",
    )
    device: str = setting(
        "cpu",
        "string",
        "Where a network is applied: with NumPy, which gives the same bits everywhere, or with "
        "PyTorch on a GPU",
        choices=("cpu", "cuda", "auto"),
    )
    reject_below: float | None = setting(
        None,
        "number",
        "Points with a lower Reliability are rejected: they do not get the winning class, and are "
        "counted",
        *(0, 1),
    )
    rejected_code: int | None = setting(
        None,
        "integer",
        "Class code for rejected points; by default they keep the class they had",
        *(0, 255),
    )
    #: as `reject_below`, by class; the larger one counts
    limits: ReliabilityLimits | None = None
    observer: ModelObserver | None = None


#: Returns where points lie (m, 3), in meters, by their rows (m,).
Locate = Callable[[npt.NDArray[np.int64]], npt.NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class LineCandidates:
    """Points of a cloud that may be part of lines, such as wires; other points have 0."""

    probability: npt.NDArray[np.float32]  #: (n,) of the classes of lines together
    code: npt.NDArray[np.uint8]  #: (n,) the likeliest of these classes

    @property
    def chosen(self) -> npt.NDArray[np.bool_]:
        """Return which points (n,) are candidates."""
        return self.probability > 0


@dataclass(frozen=True, eq=False)
class Prediction:
    """Classes of a cloud's points, in its order, with 0 for points that were not classified."""

    classification: npt.NDArray[np.uint8]  #: (n,) ASPRS codes
    reliability: npt.NDArray[np.float32]  #: (n,) probability of the winning class
    report: Report  #: counts, notes and warnings for the metadata
    #: (m,) points that were not reliable enough, and so rejected
    unsure: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    margin: npt.NDArray[np.float32] | None = None  #: (n,) winning minus second probability
    #: (n,) variance of a class's probability over a network's batches, mean over the classes
    variance: npt.NDArray[np.float32] | None = None
    #: (n, classes) in the order of ``Model.classes``
    probabilities: npt.NDArray[np.float32] | None = None
    #: of a model with classes of lines, until these are found: everything else is what holds if
    #: none of them lies on a line
    candidates: LineCandidates | None = None


@dataclass(frozen=True, eq=False)
class PointRoles:
    """Roles of the points of a cloud: to classify, only neighbors, or ignored."""

    wanted: npt.NDArray[np.bool_]  #: (n,) points to classify
    usable: npt.NDArray[np.bool_] | None  #: (n,) points that are not ignored; None: all
    current: npt.NDArray[np.uint8] | None  #: (n,) class codes that the points have now
    not_ground: npt.NDArray[np.bool_] | None  #: (n,) points to classify that must not become ground

    @classmethod
    def check(
        cls,
        n: int,
        where: npt.ArrayLike | None,
        ignore: npt.ArrayLike | None,
        current: npt.ArrayLike | None,
        may_be_ground: npt.ArrayLike | None,
    ) -> PointRoles:
        """Return the roles of n points from arguments of ``Model.predict``, checked."""
        wanted = np.ones(n, np.bool_) if where is None else _column("where", where, n, np.bool_)
        usable = codes = not_ground = None
        if ignore is not None and (ignored := _column("ignore", ignore, n, np.bool_)).any():
            usable = ~ignored
            wanted = wanted & usable
        if current is not None:
            codes = _column("current", current, n, np.uint8)
        if may_be_ground is not None:
            not_ground = wanted & ~_column("may_be_ground", may_be_ground, n, np.bool_)
        return cls(wanted, usable, codes, not_ground)

    @property
    def wanted_rows(self) -> npt.NDArray[np.int64] | None:
        """Rows in the cloud of the points to classify, ascending; None: all."""
        return None if self.wanted.all() else np.flatnonzero(self.wanted)

    @property
    def ignored(self) -> int:
        """Number of points that are ignored."""
        return 0 if self.usable is None else int(np.count_nonzero(~self.usable))


def _column(name: str, values: npt.ArrayLike, n: int, dtype: type) -> npt.NDArray:
    """Return an argument as (n,) of a type; OptionError where its values do not fit."""
    array = np.asarray(values)
    same_kind = (array.dtype == np.bool_) == (dtype is np.bool_)
    if array.shape != (n,) or not same_kind or (array.astype(dtype, copy=False) != array).any():
        raise OptionError(
            f"'{name}' must be one {'code' if dtype is np.uint8 else 'true or false'} per point",
            found=f"{array.dtype} of shape {array.shape}",
        )
    return array.astype(dtype, copy=False)


@dataclass(frozen=True, eq=False)
class WorkingCloud:
    """Points that are computed, in the order of the grid: one for each voxel, none ignored."""

    xyz: npt.NDArray[np.float64]  #: (k, 3) meters
    dimensions: dict[str, npt.NDArray]  #: (k,) values by name
    #: rows in work that stand for points to classify, ascending; None: all
    wanted: npt.NDArray[np.int64] | None
    grid: CellGrid  #: the index of `xyz`
    _members: Members | npt.NDArray  #: (k,) rows in the cloud where each stands for itself

    @classmethod
    def sort(
        cls,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike],
        cell: float,
        representatives: Representatives | None,
        wanted_rows: npt.NDArray[np.int64] | None,
    ) -> WorkingCloud:
        """Sort the points that are computed by the cells of a grid.

        Parameters
        ----------
        xyz : (k, 3) float64
            Of the representatives, where there are any.
        dimensions : mapping of str to (n,) array
            Of the cloud.
        cell : float
            Side of the grid's cells, meters.
        representatives : Representatives or None
            Which points of the cloud stand for which; None: each for itself.
        wanted_rows : (m,) int64 or None
            Rows in the cloud of the points to classify. Representatives know those that stand for
            any of them.
        """
        grid = build_grid(xyz, cell)
        order = grid.order
        grid = grid._replace(order=np.arange(len(order), dtype=order.dtype))
        if representatives is None:
            rows_in_cloud, wanted = order, wanted_rows
            if wanted is not None:
                wanted = np.flatnonzero(np.isin(order, wanted))
            members: Members | npt.NDArray = order
        else:
            rows_in_cloud = representatives.rows[order]
            members = representatives.members.reorder(order)
            wanted = members.wanted()
        taken = {name: np.asarray(values)[rows_in_cloud] for name, values in dimensions.items()}
        return cls(grid.xyz.T, taken, wanted, grid, members)

    @property
    def stands_for_others(self) -> bool:
        """True where a point in work may stand for several points, or for none."""
        return isinstance(self._members, Members)

    def observe(self, observe: Observe | None) -> Observe | None:
        """Return a function that hands on the inputs of the points to classify, by their rows."""

        def hand_on(inputs: PassInputs) -> None:
            assert observe is not None
            chosen = np.arange(len(inputs.rows))
            if self.wanted is not None:
                chosen = np.flatnonzero(np.isin(inputs.rows, self.wanted))
            rows_in_cloud, place = self.members(inputs.rows[chosen])
            number, _, xyz, values, shares = inputs
            at = chosen[place]
            observe(PassInputs(number, rows_in_cloud, xyz[at], values[at], shares[at]))

        return None if observe is None else hand_on

    def members(
        self, rows_in_work: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray, npt.NDArray[np.int64] | slice]:
        """Return the cloud's rows that a block stands for, and the block's row for each."""
        if isinstance(self._members, Members):
            return self._members.take(rows_in_work)
        return self._members[rows_in_work], slice(None)


def empty_columns(
    roles: PointRoles, classes: int, options: PredictionOptions, lines: bool
) -> dict[str, npt.NDArray]:
    """Return the columns (n, ...) of results before any point is classified.

    `lines`: some classes are of lines.
    """
    n, current = len(roles.wanted), roles.current
    columns: dict[str, npt.NDArray] = {
        "classification": np.zeros(n, np.uint8) if current is None else current.copy(),
        "reliability": np.zeros(n, np.float32),
    }
    for name in ("margin", "variance"):
        if getattr(options, name):
            columns[name] = np.zeros(n, np.float32)
    if options.probabilities:
        columns["probabilities"] = np.zeros((n, classes), np.float32)
    if roles.not_ground is not None:
        columns["second"], columns["second_share"] = np.zeros(n, np.uint8), np.zeros(n, np.float32)
    if lines:
        columns["line_probability"] = np.zeros(n, np.float32)
        columns["line_class"] = np.zeros(n, np.uint8)
    return columns


def set_lines_aside(
    block: Block, lines: npt.NDArray[np.bool_], codes: npt.NDArray[np.uint8]
) -> tuple[Block, dict[str, npt.NDArray]]:
    """Return a block as if none of its points lay on a line, and the columns of candidates (b,).

    `lines` (classes,) tells which classes are lines. A point that can be nothing else stays one.
    """
    p = block.probabilities
    of_lines = p[:, lines].sum(axis=1)
    rest = p[:, ~lines].sum(axis=1)
    share = of_lines.astype(np.float32)
    likeliest = codes[lines][p[:, lines].argmax(axis=1)]
    candidate = share >= np.float32(RULES.candidate)
    columns = {
        "line_probability": np.where(candidate, share, np.float32(0.0)),
        "line_class": np.where(candidate, likeliest, np.uint8(0)),
    }
    change = np.flatnonzero(candidate & (rest > 0))
    if len(change):
        p = p.copy()
        p[change] = np.where(lines, 0.0, p[change] / rest[change, None])
    return block._replace(probabilities=p), columns


def decide(
    block: Block, codes: npt.NDArray[np.uint8], wanted: Iterable[str]
) -> dict[str, npt.NDArray]:
    """Return the wanted columns of a block; of classes that are equally likely the first wins.

    ``second`` is the class that would win without the winner, ``second_share`` its probability.
    """
    p = block.probabilities
    best = p.argmax(axis=1)
    win = np.take_along_axis(p, best[:, None], axis=1)[:, 0]
    columns = {"classification": codes[best], "reliability": win}
    if "margin" in wanted:
        columns["margin"] = win - np.partition(p, -2, axis=1)[:, -2] if p.shape[1] > 1 else win
    if "variance" in wanted and block.variance is not None:
        columns["variance"] = block.variance
    if "second" in wanted:
        others = p.copy()
        np.put_along_axis(others, best[:, None], -1.0, axis=1)
        next_best = others.argmax(axis=1)
        columns["second"] = codes[next_best]
        columns["second_share"] = np.take_along_axis(p, next_best[:, None], axis=1)[:, 0]
    if "probabilities" in wanted:
        columns["probabilities"] = p
    return columns


def move_from_ground(columns: dict[str, npt.NDArray], roles: PointRoles) -> int:
    """Give ground points that must not be ground their second class; return their number."""
    second, share = columns.pop("second"), columns.pop("second_share")
    rows = np.flatnonzero(roles.not_ground & (columns["classification"] == GROUND))
    columns["classification"][rows], columns["reliability"][rows] = second[rows], share[rows]
    if "margin" in columns:
        columns["margin"][rows] = 0.0
    return len(rows)


def settle_lines(
    prediction: Prediction,
    on_line: npt.NDArray[np.int64],
    codes: npt.NDArray[np.uint8],
) -> None:
    """Give points on a line, by their rows (m,), the class of lines.

    They are of it with a probability halfway between what the passes gave them and 1; the other
    classes share the rest as before. `codes` (classes,) are in the order of probabilities.
    """
    candidates = prediction.candidates
    assert candidates is not None
    code = candidates.code[on_line]
    share = np.float32(0.5) * (np.float32(1.0) + candidates.probability[on_line])
    prediction.classification[on_line] = code
    if prediction.margin is not None:
        second = (np.float32(1.0) - share) * prediction.reliability[on_line]
        prediction.margin[on_line] = share - second
    prediction.reliability[on_line] = share
    if prediction.probabilities is not None:
        prediction.probabilities[on_line] *= (np.float32(1.0) - share)[:, None]
        prediction.probabilities[on_line, np.searchsorted(codes, code)] = share


def reject(
    prediction: Prediction,
    wanted: npt.NDArray[np.bool_],
    current: npt.NDArray[np.uint8] | None,
    options: PredictionOptions,
) -> npt.NDArray[np.int64]:
    """Take the class from wanted points (n,) that are not reliable enough; return their rows.

    `current` (n,) are the classes that they had.
    """
    code = prediction.classification
    if options.limits is None and not options.reject_below:
        return np.zeros(0, np.int64)
    least = np.full(256, options.reject_below or 0.0, np.float32)
    if options.limits is not None:
        np.maximum(least, options.limits.least_reliability(), out=least)
    limit = least[code]
    rows = np.flatnonzero(wanted & (prediction.reliability < limit))
    kept = UNCLASSIFIED if current is None else current[rows]
    code[rows] = kept if options.rejected_code is None else options.rejected_code
    if options.observer is not None:
        options.observer.see_classes(ClassStep.SURENESS, code, limit)
    return rows


def count_classes(
    classification: npt.NDArray[np.uint8], wanted: npt.NDArray[np.bool_], rejected: int
) -> JsonObject:
    """Return the counts of wanted points (n,) of a prediction, for its report."""
    number = np.bincount(classification[wanted], minlength=256)
    return {
        "classified": int(np.count_nonzero(wanted)) - rejected,
        "rejected": rejected,
        "classes": {str(code): int(number[code]) for code in np.flatnonzero(number).tolist()},
    }
