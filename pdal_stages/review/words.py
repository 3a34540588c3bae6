"""The words of explanations: sentences by the record that they tell of, and the names of inputs.

Templates are filled in with fields and properties of the record.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Generic, TypeVar

from ..base.asprs import class_name
from ..base.dimensions import opening_width
from ..base.messages import one_line
from ..features.gap_below import NAME as GAP_BELOW
from ..features.registry import BY_NAME, SHAPES
from .explanation import TOWERS, Explanation, GroundSteps, Noise, StepAfter, Verdict

_Record = TypeVar("_Record")
#: Given ground that stands higher above the lowest point near, in meters, is doubted: that high
#: are hedges and low roofs, and not the ground on slopes of up to 45 %.
_HIGH_M = 2.25
#: Share of the points near up to which those far below are few.
_FEW = 0.1


@dataclass(frozen=True)
class Row(Generic[_Record]):
    """A row of the text about a record."""

    name: str  #: template of the first column
    text: str  #: template of the rest
    when: Callable[[_Record], object] = lambda _: True  #: tells whether it is shown


HEAD: Sequence[Row[Explanation]] = (
    Row(
        "",
        "point {point.number:,} of {point.file:line}: {point.x:.2f} {point.y:.2f} {point.z:.2f}, "
        "{point.distance_m:.2f} m away, return {point.return_number} of {point.number_of_returns}",
    ),
    Row("", "{in_file:class} in the file, {computed:class} computed now"),
)
_AGAIN = (
    "\nexplain it with the options of that run: those that give the file's values are the cause"
)
#: Where the class or a dimension is not that of the file: the first row that applies.
DIFFERENCE: Sequence[Row[Explanation]] = (
    Row("", "so a person set or confirmed the class (Checked is 1)", lambda v: v.point.checked),
    Row(
        "",
        "so the ground of that run was another: --ground, points that someone gave class 2, 9 or "
        "11, options\nof the ground filter, other points around, or another version of the filter"
        + _AGAIN,
        lambda v: v.has_other_ground,
    ),
    Row(
        "",
        "so the ground is the same, and the model is another: --model, a version of it, or options "
        "of its stage" + _AGAIN,
        lambda v: v.has_other_model,
    ),
    Row(
        "",
        "so the model of that run said the same, and the class was changed afterwards: by hand, by "
        "{makers},\nor --where left out a point that had it before",
        lambda v: v.is_changed,
    ),
    Row(
        "",
        "the file has no HeightAboveGround and Reliability that would tell where",
        lambda v: not v.kept,
    ),
)
_LONE = "yes, {code:class}: alone or in a cluster apart from all else, "
#: The first row that applies.
NOISE: Sequence[Row[Noise]] = (
    Row("noise", _LONE + "below the ground", lambda v: v.code == 7),
    Row("noise", _LONE + "in the air", lambda v: v.code),
    Row(
        "noise",
        "no: it belongs to something large, with points close to each other",
        lambda v: v.state == "solid",
    ),
    Row(
        "noise",
        "no: it stands apart, but near or under something large",
        lambda v: v.state == "held",
    ),
    Row(
        "noise",
        "not judged: it is left out, or there are too few points",
        lambda v: v.state == "unjudged",
    ),
    Row("noise", "no: it stands apart, but neither above what is around nor below the ground"),
)
_AWAY = (
    "{above_provisional:size} from the surface through ground cells, {tolerance:.2f} m allowed on "
    "its slope: "
)
GROUND: Sequence[Row[GroundSteps]] = (
    Row("its {cell:g} m cell", "lowest point: {lowest:relative}"),
    Row("within 5 m", "{lower:,} of {near:,} points lie more than 1 m below this point"),
    Row(
        "look",
        "so few are that low: echoes from below the ground? Noise is left in",
        lambda v: v.has_noise and 0 < v.lower <= _FEW * v.near and not v.is_ground,
    ),
    Row("--ground given", "mean of classes 2, 9, 11 there: {given:relative}", lambda v: v.is_given),
    Row("lowest near", "within 5 m: {lowest_near:relative}", lambda v: v.is_given),
    Row(
        "look",
        "given ground is {raised:.2f} m above the lowest point near: was a class edited?",
        lambda v: v.is_given and v.raised > _HIGH_M,
    ),
    Row(
        "openings",
        "windows that grow to {window:g} m do not lower the cell more than a slope would: it is "
        "ground so far",
        lambda v: v.has_steps and v.lowered <= 0,
    ),
    Row(
        "openings",
        "windows that grow to {window:g} m, the first that tells lowers the cell by {lowered:.2f} "
        "m: it holds an object",
        lambda v: v.has_steps and v.lowered > 0,
    ),
    Row(
        "wide roof",
        "a roof wider than the windows, {roof:.2f} m above the land: an object, too",
        lambda v: v.roof > 0,
    ),
    Row(
        "regained",
        "the cell is ground after all, in round {regained}: it continues the ground around",
        lambda v: v.is_object and v.regained,
    ),
    Row(
        "regained",
        "no: the cell does not continue the ground around",
        lambda v: v.is_object and not v.regained,
    ),
    Row("the point", _AWAY + "ground", lambda v: v.is_ground),
    Row("the point", _AWAY + "not ground", lambda v: not v.is_ground),
    Row("height", "{height:.2f} m above ground", lambda v: not v.openings),
    Row(
        "height",
        "{height:.2f} m above ground; above what an opening leaves: {openings:windows}",
        lambda v: v.openings,
    ),
)
_LINES = "{lines.probability:.2f} for {lines.code:class}, "
MODEL: Sequence[Row[Verdict]] = (
    Row(
        "values",
        "those of a point {stands_for_it_m:.2f} m away, which stands for all of its voxel",
        lambda v: v.stands_for_it_m is not None,
    ),
    Row(
        "lines",
        _LINES + "and it lies on a line of such points, so it is one",
        lambda v: v.lines and v.lines.is_on_line,
    ),
    Row(
        "lines",
        _LINES + "but it lies on no line of such points: it is {lines.became:class}",
        lambda v: v.lines and not v.lines.is_on_line,
    ),
    Row(
        "reasons",
        "a network, or another learner than a forest, gives none",
        lambda v: not v.has_reasons,
    ),
)
#: The first row that applies.
AFTER: Sequence[Row[StepAfter]] = (
    Row("{name}", "keeps the class", lambda v: v.is_same),
    Row(
        "{name}",
        "makes it {code:class}: part of something slender that holds wires",
        lambda v: v.name == TOWERS,
    ),
    Row("{name}", "makes it {code:class}"),
)


class _Fields(Formatter):
    """Fills templates with fields and properties of a record, in the units of the text."""

    def get_value(self, key: int | str, args: Sequence[object], kwargs: object) -> object:
        """Return a field of the record, the only argument."""
        return getattr(args[0], str(key))

    def format_field(self, value: object, format_spec: str) -> str:
        """Return a value in its unit."""
        if isinstance(value, (float, int)) and format_spec in ("relative", "size"):
            side = "below this point" if value <= 0 else "above this point"
            return f"{abs(value):.2f} m {side if format_spec == 'relative' else ''}".rstrip()
        if isinstance(value, int) and format_spec == "class":
            return f"{value} {class_name(value)}"
        if isinstance(value, dict) and format_spec == "windows":
            return ", ".join(f"{high:.2f} m ({width:g} m window)" for width, high in value.items())
        if format_spec == "line":
            return one_line(str(value))
        return "none" if value is None else super().format_field(value, format_spec)


def fill(table: Sequence[Row[_Record]], record: _Record) -> list[tuple[str, str]]:
    """Return name and text of the rows of a table that apply to a record."""
    fields = _Fields()
    chosen = [row for row in table if row.when(record)]
    return [(fields.format(row.name, record), fields.format(row.text, record)) for row in chosen]


#: Feature or dimension -> words, and the unit of its values.
_INPUTS = {
    "Linearity": ("how linear, 0 to 1", ""),
    "Planarity": ("how planar, 0 to 1", ""),
    "Scattering": ("how scattered, 0 to 1", ""),
    "Omnivariance": ("how scattered (omnivariance)", ""),
    "Anisotropy": ("1 - scattered (anisotropy)", ""),
    "Eigenentropy": ("disorder (eigenentropy)", ""),
    "EigenvalueSum": ("spread (sum of eigenvalues)", "m2"),
    "SurfaceVariation": ("roughness (surface variation)", ""),
    "Density": ("density", ""),
    "Verticality": ("steepness, 0 flat, 1 a wall", ""),
    "HeightRange": ("highest minus lowest", "m"),
    "HeightStd": ("standard deviation of heights", "m"),
    "Radius": ("radius chosen", "m"),
    "HeightAboveLowest": ("height above the lowest", "m"),
    "NormalAgreement": ("agreement of normals, 1 on a plane", ""),
    "SurfaceVariationMin": ("roughness where it is least", ""),
    "SurfaceVariationMean": ("mean roughness", ""),
    "SurfaceVariationStd": ("how the roughness varies", ""),
    "HeightAboveGround": ("height above ground", "m"),
    "Ground": ("ground by the filter: 1 yes, 0 no", ""),
    "MultipleReturn": ("pulses with several returns", ""),
    "EarlierReturn": ("returns before the last", ""),
    GAP_BELOW: ("empty space below, up to 20", "m"),
}
#: How the end of a feature's name begins -> words for its neighborhood; the longer ones first.
_NEIGHBORHOODS = {
    "box": "3 x 3 x 3 cells of {} m",
    "column": "3 x 3 columns of {} m",
    "c": "cylinder of {} m",
    "s": "sphere of {} m",
    "k": "{} nearest points",
}


def words_for(name: str) -> tuple[str, str]:
    """Return an input in words, and the unit of its values; of an unknown one its own name."""
    if (width := opening_width(name)) is not None:
        return f"height above what a window of {width:g} m leaves", "m"
    feature, _, where = name.partition("_")
    if feature in SHAPES:
        return SHAPES[feature], "share"
    if feature not in _INPUTS:
        return (BY_NAME[feature].definition if feature in BY_NAME else name), ""
    words, unit = _INPUTS[feature]
    for head, text in _NEIGHBORHOODS.items():
        size = where.removeprefix(head).replace("_", ".")
        if where.startswith(head) and size.replace(".", "").isdecimal():
            return f"{words}, {text.format(size)}", unit
    return f"{words}, {where}" if where else words, unit


def show_value(name: str, value: float) -> str:
    """Return the value of an input with its unit."""
    value = 0.0 if abs(value) < 5e-4 else value
    return f"{value:.3g} {words_for(name)[1]}".rstrip()
