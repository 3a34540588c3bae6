"""Trace a point through a run: noise, ground filter, passes of the model, what came after."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import GROUND, TERRAIN
from ..base.columns import SomeRows
from ..base.dimensions import opening
from ..base.grid import cell_numbers
from ..classifier.feature_forest import FeatureForest
from ..classifier.interface import PassInputs
from ..classifier.model import Model
from ..classifier.training_percentiles import PERCENTILES, PercentileTable
from ..stages.apply_model import ApplyModel
from ..stages.detached_noise import DetachedNoise
from ..stages.hag_morphological import HagMorphological
from ..stages.points import Points
from ..terrain.detached import find_detached
from ..terrain.heights import JUDGED
from ..terrain.noise import REACH as NOISE_REACH
from .explanation import (
    Explanation,
    FoundPoint,
    GroundSteps,
    Noise,
    PassInput,
    PassTrace,
    Verdict,
)
from .recording import Recording

#: Name of the input that stands for all that is read of an earlier pass.
SURROUNDINGS = "surroundings"
#: Radius in meters, in plan, within which points are near ...
_NEAR_M = 5.0
#: ... and depth in meters from which on they are lower.
_LOWER_M = 1.0
#: Dimensions that are compared with those of the file, and the steps to which `classify` rounds
#: them.
_COMPARED = {"HeightAboveGround": 1 / 32, "Reliability": 1 / 64}


def trace_point(
    recording: Recording, place: int, distance_m: float, against: int | None = None
) -> Explanation:
    """Return how a point came to its class; `place` is its number among those of the recording.

    `against` is the class that the one found is compared with, if the model has both.
    """
    row, at = int(recording.rows[place]), int(recording.rows_seen[place])
    columns = recording.around
    stages = [each.stage for each in recording.stages]
    model_at = next(n for n, stage in enumerate(stages) if isinstance(stage, ApplyModel))
    model_stage = stages[model_at]
    assert isinstance(model_stage, ApplyModel)
    codes = [int(columns["Classification"][row]), *(int(c[place]) for c in recording.classes)]
    kept = _why_kept(recording, model_stage, at, codes[model_at])
    verdict, steps = None, []
    if not kept:
        verdict = _verdict(recording, model_stage, place, against or codes[0])
        steps = _own_steps(model_stage, recording, row, verdict, codes[model_at + 1])
    steps += [
        (stage.type, code)
        for stage, code in zip(stages[model_at + 1 :], codes[model_at + 2 :], strict=True)
    ]
    compared = {}
    for name, step in _COMPARED.items():
        if name in columns and name in recording.seen and not kept:
            before, now = float(columns[name][row]), float(recording.seen[name][at])
            compared[name] = before, now, abs(before - now) <= 0.51 * step + 1e-4
    return Explanation(
        _found(recording, row, distance_m),
        codes[0],
        codes[-1],
        kept,
        _noise(recording, row, next((s for s in stages if isinstance(s, DetachedNoise)), None)),
        _ground(recording, row, next((s for s in stages if isinstance(s, HagMorphological)), None)),
        verdict,
        steps,
        compared,
        recording.notes,
    )


def _found(recording: Recording, row: int, distance_m: float) -> FoundPoint:
    """Return what the file has of a point."""
    around = recording.around
    names = ("X", "Y", "Z", "ReturnNumber", "NumberOfReturns")
    x, y, z, number, returns = (around[name][row].item() for name in names)
    checked = "Checked" in around and bool(around["Checked"][row])
    file = around.files[around.file[row]]
    return FoundPoint(file, int(around.number[row]), x, y, z, distance_m, number, returns, checked)


def _why_kept(recording: Recording, stage: ApplyModel, at: int, code: int) -> str:
    """Return why the model leaves a point alone whose class was `code` before; empty if not."""
    one = SomeRows(recording.seen, np.array([at]))
    codes = {"Classification": np.array([code], np.uint8)}
    point = stage.points(ChainMap(codes, one), wkt=recording.reference.wkt)  # type: ignore[arg-type]
    if not point.inside[0]:
        return f"it lies outside --where {recording.request.where}"
    if point.chosen(stage.ignore)[0]:
        return "it is withheld" if point.flag("Withheld")[0] else f"class {code} is left out"
    if stage.given_ground and code in TERRAIN:
        return f"class {code} is given ground, which keeps its class"
    return f"class {code} is kept" if point.chosen(stage.keep)[0] else ""


def _axes(recording: Recording, rows: NDArray | slice) -> list[NDArray[np.float64]]:
    """Return x, y and z (m,) of rows in meters, as stages see them."""
    units = recording.reference.units
    scales = (units.horizontal, units.horizontal, units.vertical)
    columns = recording.around
    return [
        np.rint(columns[axis][rows] * 1e6) / 1e6 * scale
        for axis, scale in zip("XYZ", scales, strict=True)
    ]


def _noise(recording: Recording, row: int, stage: DetachedNoise | None) -> Noise | None:
    """Return whether a point is noise by the points around that matter."""
    if stage is None:
        return None
    x, y, _ = _axes(recording, slice(None))
    near = np.flatnonzero(np.maximum(np.abs(x - x[row]), np.abs(y - y[row])) <= NOISE_REACH + 1.0)
    some = SomeRows(recording.around, near)
    near = near[~Points(some, recording.reference.wkt).chosen(stage.ignore)]
    if row not in near:
        return None
    near_x, near_y, near_z = _axes(recording, near)
    state = find_detached(near_x, near_y, near_z, stage.cluster, stage.gap)
    before = recording.around["Classification"][row]
    number = next(n for n, each in enumerate(recording.stages) if each.stage is stage)
    after = recording.classes[number][np.flatnonzero(recording.rows == row)[0]]
    return Noise(int(after) if after != before else 0, int(state[np.searchsorted(near, row)]))


def _ground(recording: Recording, row: int, stage: HagMorphological | None) -> GroundSteps | None:
    """Return what each step of the ground filter made of a point and its cell."""
    if stage is None or not recording.pieces:
        return None
    x, y, z = (float(axis[0]) for axis in _axes(recording, np.array([row])))
    cell = stage.cell
    column, line = (int(cell_numbers(np.array([v]), cell)[0]) for v in (x, y))

    def depth(piece: Mapping) -> int:
        left, bottom, width, height = next(iter(piece.values()))[0]
        return min(column - left, left + width - column, line - bottom, bottom + height - line)

    piece = max(recording.pieces, key=depth)

    def made(step: str, around: int = 0) -> float | None:
        """Return what a step made of the cell, or the least of those around, above the point."""
        if step not in piece:
            return None
        window, values = piece[step]
        j, i = line - window.bottom, column - window.left
        part = values[max(j - around, 0) : j + around + 1, max(i - around, 0) : i + around + 1]
        known = part[np.isfinite(part)]
        return float(known.min()) - z if len(known) else None

    xs, ys, zs = _axes(recording, slice(None))
    near = np.hypot(xs - x, ys - y) <= _NEAR_M
    heights = {name: float(values[row]) for name, values in recording.heights.items()}
    rounds = [name for name in piece if name.startswith("round_")]
    return GroundSteps(
        cell,
        2 * stage.options["window"] + cell,
        made("low_outliers") if "low_outliers" in piece else made("minimum_grid"),
        made("openings"),
        made("wide_roofs"),
        [made(name) is not None for name in rounds],
        made("given_ground"),
        made("low_outliers", round(_NEAR_M / cell)),
        int(np.count_nonzero(near)),
        int(np.count_nonzero(near & (zs < z - _LOWER_M))),
        stage.given_ground,
        heights["HeightAboveGround"],
        heights[JUDGED[0]],
        heights[JUDGED[1]],
        bool(heights["Ground"]),
        {width: heights[opening(width).name] for width in stage.openings},
    )


# ---- the model -----------------------------------------------------------------------------------


def _verdict(recording: Recording, stage: ApplyModel, place: int, against: int) -> Verdict:
    """Return what the model said of a point; `against` is the rival, if it can be."""
    model, names = stage.model, dict(stage.model.classes)
    row, at = recording.rows[place], recording.rows_seen[place]
    shares = {code: float(recording.seen[f"Probability_{code}"][at]) for code in names}
    order = sorted(names, key=lambda code: -shares[code])
    rival = against if against in names and against != order[0] else order[1]
    by_pass: dict[int, PassTrace] = {}
    stands = None
    for each in recording.inputs:
        if each.number not in by_pass and (found := np.flatnonzero(each.rows == at)).size:
            by_pass[each.number] = _trace_pass(model, each, int(found[0]))
            own = np.column_stack(_axes(recording, np.array([row])))
            away = float(np.linalg.norm(each.xyz[found[0]] - own))
            stands = away if away > 1e-6 else None
    passes = [by_pass[number] for number in sorted(by_pass)]
    last = passes[-1].probabilities if passes else {}
    lost = [code for code in last if last[code] == max(last.values()) and not shares[code]]
    least = np.zeros(256) if stage.limits is None else stage.limits.least_reliability()
    limit = max(float(least[order[0]]), stage.reject_below or 0.0)
    return Verdict(
        stage.model_file, names, shares, order[0], rival, passes, stands, lost, limit or None
    )


def _trace_pass(model: Model, read: PassInputs, at: int) -> PassTrace:
    """Return the contributions of a pass's inputs to a point; those of an earlier pass as one."""
    single = model.passes[read.number]

    def by_class(values: NDArray) -> dict[int, float]:
        return dict(zip(model.codes_of[read.number], values.tolist(), strict=True))

    probabilities = by_class(read.probabilities[at])
    if not isinstance(single, FeatureForest):
        return PassTrace(probabilities, {}, [])
    values = read.values[at : at + 1]
    contributions = single.contributions(values)
    if contributions is None:
        return PassTrace(probabilities, {}, [])
    start, added = contributions
    names, ranges = single.plan.names, _percentiles(model, read.number)
    inputs = []
    for name, value, parts in zip(names, values[0].tolist(), added[0], strict=False):
        of_name = ranges.get(name, {})
        below = {int(code): share_below(value, row) for code, row in of_name.items()}
        inputs.append(PassInput(name, value, by_class(parts), below))
    if single.context is not None:
        context = by_class(added[0, len(names) :].sum(axis=0))
        inputs.append(PassInput(SURROUNDINGS, None, context, {}))
    return PassTrace(probabilities, by_class(start), inputs)


def _percentiles(model: Model, number: int) -> PercentileTable:
    """Return the percentiles of a pass: the first pass of a training has them for all."""
    entries = model.info["passes"][number::-1]
    return next((entry["percentiles"] for entry in entries if entry.get("percentiles")), {})


def share_below(value: float, percentiles: Sequence[float]) -> float:
    """Return the share of training samples with lower values, by :data:`PERCENTILES`.

    Of values that many samples have it is the middle of their shares.
    """
    known = np.array([-np.inf, *percentiles, np.inf])
    shares = np.array([0.0, *PERCENTILES, 100.0]) / 100.0
    first, end = (int(np.searchsorted(known, value, side)) for side in ("left", "right"))
    if end > first:  # some have this very value
        return float(shares[first] + shares[end - 1]) / 2.0
    low, high = known[first - 1], known[first]
    part = (value - low) / (high - low) if np.isfinite(high - low) else 0.5
    return float(shares[first - 1] + part * (shares[first] - shares[first - 1]))


def _own_steps(
    stage: ApplyModel, recording: Recording, row: int, verdict: Verdict, code: int
) -> list[tuple[str, int]]:
    """Return what the model's stage did after the verdict, and the class after each step."""
    now, steps = verdict.winner, []
    heights = stage.vegetation_heights
    if stage.given_ground and now == GROUND:
        if recording.heights and not recording.heights["Ground"][row]:
            others = [each for each in verdict.classes if each != now]
            now = max(others, key=lambda each: verdict.probabilities[each])
        steps.append(("--ground given", now))
    if stage.limits is not None or stage.reject_below:
        limit = verdict.limit or 0.0
        sure = np.float32(verdict.probabilities[now]) >= np.float32(limit)
        now = now if sure else code
        sure_from = f"from a probability of {limit:.2f} on" if limit else "no limit for it"
        steps.append((f"--keep-sure ({sure_from})", now))
    if heights:
        steps.append((f"--vegetation-heights {heights[0]:g},{heights[1]:g}", code))
    return steps
