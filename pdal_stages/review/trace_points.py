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
from ..classifier.training_percentiles import PercentileTable, share_below
from ..stages.apply_model import ApplyModel
from ..stages.base import Kept
from ..stages.detached_noise import DetachedNoise
from ..stages.hag_morphological import HagMorphological
from ..terrain.detached import HELD, LOOSE, SOLID, UNJUDGED
from ..terrain.heights import JUDGED, PLACED
from .explanation import (
    TOWERS,
    Explanation,
    FoundPoint,
    GroundSteps,
    LineTrace,
    Noise,
    PassInput,
    PassTrace,
    StepAfter,
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
#: Names of states of noise.
_STATES = {SOLID: "solid", HELD: "held", LOOSE: "loose", UNJUDGED: "unjudged"}
#: Stages after the model by the options that run them.
_OPTIONS = {
    "filters.towers": TOWERS,
    "filters.bridges": "--bridges",
    "filters.polygons": "--polygons",
}


def trace_point(
    recording: Recording, place: int, distance_m: float, against: int | None = None
) -> Explanation:
    """Return how a point came to its class; `place` is its number among those of the recording.

    `against` is the class that the one found is compared with, if the model has both.
    """
    cloud, row = recording.cloud, int(recording.rows[place])
    codes = [int(cloud["Classification"][row]), *(int(c[place]) for c in recording.classes)]
    stages = recording.stages
    model_at = next(n for n, stage in enumerate(stages) if isinstance(stage, ApplyModel))
    kept, before, verdict, same = _why_kept(recording, place, codes[model_at]), codes[0], None, {}
    steps = [
        (_OPTIONS.get(stage.type, stage.type), code)
        for stage, code in zip(stages[model_at + 1 :], codes[model_at + 2 :], strict=True)
    ]
    compared: dict[str, tuple[float, float, bool]] = {}
    if not kept:
        verdict = _verdict(recording, place, against or codes[0])
        steps, before = [*_steps_of_model(recording, place), *steps], verdict.winner
        for name, step in _COMPARED.items():
            if name in cloud and name in recording.results:
                was, now = float(cloud[name][row]), float(recording.results[name][place])
                same[name] = abs(was - now) <= 0.51 * step + 1e-4
                compared[name] = was, now, same[name]
    classes = [before, *(code for _, code in steps)]
    return Explanation(
        point=_point(recording, row, distance_m),
        in_file=codes[0],
        computed=codes[-1],
        kept=kept,
        noise=_noise(recording, place, codes),
        ground=_ground(recording, place),
        verdict=verdict,
        steps=[StepAfter(*s, s[1] == code) for s, code in zip(steps, classes, strict=False)],
        compared=compared,
        has_other_ground=not same.get("HeightAboveGround", True),
        has_other_model=not same.get("Reliability", True),
        is_changed=codes[0] != codes[-1] and len(same) == 2 and all(same.values()),
        notes=recording.notes,
    )


def _noise(recording: Recording, place: int, codes: Sequence[int]) -> Noise | None:
    """Return whether a point is noise; `codes` are its class in the file and after each stage."""
    if not len(recording.noise):
        return None
    at = next(n for n, each in enumerate(recording.stages, 1) if isinstance(each, DetachedNoise))
    code = codes[at] if codes[at] != codes[0] else 0
    return Noise(code, _STATES[int(recording.noise[place])])


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
    cloud, row, units = recording.cloud, recording.rows[place], recording.reference.units
    z = float(cloud["Z"][row]) * units.vertical

    def elevation(step: str, cells: int = 0) -> float | None:
        """Return what a step made of the cell, or the least of those around, above the point."""
        if step not in piece:
            return None
        window, values = piece[step]
        j, i = line - window.bottom, column - window.left
        part = values[max(j - cells, 0) : j + cells + 1, max(i - cells, 0) : i + cells + 1]
        known = part[np.isfinite(part)]
        return float(known.min()) - z if len(known) else None

    away = (units.horizontal * (cloud[axis] - cloud[axis][row]) for axis in "XY")
    near = np.hypot(*away) <= _NEAR_M
    lower = cloud["Z"][near] * units.vertical < z - _LOWER_M
    lowest = elevation("low_outliers" if "low_outliers" in piece else "minimum_grid")
    floor, land = elevation("openings"), elevation("wide_roofs")
    lowest_near = elevation("low_outliers", round(_NEAR_M / cell))
    mean = elevation("given_ground")
    rounds = [elevation(name) is not None for name in piece if name.startswith("round_")]
    lowered = 0.0 if lowest is None or floor is None else lowest - floor
    roof = 0.0 if floor is None or land is None else floor - land
    return GroundSteps(
        cell=cell,
        window=2 * stage.options["window"] + cell,
        lowest=lowest,
        floor=floor,
        land=land,
        lowered=lowered,
        roof=roof,
        rounds=rounds,
        regained=rounds.index(True) + 1 if any(rounds) else 0,
        has_steps=lowest is not None and not stage.given_ground,
        is_object=lowered > 0 or roof > 0,
        is_given=stage.given_ground,
        given=mean,
        lowest_near=lowest_near,
        raised=0.0 if mean is None else mean - (lowest_near or 0.0),
        near=len(lower),
        lower=int(np.count_nonzero(lower)),
        has_noise=not len(recording.noise),
        height=heights["HeightAboveGround"],
        above_provisional=heights[JUDGED[0]],
        tolerance=heights[JUDGED[1]],
        is_ground=bool(heights["Ground"]),
        openings={width: heights[opening(width).name] for width in stage.openings},
    )


# ---- the model -----------------------------------------------------------------------------------


def _model_stage(recording: Recording) -> ApplyModel:
    """Return the stage of the model."""
    return next(stage for stage in recording.stages if isinstance(stage, ApplyModel))


def _verdict(recording: Recording, place: int, against: int) -> Verdict:
    """Return what the model said of a point; `against` is the rival, if it can be."""
    stage, units = _model_stage(recording), recording.reference.units
    model, names = stage.model, dict(stage.model.classes)
    shares = {code: float(recording.results[f"Probability_{code}"][place]) for code in names}
    winner, lines = int(recording.steps[ClassStep.LIKELIEST][0][place]), None
    if recording.lines is not None and (share := float(recording.lines[0][place])):
        became = int(recording.steps[ClassStep.LINES][0][place])
        is_on_line = bool(model.lines[model.codes == became].any())
        lines = LineTrace(share, int(recording.lines[1][place]), is_on_line, became)
        winner = became if is_on_line else winner
    others = [code for code in names if code != winner]
    rival = against if against in others else max(others, key=lambda code: shares[code])
    by_pass: dict[int, PassTrace] = {}
    stands = None
    for each in recording.inputs:
        rows = np.flatnonzero(each.rows == recording.rows[place])
        if each.number not in by_pass and rows.size:
            by_pass[each.number] = _trace_pass(model, each, int(rows[0]))
            xyz = [recording.cloud[axis][recording.rows[place]] for axis in "XYZ"]
            meters = np.array(xyz) * [units.horizontal, units.horizontal, units.vertical]
            away = float(np.linalg.norm(each.xyz[rows[0]] - meters))
            stands = away if away > 1e-5 else None
    passes = [by_pass[number] for number in sorted(by_pass)]
    has_reasons = bool(passes and passes[0].start)
    return Verdict(
        stage.model_file, names, shares, winner, rival, passes, has_reasons, stands, lines
    )


def _trace_pass(model: Model, read: PassInputs, at: int) -> PassTrace:
    """Return the contributions of a pass's inputs to a point; those of an earlier pass as one."""
    single = model.passes[read.number]

    def by_class(values: NDArray) -> dict[int, float]:
        return dict(zip(model.codes_of[read.number], values.tolist(), strict=True))

    probabilities = by_class(read.probabilities[at])
    values = read.values[at : at + 1]
    contributions = single.contributions(values) if isinstance(single, FeatureForest) else None
    if not isinstance(single, FeatureForest) or contributions is None:
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


def _steps_of_model(recording: Recording, place: int) -> list[tuple[str, int]]:
    """Return what the model's stage did after the verdict, and the class after each step."""
    heights = ",".join(f"{height:g}" for height in _model_stage(recording).vegetation_heights)
    names = {ClassStep.HEIGHTS: f"--vegetation-heights {heights}"}
    if recording.steps[ClassStep.LIKELIEST][0][place] == GROUND:
        names[ClassStep.GIVEN_GROUND] = "--ground given"
    for step, (_, least) in recording.steps.items():
        if least is not None:
            limit = f"from a probability of {least[place]:.2f} on"
            names[step] = f"--keep-sure ({limit if least[place] else 'no limit for it'})"
    return [
        (names[step], int(codes[place]))
        for step, (codes, _) in recording.steps.items()
        if step in names
    ]
