"""``filters.modelclassifier``: apply a model file, write ASPRS classes [B16, W18]."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import (
    HIGH_VEGETATION,
    LOW_VEGETATION,
    MEDIUM_VEGETATION,
    TERRAIN,
    UNCLASSIFIED,
    by_height,
)
from ..base.dimensions import (
    CLASSIFICATION,
    HEIGHT,
    MARGIN,
    RELIABILITY,
    VARIANCE,
    Dimension,
    probability,
)
from ..base.errors import OptionError
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Count, Report
from ..base.progress import Progress
from ..base.units import doubt_vertical_unit, is_too_flat, median_slope
from ..classifier.calibration import ReliabilityLimits, read_calibration
from ..classifier.interface import ClassStep
from ..classifier.model import Model, loaded_model
from ..classifier.model_file import find
from ..classifier.prediction import (
    LineCandidates,
    Locate,
    PointRoles,
    Prediction,
    PredictionOptions,
)
from ..terrain.filter_options import FilterOptions
from .base import Kept, Observer, Stage, StageContext
from .options import Selection, ignore_option, keep_option, option
from .points import LAS_DIMENSIONS, RESERVED, Points, class_counts
from .preprocessing import as_json, same, with_given_ground

_HEIGHT = HEIGHT.name
#: Distance from given ground, in meters, up to which points without the dimension Ground may become
#: ground: the default threshold of filters.hag_morphological.
_TOLERANCE_M = FilterOptions.threshold
#: Steps per 1 to which compact outputs round probabilities and the like. A power of two: the last
#: bytes of the floats are then zero and compress to nothing.
_STEPS = 64
#: The same for heights, steps per unit of z.
_HEIGHT_STEPS = 32
#: The part of the stage that gives every point its probabilities ...
PROBABILITIES = "probabilities"
#: ... and the one that finds lines among these.
LINES = "lines"
#: What the first part leaves for the second: of points that may be part of lines, else 0.
_CANDIDATES = (
    Dimension(f"{RESERVED}LineProbability", "float", "1", "probability of classes of lines"),
    Dimension(f"{RESERVED}LineClass", "uint8_t", "1", "class on a line"),
    Dimension(f"{RESERVED}OtherClass", "uint8_t", "1", "class on no line"),
)


class ApplyModel(Stage, settings=PredictionOptions):
    """Classify points with a model file."""

    type = "filters.modelclassifier"
    summary = "Apply a model file: compute what the model needs block by block, and write classes"
    source = "[B16] section 3.4, [W18] section 3.3, [WM19] for networks"
    where_chooses = True
    where_help = "Points outside keep their class but still serve as neighbors"
    forgets = True
    rejected = Count("rejected as unreliable")
    ignored = Count("noise and withheld points, not classified (ignore)")
    kept = Count("class kept (keep)")
    outside_where = Count("outside where")
    model_file: str = option(
        "model",
        None,
        "The model file to apply, or the name of a shipped one (standard)",
        required=True,
        name="model",
    )
    variance: bool
    probabilities: bool
    reject_below: float | None
    rejected_code: int | None
    keep_sure: float | None = option(
        "number",
        None,
        "Keep a class only where this share is expected to be right, e.g. 0.98; others get "
        "rejected_code (default 1)",
        *(0.5, 0.999),
    )
    ignore: Selection = ignore_option()
    keep: Selection = keep_option(
        "Points that are neighbors but keep their class, written as for ignore; default: 12, "
        "overlap of strips, which classifying would overwrite"
    )
    vegetation_heights: list[float] = option(
        "numbers",
        (),
        "Two heights in meters, e.g. 0.5,2: vegetation (5) below them becomes low (3) and medium "
        "(4)",
        *(0, 1000),  # nothing grows so high: such a height is in another unit
        may_be_empty=True,
    )
    mark: str = option(
        "string",
        "",
        "A dimension to write: 1 for points inside `where`, else 0. Later stages can take it in "
        "their own `where`, which would see the new classes",
    )
    compact: bool = option(
        "boolean",
        False,
        "Round HeightAboveGround to 1/32 of Z's unit, Reliability, Margin and probabilities to "
        "1/64: compressed, they take a third of the bytes",
    )
    given_ground: bool = option(
        "boolean",
        False,
        "Points of the classes 2, 9 and 11 (ground, water, road) are the ground: they keep their "
        "class, and others become 2 only where Ground is 1, or without that dimension within "
        f"{_TOLERANCE_M} m of it (HeightAboveGround)",
    )
    memory_mb: float
    part: str = option(
        "string",
        "",
        "For tiles, which run the stage as two and set it themselves: first probabilities, then "
        "lines, which are found among the probabilities of all points around",
        choices=("", PROBABILITIES, LINES),
    )

    def check(self) -> None:
        """Refuse options that contradict each other."""
        self.costly = self.part != LINES
        self.limits  # noqa: B018  refused here where nothing is known of the model
        if self.mark and not re.fullmatch(r"[A-Za-z]\w*", self.mark):
            raise OptionError("option 'mark' must be a name of letters and digits", found=self.mark)
        taken = {
            name.lower() for name in (*LAS_DIMENSIONS, _HEIGHT, *(d.name for d in self._results))
        }
        if self.mark.lower() in taken:
            raise self._mark_exists(self.mark)
        codes = [code for code, _ in self.model.classes]
        if self.part and not self.model.lines.any():
            raise OptionError(
                "option 'part' is for models with classes of lines",
                found=f"{self.model_file}, which has none",
                cure="Leave it out",
            )
        if self.variance and not self.model.gives_variance:
            raise OptionError(
                "option 'variance' is for networks",
                found=f"{self.model_file}, a forest",
                cure="Use 'margin'",
            )
        heights = self.vegetation_heights
        if heights and not (len(heights) == 2 and 0 < heights[0] < heights[1]):
            raise OptionError(
                "option 'vegetation_heights' must be two heights in meters, the lower one first",
                found=", ".join(map(str, heights)),
                cure="For example 0.5,2",
            )
        if heights and (
            HIGH_VEGETATION not in codes or {LOW_VEGETATION, MEDIUM_VEGETATION} & set(codes)
        ):
            raise OptionError(
                "option 'vegetation_heights' is for models that know vegetation as one class, 5",
                found=f"classes {', '.join(map(str, codes))}",
                cure='Leave it out, or train with --classes that join vegetation: "3,4,5": 5',
            )

    @cached_property
    def model(self) -> Model:
        """Return the loaded model."""
        return loaded_model(self.model_file)

    @cached_property
    def limits(self) -> ReliabilityLimits | None:
        """Return the reliability from which on points keep their class, with `keep_sure`."""
        if self.keep_sure is None:
            return None
        return read_calibration(self.model.info, find(self.model_file)).limits(self.keep_sure)

    @property
    def preparation(self) -> list[StageJson]:
        """Return the preprocessing that the model file holds; empty where it holds none."""
        return self.model.info.get("preparation") or []

    @property
    def hint(self) -> str | None:
        """Return where the dimensions of the model come from, if its file tells."""
        if self.part == LINES:
            return "Leave out the option 'part', which is for tiles"
        if self.preparation:
            stages = as_json(self.preparation)
            return f"Put before this stage: {stages}; what these do not make must be in the input"
        by_hand = ", ".join(self.model.info.get("by_hand", ()))
        return by_hand and f"Put before this stage what stood there in training: {by_hand}"

    def check_upstream(self) -> str | None:
        """Return a warning about the stages upstream; None where they fit."""
        trained = [] if self.part == LINES else self.preparation
        fits = not trained or not self.upstream or same(self.upstream, trained)
        if fits or (self.given_ground and same(self.upstream, with_given_ground(trained))):
            return None
        return (
            f"{self.type}: the model was trained on other heights than this pipeline makes. "
            f"Trained on: {as_json(trained)}. Here: {as_json(self.upstream)}. "
            "Expect lower accuracy, or use the former"
        )

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        if self.part == LINES:
            names = [dimension.name for dimension in (*self._results, *_CANDIDATES)]
        else:
            names = [*self.model.required_dimensions]
        if self.vegetation_heights or self.given_ground:
            names.append(_HEIGHT)
        return list(dict.fromkeys(names))

    def _mark_exists(self, name: str) -> OptionError:
        """Return the error on a `mark` that is another dimension's name, whatever its case."""
        what = "option 'mark' must name a new dimension"
        return OptionError(what, found=name, cure="Take a name that no dimension has")

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        mark = Dimension(self.mark, "uint8_t", "1", "1 for points inside `where`, else 0")
        candidates = _CANDIDATES if self.part == PROBABILITIES else ()
        return [*self._results, *([mark] if self.mark else []), *candidates]

    @property
    def _results(self) -> list[Dimension]:
        """Return the dimensions that are written, without `mark`."""
        codes = [code for code, _ in self.model.classes] if self.probabilities else []
        return [
            *(CLASSIFICATION, RELIABILITY),
            *([MARGIN] if self.options["margin"] else []),
            *([VARIANCE] if self.variance else []),
            *map(probability, codes),
        ]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        reaches = {PROBABILITIES: self.model.reach_m, LINES: self.model.reach_of_lines_m}
        return reaches.get(self.part, self.model.halo_m)

    def parts(self) -> Sequence[JsonObject]:
        """Return how the options of the two stages differ that find probabilities, then lines."""
        if self.part or not self.model.lines.any():
            return ()
        return {"part": PROBABILITIES}, {"part": LINES, "where": None, "mark": None}

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        rejected = set() if self._rejected is None else {self._rejected}
        heights = {LOW_VEGETATION, MEDIUM_VEGETATION} if self.vegetation_heights else set()
        return {code for code, _ in self.model.classes} | rejected | heights

    @property
    def _rejected(self) -> int | None:
        """Return the class of rejected points; None where they keep theirs."""
        unsure = UNCLASSIFIED if self.keep_sure is not None else None
        return unsure if self.rejected_code is None else self.rejected_code

    def _prediction(self, observer: Observer | None) -> PredictionOptions:
        """Return the options of classifying a cloud."""
        names = [field.name for field in fields(PredictionOptions) if field.name != "observer"]
        values = {**{name: getattr(self, name) for name in names}, "rejected_code": self._rejected}
        return PredictionOptions(**values, observer=observer)

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Classify the points."""
        if self.part == LINES:
            return self._find_lines(points, context)
        same = [name for name in points.arrays if name.lower() == self.mark.lower()]
        if self.mark and (len(same) > 1 or any(points.arrays[name].any() for name in same)):
            raise self._mark_exists(", ".join(same))
        ignored, kept = points.ignored(self.ignore), points.chosen(self.keep)
        inside = points.inside
        current = points.class_codes
        is_terrain = np.isin(current, TERRAIN) if self.given_ground else np.zeros_like(kept)
        if context.observer is not None:
            alone = (~inside, ignored, is_terrain, kept)
            context.observer.see_kept(dict(zip(Kept, alone, strict=True)))
        kept = kept | is_terrain
        points.tally(self.ignored, inside & ignored)
        points.tally(self.kept, inside & kept & ~ignored)
        points.tally(self.outside_where, ~inside)
        wanted = inside & ~ignored & ~kept
        dimensions = {
            n: points.arrays[n] for n in self.model.optional_dimensions if n in points.arrays
        }
        dimensions |= {name: points.dimension(name) for name in self.model.required_dimensions}
        ground = self._may_be_ground(points) if self.given_ground else None
        slope, elevation, too_flat = 0.0, 0.0, False
        if _HEIGHT in points.arrays and points.count:
            slope = median_slope(points.xyz, points.dimension(_HEIGHT))
            elevation = float(np.median(points.xyz[:, 2]))
            if (returns := points.arrays.get("NumberOfReturns")) is not None:
                too_flat = is_too_flat(points.dimension(_HEIGHT), returns)
        points.keep_only([*dimensions, *self.creates(), _HEIGHT])
        with Progress(int(np.count_nonzero(wanted)), self.type) as progress:
            roles = PointRoles.check(points.count, wanted, ignored, current, ground)
            how = self._prediction(context.observer)
            prediction = self.model.classify(points.take_xyz(), dimensions, roles, how, progress)
        values: dict[str, NDArray] = {}
        locate: Locate | None = points.coordinates
        final = None
        if self.part == PROBABILITIES and (candidates := prediction.candidates) is not None:
            columns = candidates.probability, candidates.code, prediction.classification.copy()
            values = dict(zip((each.name for each in _CANDIDATES), columns, strict=True))
            prediction.classification[candidates.chosen] = current[candidates.chosen]
            locate, final = None, ~candidates.chosen
            wanted = wanted & final
        prediction = self.model.finish(prediction, wanted, how, locate, current)
        values |= self._settle(points, prediction, wanted, final, context.observer)
        if _HEIGHT in points.arrays:
            codes = prediction.classification
            leaves = wanted & np.isin(codes, (LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION))
            leaf_heights = points.dimension(_HEIGHT)[leaves]
            doubt = doubt_vertical_unit(
                leaf_heights, slope, points.units.vertical, elevation, too_flat
            )
            if doubt:
                points.report.warn(doubt)
        if self.mark:
            values[self.mark] = inside
        return values

    def _find_lines(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Decide between the classes of candidates, whose probabilities an earlier part gave."""
        current = points.class_codes
        share, code, other = (np.asarray(points.arrays[d.name]) for d in _CANDIDATES)
        candidates = LineCandidates(share, code)
        names = [name for name in (RELIABILITY.name, MARGIN.name) if name in self.creates()]
        columns = {name.lower(): np.array(points.arrays[name]) for name in names}
        if self.probabilities:
            shares = [points.arrays[probability(each).name] for each in self.model.codes.tolist()]
            columns["probabilities"] = np.column_stack(shares)
        prediction = Prediction(
            np.where(candidates.chosen, other, current),
            report=Report({"points": points.count}),
            candidates=candidates,
            **columns,
        )
        how = self._prediction(context.observer)
        wanted = candidates.chosen
        prediction = self.model.finish(prediction, wanted, how, points.coordinates, current)
        return self._settle(points, prediction, wanted, wanted, context.observer)

    def _settle(
        self,
        points: Points,
        prediction: Prediction,
        wanted: NDArray[np.bool_],
        final: NDArray[np.bool_] | None,
        observer: Observer | None,
    ) -> dict[str, NDArray]:
        """Return the dimensions of a finished prediction, of which points (n,) are `final`."""
        rejected = np.zeros(points.count, np.bool_)
        rejected[prediction.unsure] = True
        codes = prediction.classification
        if self.vegetation_heights:
            by_height(codes, wanted & ~rejected, points.dimension(_HEIGHT), self.vegetation_heights)
            if observer is not None:
                observer.see_classes(ClassStep.HEIGHTS, codes)
            prediction.report.figures["classes"] = class_counts(codes[wanted])
        values = self._columns(points, prediction, final)
        values["Classification"] = points.with_codes(codes)
        if self.reject_below is not None or self.limits is not None:
            points.tally(self.rejected, rejected)
        points.report.merge(prediction.report)
        return values

    def _columns(
        self, points: Points, prediction: Prediction, final: NDArray[np.bool_] | None
    ) -> dict[str, NDArray]:
        """Return all dimensions but the class; points outside `where` keep what they had.

        What a later part needs is not rounded: points (n,) that are not `final`.
        """
        values: dict[str, NDArray] = {"Reliability": prediction.reliability}
        more = {"Margin": prediction.margin, "Variance": prediction.variance}
        values |= {name: column for name, column in more.items() if column is not None}
        if prediction.probabilities is not None:
            columns = zip(self.model.codes, prediction.probabilities.T, strict=True)
            values |= {f"Probability_{code}": column for code, column in columns}
        if self.compact:
            steps = dict.fromkeys(values, _STEPS)
            if _HEIGHT in points.arrays:
                values[_HEIGHT] = points.arrays[_HEIGHT]
                steps[_HEIGHT] = _HEIGHT_STEPS
            for name, column in values.items():
                rounded = np.round(column * steps[name]) / steps[name]
                values[name] = rounded if final is None else np.where(final, rounded, column)
        if points.mask is not None:
            for name, column in values.items():
                values[name] = np.where(points.mask, column, points.arrays[name])
        return values

    def _may_be_ground(self, points: Points) -> NDArray[np.bool_]:
        """Return which points (n,) are near enough to the ground that is given."""
        if "Ground" in points.arrays:
            return np.asarray(points.arrays["Ground"]) > 0
        return np.abs(points.dimension(_HEIGHT)) <= _TOLERANCE_M
