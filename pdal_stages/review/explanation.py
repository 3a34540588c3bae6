"""What is told of a point: where it is, what each stage made of it, and which inputs decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..base.asprs import BRIDGE, LOW_VEGETATION, MEDIUM_VEGETATION, TOWER, UNCLASSIFIED

#: How the stage of towers is called, which runs without an option.
TOWERS = "towers"
#: Options of `classify` that give points a class that the model did not find.
_MAKERS = {
    UNCLASSIFIED: "--keep-sure",
    LOW_VEGETATION: "--vegetation-heights",
    MEDIUM_VEGETATION: "--vegetation-heights",
    BRIDGE: "--bridges",
}


@dataclass(frozen=True)
class FoundPoint:
    """The point that is explained."""

    file: str
    number: int  #: in the file, from 0
    x: float
    y: float
    z: float
    distance_m: float  #: from the place that was asked for
    return_number: int
    number_of_returns: int
    checked: bool  #: a person has checked its class (``corrections``)


@dataclass(frozen=True)
class Noise:
    """The verdict of the noise stage on a point."""

    code: int  #: 7, 18 or 0
    state: str  #: solid, held, loose or unjudged, see :mod:`..terrain.detached`


@dataclass(frozen=True)
class GroundSteps:
    """Results of the steps of the ground filter for a point and its cell; in meters.

    Elevations of the cell are relative to the point: -4.2 is 4.2 m below it.
    """

    cell: float  #: side of the cell
    window: float  #: width of the largest opening
    lowest: float | None  #: point of the cell that may be ground; None: a low outlier, or none
    floor: float | None  #: what the openings left of it
    land: float | None  #: what the search for wide roofs left of it
    lowered: float  #: by how much openings lower the cell: more than 0 where it holds an object
    roof: float  #: how high a wide roof in it stands above the land; 0 for none
    rounds: Sequence[bool]  #: whether the cell is ground after each round that regains ground
    regained: int  #: the first of these, from 1; 0 for none
    has_steps: bool  #: whether ground is looked for in the cell
    is_object: bool  #: whether openings or wide roofs find an object in it
    is_given: bool  #: whether heights are those above given ground
    given: float | None  #: mean of the given ground in the cell
    lowest_near: float | None  #: point within 5 cells that may be ground
    raised: float  #: how high given ground stands above that point
    near: int  #: points within 5 m in plan
    lower: int  #: of them those more than 1 m below the point
    has_noise: bool  #: whether noise was left in
    height: float  #: above the ground
    above_provisional: float
    tolerance: float  #: how far from the provisional surface points are ground
    is_ground: bool
    openings: Mapping[float, float]  #: heights above openings, by the width of the window


@dataclass(frozen=True)
class PassInput:
    """An input of a pass, and what it added to the probabilities."""

    name: str
    value: float | None  #: None of all that is read of an earlier pass
    added: Mapping[int, float]  #: by class
    #: by class, the share of training samples with lower values; empty where that is not known
    below: Mapping[int, float]

    def speaks(self, code: int, rival: int) -> float:
        """Return how much more it added to one class than to another."""
        return self.added.get(code, 0.0) - self.added.get(rival, 0.0)


@dataclass(frozen=True)
class PassTrace:
    """The inputs of a pass of the model for a point, and its probabilities."""

    probabilities: Mapping[int, float]  #: by class, before priors
    start: Mapping[int, float]  #: before any input; empty where the learner cannot tell
    inputs: Sequence[PassInput]  #: largest first; empty likewise


@dataclass(frozen=True)
class LineTrace:
    """A point that may be part of a line, such as a wire."""

    probability: float  #: of classes of lines, by the last pass
    code: int  #: the likeliest of these classes
    is_on_line: bool  #: whether it lies on a line of such points
    became: int  #: its class then


@dataclass(frozen=True)
class Verdict:
    """The verdict of the model on a point."""

    model: str
    classes: Mapping[int, str]  #: names
    probabilities: Mapping[int, float]  #: after priors and lines
    winner: int
    rival: int  #: the class asked for, that of the file where the model has it, else the second
    passes: Sequence[PassTrace]  #: empty of a network
    has_reasons: bool  #: whether it is known what inputs add to the probabilities
    stands_for_it_m: float | None  #: how far away the point of its voxel is that is computed
    lines: LineTrace | None  #: None where it is unlikely to be part of a line


class StepAfter(NamedTuple):
    """A step after the model."""

    name: str  #: the option of `classify`, or the type of the stage
    code: int  #: class after it
    is_same: bool  #: whether it keeps the class


@dataclass(frozen=True)
class Explanation:
    """All steps by which a point came to its class."""

    point: FoundPoint
    in_file: int  #: class
    computed: int  #: class that the stages give now
    kept: str  #: why it is not classified; empty where it is
    noise: Noise | None  #: None where noise is not looked for, or the point was left out
    ground: GroundSteps | None  #: None of other heights
    verdict: Verdict | None  #: None where it is not classified
    steps: Sequence[StepAfter]
    #: dimensions of the file that the stages compute: the file's value, that of now, and whether
    #: both are the same but for rounding
    compared: Mapping[str, tuple[float, float, bool]]
    has_other_ground: bool  #: whether heights are compared, and are not the same
    has_other_model: bool  #: the same of reliabilities
    is_changed: bool  #: whether both are the same, and the class is another
    notes: Sequence[str]

    @property
    def makers(self) -> str:
        """Return the options by which the class in the file may have come after the model."""
        names = ["--polygons", *filter(None, [_MAKERS.get(self.in_file)])]
        return " or ".join(names + ["--no-towers"] * (self.computed == TOWER))
