"""Explanations as text: about a screen, for people who know lidar and not the code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..base.asprs import (
    BRIDGE,
    LOW_VEGETATION,
    MEDIUM_VEGETATION,
    TOWER,
    UNCLASSIFIED,
    class_name,
)
from ..base.messages import one_line
from ..terrain.detached import HEAVY, HELD, LOOSE, SOLID, UNJUDGED
from .explanation import Explanation, GroundSteps, PassInput, PassTrace, Verdict
from .input_words import words_for
from .trace_points import SURROUNDINGS

#: Inputs that are shown of the last pass, beside its surroundings.
_OF_LAST = 4
#: Inputs that are shown of the first pass.
_OF_FIRST = 10
#: Given ground that stands higher above the lowest point near, in meters, is doubted: that high
#: are hedges and low roofs, and not the ground on slopes of up to 45 %.
_HIGH_M = 2.25
#: Options of `classify` that run stages after the model.
_OPTIONS = {
    "filters.towers": "towers",
    "filters.bridges": "--bridges",
    "filters.polygons": "--polygons",
}
#: Stages that run without an option, and are named where they change the class.
_BY_DEFAULT = ("filters.towers",)
#: Options of `classify` that give points a class that the model did not find.
_MAKERS = {
    UNCLASSIFIED: "--keep-sure",
    LOW_VEGETATION: "--vegetation-heights",
    MEDIUM_VEGETATION: "--vegetation-heights",
    BRIDGE: "--bridges",
}
_APART = "no: it stands apart, but neither above what is around nor below the ground"
#: Why a point is no noise, by its state.
_NO_NOISE = {
    SOLID: "no: it belongs to something large, with points close to each other",
    HELD: "no: it stands apart, but near something large",
    LOOSE: _APART,
    HEAVY: _APART,
    UNJUDGED: "not judged: it is left out, or there are too few points",
}
#: What to do where the run that made a file differs from that of now.
_AGAIN = (
    "\nexplain it with the options of that run: those that give the file's values are the cause"
)
#: Share of the points near up to which those far below are few.
_FEW = 0.1
#: Width of the column of names.
_NAME = 16
#: Width of a number.
_NUMBER = 12


def lines(told: Explanation) -> list[str]:
    """Return an explanation as lines of text."""
    point = told.point
    number = f"point {point.number:,} of {one_line(point.file)}"
    place = f"{point.x:.2f} {point.y:.2f} {point.z:.2f}, {point.distance_m:.2f} m away"
    return [
        f"{number}: {place}, return {point.return_number} of {point.number_of_returns}",
        f"{_class(told.in_file)} in the file, {_class(told.computed)} computed now",
        *_differences(told),
        "",
        "WHAT BECOMES OF IT, COMPUTED NOW",
        _row("noise", _noise(told)),
        *(
            [_row("ground", "found by another stage")]
            if told.ground is None
            else _ground(told.ground, told.noise is None)
        ),
        "",
        "WHAT THE MODEL SEES",
        *(
            [_row("nothing", told.kept)]
            if told.verdict is None
            else _verdict(told.verdict, _is_changed(told))
        ),
        "",
        "WHAT COMES AFTER, BY THE OPTIONS GIVEN HERE",
        *_steps(told),
        *(_row("note", note) for note in told.notes),
    ]


def _steps(told: Explanation) -> list[str]:
    """Return what each step after the model made of the class."""
    before, out = told.in_file if told.verdict is None else told.verdict.winner, []
    for name, code in told.steps:
        if code == before and name in _BY_DEFAULT:
            continue
        changes = "keeps the class" if code == before else f"makes it {_class(code)}"
        if name == "filters.towers":
            changes += ": part of something slender that holds wires"
        out.append(_row(_OPTIONS.get(name, name), changes))
        before = code
    return out or [_row("nothing", "none of them changes classes after the model")]


def _row(name: str, text: str) -> str:
    return f"  {name:<{_NAME}} {text}" if len(name) <= _NAME else f"  {name}: {text}"


def _class(code: int) -> str:
    return f"{code} {class_name(code)}"


def _differences(told: Explanation) -> list[str]:
    """Return what differs from the run that gave the file its class."""
    known = {name: same for name, (_, _, same) in told.compared.items()}
    if told.in_file == told.computed and all(known.values()):
        return []
    out = [
        f"{name} is {before:.2f} in the file, {now:.2f} now"
        for name, (before, now, _) in told.compared.items()
    ]
    if told.point.checked:
        out.append("so a person set or confirmed the class (Checked is 1)")
    elif known.get("HeightAboveGround") is False:
        out.append(
            "so the ground of that run was another: --ground, points that someone gave class 2, 9 "
            "or 11, options\nof the ground filter, other points around, or another version of the "
            f"filter{_AGAIN}"
        )
    elif known.get("Reliability") is False:
        out.append(
            "so the ground is the same, and the model is another: --model, a version of it, or "
            f"options of its stage{_AGAIN}"
        )
    elif _is_changed(told):
        makers = ["--polygons", *filter(None, [_MAKERS.get(told.in_file)])]
        makers += ["--no-towers"] if told.computed == TOWER else []
        out.append(
            "so the model of that run said the same, and the class was changed afterwards: by "
            f"hand, by {' or '.join(makers)},\nor --where left out a point that had it before"
        )
    elif not told.kept:
        out.append("the file has no HeightAboveGround and Reliability that would tell where")
    return ["", "WHAT DIFFERS", *(f"  {line}" for text in out for line in text.split("\n"))]


def _is_changed(told: Explanation) -> bool:
    """Return whether a class was changed after the model: height and reliability are the same."""
    same = [is_same for _, _, is_same in told.compared.values()]
    return told.in_file != told.computed and len(same) == 2 and all(same)


def _noise(told: Explanation) -> str:
    """Return whether it is noise, and why."""
    if told.noise is None:
        return told.kept or "not looked for (--no-noise)"
    if told.noise.code:
        where = "below the ground" if told.noise.code == 7 else "in the air"
        return f"yes, {_class(told.noise.code)}: alone or in a small cluster, {where}"
    return _NO_NOISE[told.noise.state]


# ---- the ground filter ---------------------------------------------------------------------------


def _ground(ground: GroundSteps, no_noise: bool) -> list[str]:
    """Return what each step of the ground filter made of its cell; `no_noise`: it is left in."""
    name = f"its {ground.cell:g} m cell"
    out = [_row(name, f"lowest point: {_relative(ground.lowest)}")]
    lower = f"{ground.lower:,} of {ground.near:,} points lie more than 1 m below this point"
    out.append(_row("within 5 m", lower))
    few = 0 < ground.lower <= _FEW * ground.near
    if no_noise and few and not ground.is_ground:
        out.append(
            _row("look", "so few are that low: echoes from below the ground? Noise is left in")
        )
    if ground.is_given:
        mean = f"mean of classes 2, 9, 11 there: {_relative(ground.given)}"
        out.append(_row("--ground given", mean))
        high = (ground.given or 0.0) - (ground.lowest_near or 0.0)
        out.append(_row("lowest near", f"within 5 m: {_relative(ground.lowest_near)}"))
        if ground.given is not None and high > _HIGH_M:
            text = f"given ground is {high:.2f} m above the lowest point near: was a class edited?"
            out.append(_row("look", text))
    elif ground.lowest is not None:
        out += _cell_steps(ground, ground.lowest)
    away = f"{abs(ground.above_provisional):.2f} m from the surface through ground cells"
    judged = (
        f"{ground.tolerance:.2f} m allowed on its slope: {'' if ground.is_ground else 'not '}ground"
    )
    height = f"{ground.height:.2f} m above ground"
    if ground.openings:
        each = (f"{high:.2f} m ({width:g} m window)" for width, high in ground.openings.items())
        height += f"; above what an opening leaves: {', '.join(each)}"
    return [*out, _row("the point", f"{away}, {judged}"), _row("height", height)]


def _relative(height: float | None) -> str:
    if height is None:
        return "none"
    return f"{abs(height):.2f} m {'below' if height <= 0 else 'above'} this point"


def _cell_steps(ground: GroundSteps, lowest: float) -> list[str]:
    """Return what openings, wide roofs and rounds made of a cell, whose lowest point is given."""
    floor = lowest if ground.floor is None else ground.floor
    land = floor if ground.land is None else ground.land
    width = f"windows that grow to {ground.window:g} m"
    opened = f"{width} do not lower the cell more than a slope would: it is ground so far"
    if floor < lowest:
        lowered = f"the first that tells lowers the cell by {lowest - floor:.2f} m"
        opened = f"{width}, {lowered}: it holds an object"
    out = [_row("openings", opened)]
    if land < floor:
        roof = f"a roof wider than the windows, {floor - land:.2f} m above the land: an object, too"
        out.append(_row("wide roof", roof))
    if land >= lowest:
        return out
    first = next((n for n, ground_now in enumerate(ground.rounds, 1) if ground_now), 0)
    regained = f"the cell is ground after all, in round {first}: it continues the ground around"
    no = "no: the cell does not continue the ground around"
    return [*out, _row("regained", regained if first else no)]


# ---- the model -----------------------------------------------------------------------------------


def _verdict(verdict: Verdict, is_changed: bool) -> list[str]:
    """Return the probabilities of each pass, and the inputs that decided."""
    codes, passes = list(verdict.classes), verdict.passes
    names = {code: _short(code) for code in codes}
    model = one_line(Path(verdict.model).name)[-_NAME:]
    out = [_row(model, "".join(f"{name:>{_NUMBER}}" for name in names.values()))]
    shares = {f"pass {n}": each.probabilities for n, each in enumerate(passes, 1)}
    for name, share in {**shares, "in the end": verdict.probabilities}.items():
        out.append(_row(name, "".join(f"{share.get(code, 0.0):>{_NUMBER}.2f}" for code in codes)))
    if verdict.stands_for_it_m is not None:
        away = f"{verdict.stands_for_it_m:.2f} m away"
        out.append(_row("values", f"those of a point {away}, which stands for all of its voxel"))
    for code in verdict.excluded:
        out.append(_row("no line", f"of such points passes here, so it is no {_class(code)}"))
    if not passes or not passes[0].start:
        return [*out, _row("reasons", "a network, or another learner than a forest, gives none")]
    if is_changed:
        return [
            *out,
            _row("reasons", "not shown, as the class is not the model's; --json has them"),
        ]
    pair = verdict.winner, verdict.rival
    ranges = any(each.below for single in passes for each in single.inputs)
    first, second = (class_name(code) for code in pair)
    about = "and the share of the training's points of either class that lie lower (50 %: half)."
    if not ranges:
        about = "(The model file has no percentiles of its training to compare it with.)"
    titles = [*map(_short, pair), "value", *(map(_short, pair) if ranges else ())]
    out += [
        "",
        f"  For {first}, against {second}: what inputs add to their probabilities, the value,",
        f"  {about}",
        "  " + "".join(f"{title:>{_NUMBER}}" for title in titles),
    ]
    for number in sorted({1, len(passes)}):
        count = _OF_LAST if number > 1 else _OF_FIRST
        out += _rows(number, passes[number - 1], pair, count, ranges)
    return out


def _short(code: int) -> str:
    """Return a class's name, or the last word of a long one."""
    name = class_name(code).split(" - ")[0]
    return name if len(name) < _NUMBER else name.split()[-1].capitalize()[: _NUMBER - 1]


def _rows(
    number: int, single: PassTrace, pair: tuple[int, int], count: int, ranges: bool
) -> list[str]:
    """Return rows for the inputs of a pass that tell two classes apart most."""

    def weight(each: PassInput) -> float:
        return each.added.get(pair[0], 0.0) - each.added.get(pair[1], 0.0)

    ranked = sorted(single.inputs, key=lambda each: -abs(weight(each)))
    chosen = [each for each in ranked if each.name != SURROUNDINGS][:count]
    chosen += [each for each in ranked if each.name == SURROUNDINGS]
    rest = [sum(e.added.get(c, 0.0) for e in ranked if e not in chosen) for c in pair]
    shares = [f"{single.start.get(code, 0.0):.3f}" for code in pair]
    out = [_columns(shares, ranges, f"where pass {number} starts, knowing nothing")]
    for each in sorted(chosen, key=lambda each: -weight(each)):
        words, _ = words_for(each.name)
        added = [f"{each.added.get(code, 0.0):+.3f}" for code in pair]
        if each.value is None:
            out.append(_columns(added, ranges, f"surroundings: pass {number - 1}, here and around"))
            continue
        below = [f"{100 * each.below[c]:.0f} %" if c in each.below else "" for c in pair]
        out.append(_columns([*added, show_value(each), *(below if ranges else ())], ranges, words))
    return [*out, _columns([f"{value:+.3f}" for value in rest], ranges, "all others")]


def show_value(each: PassInput) -> str:
    """Return the value of an input with its unit."""
    value = 0.0 if each.value is None or abs(each.value) < 5e-4 else each.value
    return f"{value:.3g} {words_for(each.name)[1]}".rstrip()


def _columns(values: Sequence[str], ranges: bool, words: str) -> str:
    """Return a row of numbers, and what they are."""
    padded = [*values, *[""] * ((5 if ranges else 3) - len(values))]
    return "  " + "".join(f"{value:>{_NUMBER}}" for value in padded) + f"  {words}"
