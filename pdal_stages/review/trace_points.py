"""Trace a point through a recording: noise, ground filter, passes of the model, what came after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import GROUND
from ..base.dimensions import opening
from ..classifier.feature_forest import FeatureForest
from ..classifier.interface import ClassStep, PassInputs
from ..classifier.model import Model
from ..classifier.training_percentiles import PERCENTILES, PercentileTable
from ..stages.apply_model import ApplyModel
from ..stages.base import Kept
from ..stages.detached_noise import DetachedNoise
from ..stages.hag_morphological import HagMorphological
from ..terrain.heights import JUDGED, PLACED
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
    columns, row = recording.cloud, int(recording.rows[place])
    codes = [int(columns["Classification"][row]), *(int(c[place]) for c in recording.classes)]
    after = {type(stage): code for stage, code in zip(recording.stages, codes[1:], strict=True)}
    model_at = next(n for n, s in enumerate(recording.stages) if isinstance(s, ApplyModel))
    kept = _why_kept(recording, place, codes[model_at])
    verdict: Verdict | None = None
    steps: list[tuple[str, int]] = []
    compared: dict[str, tuple[float, float, bool]] = {}
    if not kept:
        verdict = _verdict(recording, place, against or codes[0])
        steps = _steps_of_model(recording, place)
        for name, step in _COMPARED.items():
            if name in columns and name in recording.results:
                before, now = float(columns[name][row]), float(recording.results[name][place])
                compared[name] = before, now, abs(before - now) <= 0.51 * step + 1e-4
    later = zip(recording.stages[model_at + 1 :], codes[model_at + 2 :], strict=True)
    noise = None
    if len(recording.noise):
        code = after[DetachedNoise]
        noise = Noise(code if code != codes[0] else 0, int(recording.noise[place]))
    point = _point(recording, row, distance_m)
    return Explanation(
        point,
        codes[0],
        codes[-1],
        kept,
        noise,
        _ground(recording, place),
        verdict,
        [*steps, *((stage.type, code) for stage, code in later)],
        compared,
        recording.notes,
    )


def _point(recording: Recording, row: int, distance_m: float) -> FoundPoint:
    """Return what the file has of a point."""
    cloud = recording.cloud
    names = ("X", "Y", "Z", "ReturnNumber", "NumberOfReturns")
    x, y, z, number, returns = (cloud[name][row].item() for name in names)
    checked = "Checked" in cloud and bool(cloud["Checked"][row])
    file = cloud.files[cloud.file[row]]
    return FoundPoint(file, int(cloud.number[row]), x, y, z, distance_m, number, returns, checked)


def _why_kept(recording: Recording, place: int, code: int) -> str:
    """Return why the model leaves a point alone whose class was `code` before; empty if not."""
    texts = {
        Kept.OUTSIDE: f"it lies outside --where {recording.where}",
        Kept.IGNORED: f"class {code} is left out",
        Kept.GIVEN_GROUND: f"class {code} is given ground, which keeps its class",
        Kept.KEPT: f"class {code} is kept",
    }
    if recording.cloud["Withheld"][recording.rows[place]]:
        texts[Kept.IGNORED] = "it is withheld"
    return next((texts[reason] for reason in Kept if recording.kept[reason][place]), "")


def _ground(recording: Recording, place: int) -> GroundSteps | None:
    """Return what each step of the ground filter made of a point and its cell."""
    heights = {name: values[place].item() for name, values in recording.heights.items()}
    if not heights or np.isnan(heights["HeightAboveGround"]):
        return None
    stage = next(s for s in recording.stages if isinstance(s, HagMorphological))
    number, column, line = (heights[name] for name in PLACED)
    piece, cell = recording.pieces[number], stage.cell
    columns, row, units = recording.cloud, recording.rows[place], recording.reference.units
    z = float(columns["Z"][row]) * units.vertical

    def elevation(step: str, cells: int = 0) -> float | None:
        """Return what a step made of the cell, or the least of those around, above the point."""
        if step not in piece:
            return None
        window, values = piece[step]
        j, i = line - window.bottom, column - window.left
        part = values[max(j - cells, 0) : j + cells + 1, max(i - cells, 0) : i + cells + 1]
        known = part[np.isfinite(part)]
        return float(known.min()) - z if len(known) else None

    away_x = (columns["X"] - columns["X"][row]) * units.horizontal
    strip = np.flatnonzero(np.abs(away_x) <= _NEAR_M)
    away_y = (columns["Y"][strip] - columns["Y"][row]) * units.horizontal
    near = strip[np.hypot(away_x[strip], away_y) <= _NEAR_M]
    lower = columns["Z"][near] * units.vertical < z - _LOWER_M
    return GroundSteps(
        cell,
        2 * stage.options["window"] + cell,
        elevation("low_outliers" if "low_outliers" in piece else "minimum_grid"),
        elevation("openings"),
        elevation("wide_roofs"),
        [elevation(name) is not None for name in piece if name.startswith("round_")],
        elevation("given_ground"),
        elevation("low_outliers", round(_NEAR_M / cell)),
        len(near),
        int(np.count_nonzero(lower)),
        stage.given_ground,
        heights["HeightAboveGround"],
        heights[JUDGED[0]],
        heights[JUDGED[1]],
        bool(heights["Ground"]),
        {width: heights[opening(width).name] for width in stage.openings},
    )


# ---- the model -----------------------------------------------------------------------------------


def _model_stage(recording: Recording) -> ApplyModel:
    """Return the stage of the model."""
    return next(stage for stage in recording.stages if isinstance(stage, ApplyModel))


def _verdict(recording: Recording, place: int, against: int) -> Verdict:
    """Return what the model said of a point; `against` is the rival, if it can be."""
    stage = _model_stage(recording)
    model, names = stage.model, dict(stage.model.classes)
    at, units = recording.rows_seen[place], recording.reference.units
    shares = {code: float(recording.results[f"Probability_{code}"][place]) for code in names}
    winner = int(recording.steps[ClassStep.LIKELIEST][0][place])
    others = [code for code in names if code != winner]
    rival = against if against in others else max(others, key=lambda code: shares[code])
    by_pass: dict[int, PassTrace] = {}
    stands = None
    for each in recording.inputs:
        if each.number not in by_pass and (rows := np.flatnonzero(each.rows == at)).size:
            by_pass[each.number] = _trace_pass(model, each, int(rows[0]))
            xyz = [recording.cloud[axis][recording.rows[place]] for axis in "XYZ"]
            meters = np.array(xyz) * [units.horizontal, units.horizontal, units.vertical]
            away = float(np.linalg.norm(each.xyz[rows[0]] - meters))
            stands = away if away > 1e-5 else None
    passes = [by_pass[number] for number in sorted(by_pass)]
    last = passes[-1].probabilities if passes else {}
    lost = [code for code in last if last[code] == max(last.values()) and not shares[code]]
    return Verdict(stage.model_file, names, shares, winner, rival, passes, stands, lost)


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


def _steps_of_model(recording: Recording, place: int) -> list[tuple[str, int]]:
    """Return what the model's stage did after the verdict, and the class after each step."""
    heights = _model_stage(recording).vegetation_heights
    texts = {
        ClassStep.GIVEN_GROUND: "--ground given",
        ClassStep.HEIGHTS: f"--vegetation-heights {','.join(f'{height:g}' for height in heights)}",
    }
    steps = []
    if recording.steps[ClassStep.LIKELIEST][0][place] != GROUND:
        del texts[ClassStep.GIVEN_GROUND]
    for step, (codes, least) in recording.steps.items():
        if least is not None:
            limit = f"from a probability of {least[place]:.2f} on"
            texts[step] = f"--keep-sure ({limit if least[place] else 'no limit for it'})"
        if step in texts:
            steps.append((texts[step], int(codes[place])))
    return steps
