"""Explanations as text: about a screen, for people who know lidar and not the code.

The sentences are rows of :mod:`.words`; here is their order, and the table of the model's inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from ..base.asprs import class_name
from ..base.messages import one_line
from .explanation import TOWERS, Explanation, PassTrace, Verdict
from .trace_points import SURROUNDINGS
from .words import (
    AFTER,
    DIFFERENCE,
    GROUND,
    HEAD,
    MODEL,
    NOISE,
    Row,
    fill,
    show_value,
    words_for,
)

_Record = TypeVar("_Record")

#: Inputs that are shown of the last pass, beside its surroundings.
_OF_LAST = 4
#: Inputs that are shown of the first pass.
_OF_FIRST = 10
#: Width of the column of names.
_NAME = 16
#: Width of a number.
_NUMBER = 12


def _fill(table: Sequence[Row[_Record]], record: _Record) -> list[str]:
    """Return the rows of a table that apply to a record."""
    return [_row(name, text) for name, text in fill(table, record)]


def _row(name: str, text: str) -> str:
    """Return a row with a name; one without begins at the margin."""
    if not name:
        return text
    return f"  {name:<{_NAME}} {text}" if len(name) <= _NAME else f"  {name}: {text}"


def lines(told: Explanation) -> list[str]:
    """Return an explanation as lines of text."""
    noise = [_row("noise", told.kept or "not looked for (--no-noise)")]
    ground = [_row("ground", "found by another stage")]
    model = [_row("nothing", told.kept)]
    return [
        *_fill(HEAD, told),
        *_differences(told),
        "",
        "WHAT BECOMES OF IT, COMPUTED NOW",
        *(noise if told.noise is None else _fill(NOISE, told.noise)[:1]),
        *(ground if told.ground is None else _fill(GROUND, told.ground)),
        "",
        "WHAT THE MODEL SEES",
        *(model if told.verdict is None else _verdict(told.verdict, told.is_changed)),
        "",
        "WHAT COMES AFTER, BY THE OPTIONS GIVEN HERE",
        *_steps(told),
        *(_row("note", note) for note in told.notes),
    ]


def _differences(told: Explanation) -> list[str]:
    """Return what differs from the run that gave the file its class."""
    if told.in_file == told.computed and all(same for _, _, same in told.compared.values()):
        return []
    out = [
        f"{name} is {before:.2f} in the file, {now:.2f} now"
        for name, (before, now, _) in told.compared.items()
    ]
    out += [line for text in _fill(DIFFERENCE, told)[:1] for line in text.split("\n")]
    return ["", "WHAT DIFFERS", *(f"  {line}" for line in out)]


def _steps(told: Explanation) -> list[str]:
    """Return what each step after the model made of the class."""
    shown = [step for step in told.steps if not (step.is_same and step.name == TOWERS)]
    rows = [row for step in shown for row in _fill(AFTER, step)[:1]]
    return rows or [_row("nothing", "none of them changes classes after the model")]


# ---- the model -----------------------------------------------------------------------------------


def _verdict(verdict: Verdict, is_changed: bool) -> list[str]:
    """Return the probabilities of each pass, and the inputs that decided."""
    passes = verdict.passes
    shares = {f"pass {n}": each.probabilities for n, each in enumerate(passes, 1)}
    out = [
        _row(
            one_line(Path(verdict.model).name)[-_NAME:],
            "".join(f"{_short(code):>{_NUMBER}}" for code in verdict.classes),
        )
    ]
    for name, share in {**shares, "in the end": verdict.probabilities}.items():
        numbers = (f"{share.get(code, 0.0):>{_NUMBER}.2f}" for code in verdict.classes)
        out.append(_row(name, "".join(numbers)))
    out += _fill(MODEL, verdict)
    if not verdict.has_reasons:
        return out
    if is_changed:
        no = "not shown, as the class is not the model's; --json has them"
        return [*out, _row("reasons", no)]
    pair = verdict.winner, verdict.rival
    ranges = any(each.below for single in passes for each in single.inputs)
    first, second = map(class_name, pair)
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
        out += _rows_of_pass(number, passes[number - 1], pair, count, ranges)
    return out


def _short(code: int) -> str:
    """Return a class's name, or the last word of a long one."""
    name = class_name(code).split(" - ")[0]
    return name if len(name) < _NUMBER else name.split()[-1].capitalize()[: _NUMBER - 1]


def _rows_of_pass(
    number: int, single: PassTrace, pair: tuple[int, int], count: int, ranges: bool
) -> list[str]:
    """Return rows for the inputs of a pass that tell two classes apart most."""
    ranked = sorted(single.inputs, key=lambda each: -abs(each.speaks(*pair)))
    chosen = [each for each in ranked if each.name != SURROUNDINGS][:count]
    chosen += [each for each in ranked if each.name == SURROUNDINGS]
    rest = [sum(e.added.get(c, 0.0) for e in ranked if e not in chosen) for c in pair]
    start = [f"{single.start.get(code, 0.0):.3f}" for code in pair]
    rows = [(start, f"where pass {number} starts, knowing nothing")]
    for each in sorted(chosen, key=lambda each: -each.speaks(*pair)):
        words, values = words_for(each.name)[0], [f"{each.added.get(c, 0.0):+.3f}" for c in pair]
        if each.value is None:
            words = f"surroundings: pass {number - 1}, here and around"
        else:
            below = [f"{100 * each.below[c]:.0f} %" if c in each.below else "" for c in pair]
            values += [show_value(each.name, each.value), *below]
        rows.append((values, words))
    rows.append(([f"{value:+.3f}" for value in rest], "all others"))
    width = _NUMBER * (5 if ranges else 3)
    cells = ("".join(f"{value:>{_NUMBER}}" for value in values) for values, _ in rows)
    return [f"  {each[:width]:<{width}}  {row[1]}" for each, row in zip(cells, rows, strict=True)]
