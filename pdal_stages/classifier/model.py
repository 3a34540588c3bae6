"""A trained model: what it needs and knows, its file, and applying it to a cloud."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError, OptionError, suggest
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Message, Report, Topic
from ..base.progress import Progress
from ..features import FeaturePlan
from ..features.cell_means import density
from ..features.point_grid import check_xyz
from ..features.registry import ALGORITHM_VERSION
from ..features.voxels import check_side, represent
from . import model_description, model_file
from .auto_context import WeightedPass, classify, plan_of
from .feature_forest import FeatureEstimator
from .input_dimensions import list_values, optional_dimensions, required_dimensions
from .interface import (
    BatchEstimator,
    ClassStep,
    Estimator,
    InputPlan,
    PointEstimator,
    PredictRequest,
    classifier_of,
    preprocessing,
)
from .line_evidence import REACH, find_lines
from .model_info import ModelInfo
from .prediction import (
    LineCandidates,
    Locate,
    PointRoles,
    Prediction,
    PredictionOptions,
    WorkingCloud,
    count_classes,
    decide,
    empty_columns,
    move_from_ground,
    reject,
    set_lines_aside,
    settle_lines,
)

#: How many times sparser or denser than those trained on a cloud may be without a warning (not
#: tuned).
DENSITY_TOLERANCE = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A trained classifier. Make one with :func:`train` or :func:`load_model`."""

    #: the classifiers; each but the first reads the probabilities of the one before
    passes: tuple[Estimator, ...]
    classes: list[tuple[int, str]]  #: code and name, in the order of the columns of probabilities
    #: the rest of the manifest: how it was trained, scores, by pass its importances
    info: ModelInfo

    @property
    def algorithm(self) -> Estimator:
        """The last pass, whose probabilities are the model's."""
        return self.passes[-1]

    @cached_property
    def plan(self) -> FeaturePlan | InputPlan:
        """Features and dimensions that all passes read."""
        return plan_of(self.passes)

    @property
    def codes(self) -> npt.NDArray[np.uint8]:
        """ASPRS codes, in the order of the columns of probabilities."""
        return np.array([code for code, _ in self.classes], np.uint8)

    @property
    def codes_of(self) -> list[list[int]]:
        """Class codes of each pass: the model's own, but for the passes of a base."""
        codes = self.codes.tolist()
        return [list(entry.get("codes") or codes) for entry in self.info["passes"]]

    @property
    def factors(self) -> npt.NDArray[np.float64] | None:
        """Factors of the classes' probabilities by their frequency (``prior_weight``), or None."""
        priors = self.info.get("priors")
        return None if priors is None else np.array(priors["factors"])

    @property
    def weighted_passes(self) -> list[WeightedPass]:
        """The passes, each with the factors of its probabilities."""
        stored = [entry.get("factors") for entry in self.info["passes"][:-1]]
        factors = [*(None if each is None else np.array(each) for each in stored), self.factors]
        return list(map(WeightedPass, self.passes, self.codes_of, factors))

    @property
    def first_pass(self) -> Model:
        """A model of the first pass alone, with its classes as they are, and no lines."""
        names = dict(self.classes)
        classes = [(code, names.get(code, str(code))) for code in self.codes_of[0]]
        changed = {"passes": self.info["passes"][:1], "priors": None, "lines": []}
        return Model(self.passes[:1], classes, cast(ModelInfo, {**self.info, **changed}))

    @property
    def required_dimensions(self) -> tuple[str, ...]:
        """Dimensions that a cloud must have beside its coordinates."""
        return required_dimensions(self.plan.dimensions)

    @property
    def optional_dimensions(self) -> tuple[str, ...]:
        """Dimensions that are used where a cloud has them: return numbers."""
        return optional_dimensions(self.plan.dimensions)

    @property
    def preparation(self) -> list[StageJson]:
        """Stages that computed the training's dimensions; empty where none can be stored."""
        return self.info["preparation"]

    @property
    def voxel(self) -> float:
        """Side in meters of the voxels that one point each stands for; 0 for none."""
        return float(self.info["voxel"])

    @property
    def lines(self) -> npt.NDArray[np.bool_]:
        """(classes,) whose points must lie on a line, see :mod:`.line_evidence`."""
        return np.isin(self.codes, self.info.get("lines", ()))

    @property
    def halo_m(self) -> float:
        """Meters around a tile whose points the tile's results depend on."""
        return self.reach_m + self.reach_of_lines_m

    @property
    def reach_m(self) -> float:
        """Meters around a tile whose points the tile's probabilities depend on."""
        return self.plan.halo_m + self.voxel

    @property
    def reach_of_lines_m(self) -> float:
        """Meters around a tile whose probabilities decide what lies on a line there."""
        return REACH if self.lines.any() else 0.0

    @property
    def gives_variance(self) -> bool:
        """True for a network, which sees each point in several batches."""
        return isinstance(self.passes[0], PointEstimator)

    def batches(
        self, xyz: npt.NDArray[np.float64]
    ) -> Iterable[tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]]:
        """Return centers (2,) and rows (k,) of a network's batches of points (n, 3), in meters.

        Others have none.
        """
        return self.algorithm.batches(xyz) if isinstance(self.algorithm, BatchEstimator) else ()

    @property
    def algorithm_versions(self) -> dict[str, int]:
        """Versions in the present release of the algorithms that compute what the model reads."""
        features = {} if self.gives_variance else {"filters.multiscalefeatures": ALGORITHM_VERSION}
        return preprocessing().algorithm_versions(self.preparation) | features

    def record_preprocessing(self, preparation: Sequence[StageJson]) -> None:
        """Store the stages that computed the training's dimensions, and their versions."""
        self.info["preparation"] = [dict(stage) for stage in preparation]
        self.info["algorithms"] = self.algorithm_versions

    @property
    def outdated(self) -> list[str]:
        """Warnings about algorithms that have changed since the model was trained."""
        stored, warnings = self.info["algorithms"], []
        release = self.info["created_by"].get("pdal_stages", "unknown")
        for kind, version in self.algorithm_versions.items():
            if stored.get(kind) == version:
                continue
            warnings.append(
                f"the model was trained with version {stored.get(kind, 'unknown')} of {kind}, and "
                f"this release has version {version}, whose results differ: expect lower accuracy. "
                "Train the model again, or install the release that it was trained with "
                f"(pdal_stages {release})"
            )
        return warnings

    def importances(self, number: int = -1) -> dict[str, float]:
        """Return the mean decrease in impurity by input, summing to 1, largest first.

        `number` tells which of the `passes`. A network has no importances: ModelError.
        """
        entry = self.manifest()["passes"][number]
        if entry["importances"] is None:
            raise ModelError("the model file holds no importances")
        shares = zip(entry["feature_names"], entry["importances"], strict=True)
        return dict(sorted(shares, key=lambda item: -item[1]))

    def __repr__(self) -> str:
        """Return the kind and the codes in a line."""
        return f"<Model {self.algorithm.name} of classes {self.codes.tolist()}>"

    def __str__(self) -> str:
        """Return a page of text about the model."""
        return model_description.text(self)

    def manifest(self) -> JsonObject:
        """Return what the model file holds beside arrays, as plain data."""
        entries = zip(self.passes, self.codes_of, self.info["passes"], strict=True)
        passes = [
            {"algorithm": each.name, **each.to_file(codes), **scores}
            for each, codes, scores in entries
        ]
        return {**self.info, "passes": passes}

    def save(self, path: str | os.PathLike) -> None:
        """Write the model file: whole, or not at all."""
        model_file.write(path, self.manifest(), [each.arrays() for each in self.passes])

    def predict(
        self,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike] | None = None,
        where: npt.ArrayLike | None = None,
        *,
        current: npt.ArrayLike | None = None,
        ignore: npt.ArrayLike | None = None,
        may_be_ground: npt.ArrayLike | None = None,
        progress: Progress | None = None,
        **options: Any,
    ) -> Prediction:
        """Classify a cloud, block by block.

        Memory holds the cloud's index, the results and a few blocks, whatever the cloud's size.

        Parameters
        ----------
        xyz : (n, 3) float64
            Coordinates in meters.
        dimensions : mapping, optional
            Name to (n,) values, e.g. return numbers. Without any of the heights in
            ``required_dimensions``, these are computed as in training, where the model says how.
        where : (n,) bool, optional
            Points to classify. The others keep their class but still serve as neighbors.
        current : (n,) int, optional
            Class codes that points outside `where`, and rejected ones, keep; default 0 and 1.
        ignore : (n,) bool, optional
            Points, such as noise, that are neither classified nor neighbors.
        may_be_ground : (n,) bool, optional
            Points that may become class 2. Others for which it wins get the second class, with
            its probability as reliability and a margin of 0.
        progress : Progress, optional
            Is told the number of points done.
        **options
            See :class:`PredictionOptions`.
        """
        xyz = check_xyz(xyz)
        roles = PointRoles.check(len(xyz), where, ignore, current, may_be_ground)
        how = PredictionOptions(**options)
        prediction = self.classify(xyz, dict(dimensions or {}), roles, how, progress)
        return self.finish(prediction, roles.wanted, how, xyz.__getitem__, roles.current)

    def classify(
        self,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike],
        roles: PointRoles,
        how: PredictionOptions,
        progress: Progress | None = None,
    ) -> Prediction:
        """Return the classes of a cloud before :meth:`finish`; parameters are of :meth:`predict`.

        Coordinates (n, 3) that the caller does not hold are freed before most memory is taken.
        """
        if how.variance and not self.gives_variance:
            raise OptionError("only a network gives a variance", cure="Ask for the margin")
        xyz = check_xyz(xyz)
        dimensions = self._add_preprocessed(xyz, dimensions, roles, how.threads)
        columns = empty_columns(roles, len(self.classes), how, bool(self.lines.any()))
        values = list_values(self.plan.dimensions, dimensions, len(xyz), roles.usable)
        wanted_rows = roles.wanted_rows
        representatives = represent(xyz, self.voxel, values, wanted_rows, roles.usable)
        if representatives is not None:  # the coordinates of the others are not needed any more
            xyz = xyz[representatives.rows]
        names = (*self.required_dimensions, *self.optional_dimensions)
        read = {name: dimensions[name] for name in names if name in dimensions}
        cell = getattr(self.passes[0].plan, "cell", 1.0)
        work = WorkingCloud.sort(xyz, read, cell, representatives, wanted_rows)
        del xyz, values, representatives, wanted_rows
        request = PredictRequest(
            work.xyz,
            work.dimensions,
            work.wanted,
            how.threads,
            how.memory_mb,
            None if work.stands_for_others else progress,
            work.grid,
            how.device,
            work.observe(None if how.observer is None else how.observer.see_inputs),
        )
        self._classify(work, request, columns, progress)
        if how.observer is not None:
            how.observer.see_classes(ClassStep.LIKELIEST, columns["classification"])
        if roles.not_ground is not None:
            request.report.figures["too_far_for_ground"] = move_from_ground(columns, roles)
            if how.observer is not None:
                how.observer.see_classes(ClassStep.GIVEN_GROUND, columns["classification"])
        count = len(roles.wanted)
        if len(work.xyz) < count - roles.ignored:
            request.report.figures["representatives"] = len(work.xyz)
        unwanted = count - roles.ignored - int(np.count_nonzero(roles.wanted))
        ignored = {"ignored": roles.ignored} if roles.ignored else {}
        report = Report({"points": count, "outside_where": unwanted, **ignored})
        report.merge(request.report)
        candidates = None
        if "line_class" in columns:
            names = ("line_probability", "line_class")
            candidates = LineCandidates(*(columns.pop(name) for name in names))
        return Prediction(**columns, report=report, candidates=candidates)

    def finish(
        self,
        prediction: Prediction,
        wanted: npt.NDArray[np.bool_],
        how: PredictionOptions,
        locate: Locate | None,
        current: npt.NDArray[np.uint8] | None,
    ) -> Prediction:
        """Return a prediction in which lines are found and what is not reliable is rejected.

        Arrays of `prediction` are changed.

        Parameters
        ----------
        prediction : Prediction
        wanted : (n,) bool
            Points that are finished.
        how : PredictionOptions
        locate : callable or None
            Returns where points lie. None: lines are not looked for.
        current : (n,) uint8 or None
            Class codes that rejected points keep.
        """
        candidates = prediction.candidates
        if candidates is not None and locate is not None:
            rows = np.flatnonzero(candidates.chosen)
            shares = candidates.probability[rows]
            on_line = find_lines(locate(rows), shares, how.threads)
            settle_lines(prediction, rows[on_line], self.codes)
            if how.observer is not None:
                how.observer.see_lines(candidates.probability, candidates.code)
                how.observer.see_classes(ClassStep.LINES, prediction.classification)
        rejected = reject(prediction, wanted, current, how)
        report = Report(count_classes(prediction.classification, wanted, len(rejected)))
        report.merge(prediction.report)
        return replace(prediction, unsure=rejected, report=report)

    def _add_preprocessed(
        self,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike],
        roles: PointRoles,
        threads: int | None,
    ) -> Mapping[str, npt.ArrayLike]:
        """Return the dimensions (n,), and heights as computed in training where they miss.

        None is computed where some are there: heights of two kinds would be mixed.
        """
        if dimensions.keys() >= set(self.required_dimensions):
            return dimensions
        computed = preprocessing().made_of_coordinates(
            self.preparation, xyz, roles.usable, threads, roles.current
        )
        return dimensions if computed.keys() & dimensions.keys() else {**computed, **dimensions}

    def _classify(
        self,
        work: WorkingCloud,
        request: PredictRequest,
        columns: dict[str, npt.NDArray],
        progress: Progress | None,
    ) -> None:
        """Fill the columns (n, ...) of all points of the cloud, block by block.

        Warns where the cloud is not as dense as those that the model was trained on.
        """
        has_lines = bool(self.lines.any())
        for block in classify(self.weighted_passes, request):
            rows_in_cloud, rows_in_block = work.members(block.rows)
            new: dict[str, npt.NDArray] = {}
            if has_lines:
                block, new = set_lines_aside(block, self.lines, self.codes)
            new |= decide(block, self.codes, columns)
            for name, values in new.items():
                columns[name][rows_in_cloud] = values[rows_in_block]
            if progress is not None and work.stands_for_others:
                progress.update(len(rows_in_cloud))
        request.report.warnings += map(Message, self.outdated)
        if not request.count:
            return
        points_per_m2, trained = density(work.xyz), self.info["densities"]
        request.report.figures["density"] = round(points_per_m2, 3)
        low, high = trained["low"] / DENSITY_TOLERANCE, trained["high"] * DENSITY_TOLERANCE
        if not low <= points_per_m2 <= high:
            request.report.warn(
                f"the cloud has {points_per_m2:.3g} points/m2, the model was trained on "
                f"{model_description.range_text(trained)}. Expect lower accuracy, or train with "
                "'thin'",
                Topic.OTHER_DENSITY,
            )


def load_model(path: str | os.PathLike) -> Model:
    """Read a model file, or a shipped model by its name. Nothing in it is executed.

    The stages that it wants before it (``info["preparation"]``) are of a short list, with options
    in bounds.

    Raises
    ------
    ModelError
        The file is missing, damaged, of a newer version, contradicts itself, or asks for what no
        model may ask for.
    """
    name = os.fspath(path)
    file = model_file.find(name)
    try:
        model = assemble(*model_file.read(file, lambda kind: classifier_of(kind).rules))
        if model.preparation:
            model.info["preparation"] = preprocessing().check(model.preparation)
        return model
    except ModelError as error:
        others = [shipped for shipped in model_file.shipped() if shipped != name]
        near = "" if os.path.lexists(name) else suggest(name, others)
        error.cure = f"{near}{error.cure or model_file.CURE}"
        raise error.at(file) from error.__cause__
    except OptionError as error:  # a feature of another release, say
        raise ModelError(
            "this release lacks what the model needs", where=file, found=error
        ) from error


def loaded_model(path: str) -> Model:
    """Return a model that this process has loaded before, or load it; also a changed file."""
    path = model_file.find(path)
    try:
        stat = os.stat(path)
    except (OSError, ValueError):  # the latter for a name that holds a null
        return load_model(path)  # raises
    return _loaded(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _loaded(path: str, *stamp: int) -> Model:
    return load_model(path)


def assemble(manifest: JsonObject, arrays: model_file.Arrays) -> Model:
    """Return the model of a manifest and arrays; ModelError where they contradict each other."""
    classes = [(entry["code"], entry["name"]) for entry in manifest["classes"]]
    codes = [code for code, _ in classes]
    check_side(manifest["voxel"])
    passes: list[Estimator] = []
    before: list[int] = []
    for number, (entry, of_pass) in enumerate(zip(manifest["passes"], arrays, strict=True)):
        here, codes_here = f"pass {number + 1}", entry.get("codes") or codes
        if sorted(set(codes_here)) != codes_here:
            raise ModelError("a model's classes must ascend, each once", found=codes_here[:10])
        lengths = {"factors": len(codes_here), "importances": len(entry["feature_names"])}
        for key, length in lengths.items():
            if entry.get(key) is not None and len(entry[key]) != length:
                raise ModelError(f"{here} must have {length} {key}", found=len(entry[key]))
        if bool(number) != bool(entry["context"]) or (
            number and isinstance(passes[0], PointEstimator)
        ):
            raise ModelError(
                "the first pass reads no context, each later one does, and none follows a network",
                found=here,
            )
        classifier = classifier_of(entry["algorithm"]).from_file(entry, of_pass, codes_here)
        reads = (
            classifier.classes_before(codes_here)
            if isinstance(classifier, FeatureEstimator)
            else []
        )
        if number and reads != before:
            raise ModelError("a pass reads other classes than the one before gives", found=here)
        passes.append(classifier)
        before = codes_here
    if before != codes:
        raise ModelError("the last pass has other classes than the model", found=before[:10])
    priors = manifest.get("priors")
    if priors is not None and len(priors["factors"]) != len(codes):
        raise ModelError("priors need a factor for each class", found=len(priors["factors"]))
    if unknown := set(manifest.get("lines", ())) - set(codes):
        raise ModelError("the model has no such class, which it calls lines", found=min(unknown))
    info = {k: value for k, value in manifest.items() if k not in ("format", "version", "arrays")}
    scores = ("importances", "percentiles", "codes", "factors")
    info["passes"] = [
        {key: entry[key] for key in scores if key in entry} for entry in manifest["passes"]
    ]
    return Model(tuple(passes), classes, cast(ModelInfo, info))
