"""A trained model: what it needs, what it knows, its file, and applying it to a cloud."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.report import Report
from ..features import FeaturePlan
from ..features.cell_means import density
from ..features.point_grid import check_xyz
from ..features.registry import ALGORITHM_VERSION
from ..features.voxels import represent
from . import model_description, model_file
from .auto_context import WeightedPass, classify, plan_of
from .input_dimensions import list_values, optional_dimensions, required_dimensions
from .interface import InputPlan, PredictRequest
from .prediction import (
    PointRoles,
    Prediction,
    PredictionOptions,
    WorkingCloud,
    count_classes,
    decide,
    empty_columns,
    move_from_ground,
    reject,
)
from .registry import preprocessing

#: How many times sparser or denser a cloud may be than those trained on before that is said.
TOLERANCE = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A trained classifier. Make one with :func:`train` or :func:`load_model`."""

    #: the classifiers, e.g. a :class:`FeatureForest`; each but the first reads what the one before said
    passes: tuple[Any, ...]
    classes: list[tuple[int, str]]  #: code and name, in the order of the columns of probabilities
    #: the rest of the manifest: how it was trained, scores; ``info["passes"]`` has the importances of each pass
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def algorithm(self) -> Any:
        """The last pass, whose answer is the model's."""
        return self.passes[-1]

    @cached_property
    def plan(self) -> FeaturePlan | InputPlan:
        """Features and dimensions it needs."""
        return plan_of(self.passes)

    @property
    def codes(self) -> npt.NDArray[np.uint8]:
        """ASPRS codes, in the order of the columns of probabilities."""
        return np.array([code for code, _ in self.classes], np.uint8)

    @property
    def codes_of(self) -> list[list[int]]:
        """The classes of each pass: the model's own, but for passes of a base, which have theirs."""
        own = self.codes.tolist()
        return [list(one.get("codes") or own) for one in self.info["passes"]]

    @property
    def factors(self) -> npt.NDArray[np.float64] | None:
        """What each class's probability is multiplied by for being frequent (``prior_weight``), or None."""
        priors = self.info.get("priors")
        return None if priors is None else np.array(priors["factors"])

    @property
    def weighted_passes(self) -> list[WeightedPass]:
        """Its passes, each with what its probabilities are weighted by."""
        given = [one.get("factors") for one in self.info["passes"][:-1]]
        factors = [*(None if one is None else np.array(one) for one in given), self.factors]
        return list(map(WeightedPass, self.passes, self.codes_of, factors))

    @property
    def required_dimensions(self) -> tuple[str, ...]:
        """Dimensions a cloud must have beside its coordinates."""
        return required_dimensions(self.plan.dimensions)

    @property
    def optional_dimensions(self) -> tuple[str, ...]:
        """Dimensions it uses where a cloud has them: return numbers."""
        return optional_dimensions(self.plan.dimensions)

    @property
    def voxel(self) -> float:
        """Side in meters of voxels that one point represents; 0: each point stands for itself."""
        return float(self.info.get("voxel") or 0.0)

    @property
    def halo_m(self) -> float:
        """Meters around a tile whose points a tile's results depend on."""
        return self.plan.halo_m + self.voxel

    @property
    def algorithm_versions(self) -> dict[str, int]:
        """Stages that compute what the model reads -> version of their algorithm in this release."""
        computed = any(one.features is not None for one in self.passes)
        features = {"filters.multiscalefeatures": ALGORITHM_VERSION} if computed else {}
        preparation = self.info.get("preparation") or []
        return preprocessing().algorithm_versions(preparation) | features

    def record_preprocessing(self, preparation: Sequence[Mapping[str, Any]]) -> None:
        """Store the stages that made the training's dimensions, and the versions of the algorithms in this release."""
        self.info["preparation"] = [dict(stage) for stage in preparation]
        self.info["algorithms"] = self.algorithm_versions

    @property
    def outdated(self) -> list[str]:
        """Warnings: algorithms of this release that differ from those the model was trained with."""
        stored, told = self.info.get("algorithms", {}), []
        for kind, version in self.algorithm_versions.items():
            if (then := stored.get(kind)) != version:
                what, may = (
                    ("an unknown version", "may ") if then is None else (f"version {then}", "")
                )
                told.append(
                    f"the model was trained with {what} of {kind}, and this release has version {version}, whose "
                    f"results {may}differ: expect lower accuracy. Train the model again, or install the release that it was "
                    f"trained with (pdal_stages {self.info['created_by'].get('pdal_stages', 'unknown')})"
                )
        return told

    def importances(self, by: str = "feature", number: int = -1) -> dict[str, float]:
        """Mean decrease in impurity, summing to 1, largest first.

        `by` column, feature (over all neighborhoods, a histogram's bins together), group (covariance, geometry, shape
        features and context), neighborhood, or dimension (of the points, against all others); `number` is the pass's
        place in ``passes``.
        """
        values = self.info["passes"][number]["importances"]
        return model_description.importances(
            values, self.passes[number].columns(self.codes_of[number]), by
        )

    def describe(self) -> dict[str, Any]:
        """Everything about the model as plain data; ``str(model)`` is the same as text."""
        more = {
            "required_dimensions": list(self.required_dimensions),
            "optional_dimensions": list(self.optional_dimensions),
            "halo_m": self.halo_m,
            "outdated": self.outdated,
        }
        return model_description.describe(
            {**self.manifest(), **more},
            [one.columns(codes) for one, codes in zip(self.passes, self.codes_of, strict=True)],
        )

    def __repr__(self) -> str:
        return f"<Model {self.algorithm.name} of classes {self.codes.tolist()}>"

    def __str__(self) -> str:
        return model_description.text(self.describe())

    def manifest(self) -> dict[str, Any]:
        """What the model file says beside its arrays."""
        passes = [
            {"algorithm": one.name, **one.to_file(codes), **scores}
            for one, codes, scores in zip(
                self.passes, self.codes_of, self.info["passes"], strict=True
            )
        ]
        return {**self.info, "passes": passes}

    def save(self, path: str | os.PathLike) -> None:
        """Write the model file: whole, or not at all."""
        model_file.write(path, self.manifest(), [one.arrays() for one in self.passes])

    def predict(
        self,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike] | None = None,
        where: npt.ArrayLike | None = None,
        *,
        current: npt.ArrayLike | None = None,
        ignore: npt.ArrayLike | None = None,
        may_be_ground: npt.ArrayLike | None = None,
        progress: Any = None,
        **options: Any,
    ) -> Prediction:
        """Classify a cloud, block by block.

        Memory holds the cloud's index, the results and a few blocks of features, whatever the cloud's size.

        Parameters
        ----------
        xyz : (n, 3) float64
            Coordinates in meters.
        dimensions : mapping, optional
            Name to (n,) values, e.g. return numbers. Without any of the heights in ``required_dimensions``, these are
            made as in training, where the model says how.
        where : (n,) bool, optional
            Points to classify. The others keep their class but still serve as neighbors.
        current : (n,) int, optional
            Classes the points have now: what points outside `where`, and rejected ones, keep. Without it
            the former get 0 (never classified) and the latter 1 (unclassified).
        ignore : (n,) bool, optional
            Points that are not there for the model: not classified, and not even neighbors. For noise.
        may_be_ground : (n,) bool, optional
            Points that may become class 2. Others for which it wins get the second class, with its probability as
            reliability and a margin of 0.
        progress : object, optional
            Its ``update`` is called with the points done.
        **options
            See :class:`PredictionOptions`.
        """
        how = PredictionOptions(**options)
        if how.variance and not self.gives_variance:
            raise OptionError(
                "only a network gives a variance over batches",
                found=", ".join(one.name for one in self.passes),
                cure="Ask for the margin, which every model gives",
            )
        xyz = check_xyz(xyz)
        roles = PointRoles.check(len(xyz), where, ignore, current, may_be_ground)
        given = self._add_preprocessed(xyz, dict(dimensions or {}), roles, how.threads)
        columns = empty_columns(roles, len(self.codes), how)
        values = list_values(self.plan.dimensions, given, len(xyz), roles.present)
        representatives = represent(xyz, self.voxel, values, roles.wanted_rows, roles.present)
        del values
        if representatives is not None:  # the coordinates of the others are not needed any more
            xyz = xyz[representatives.rows]
        work = WorkingCloud.sort(xyz, self._cell, representatives, roles.wanted_rows)
        del xyz
        request = PredictRequest(
            work.xyz,
            work.take((*self.required_dimensions, *self.optional_dimensions), given),
            work.wanted,
            how.threads,
            how.memory_mb,
            progress if representatives is None else None,
            work.grid,
            how.variance,
            how.device,
        )
        del given
        # Here and not later: search structures take more memory than is free beside them.
        measure = self.info.get("densities") is not None and request.count
        points_per_m2 = density(work.xyz) if measure else None
        for block in classify(self.weighted_passes, request):
            rows_in_cloud, rows_in_block = work.members(block.rows)
            for name, values_of_block in decide(block, self.codes, columns).items():
                columns[name][rows_in_cloud] = values_of_block[rows_in_block]
            if progress is not None and representatives is not None:
                progress.update(len(rows_in_cloud))
        if roles.not_ground is not None:
            request.report.figures["too_far_for_ground"] = move_from_ground(columns, roles)
        if points_per_m2 is not None:
            self._report_density(request.report, points_per_m2, request.count)
        request.report.warnings.extend(self.outdated)
        if len(work.xyz) < len(roles.wanted) - roles.ignored:
            request.report.figures["representatives"] = len(work.xyz)
        rejected = reject(columns, roles, how)
        report = Report(count_classes(columns["classification"], roles, len(rejected)))
        report.merge(request.report)
        return Prediction(**columns, unsure=rejected, report=report)

    @property
    def gives_variance(self) -> bool:
        """Whether the model is a network alone, which sees each point in several batches."""
        return len(self.passes) == 1 and self.passes[0].features is None

    def _add_preprocessed(
        self,
        xyz: npt.NDArray[np.float64],
        given: dict[str, npt.ArrayLike],
        roles: PointRoles,
        threads: int | None,
    ) -> dict[str, npt.ArrayLike]:
        """Return the dimensions (n,), with heights computed as in training where they are missing and the model says how."""
        missing = [name for name in self.required_dimensions if name not in given]
        stages = self.info.get("preparation") or []
        if not missing:
            return given
        usable = None
        if roles.present is not None:
            usable = np.zeros(len(xyz), np.bool_)
            usable[roles.present] = True
        computed = preprocessing().made_of_coordinates(stages, xyz, usable, threads, roles.current)
        both = sorted(computed.keys() & given.keys())
        if both and computed.keys() & set(missing):  # heights of two kinds would be mixed
            raise DimensionError(
                f"the dimension {missing[0]} is missing",
                found=", ".join(given),
                cure=f"Leave out {', '.join(both)}: all are then made as in training, by {json.dumps(stages[0])}",
            )
        return {**computed, **given}

    @property
    def _cell(self) -> float | None:
        """Of the grid that its features are computed by; None where it has none."""
        return next(
            (one.features.plan.cell for one in self.passes if one.features is not None), None
        )

    def _report_density(self, report: Report, points_per_m2: float, count: int) -> None:
        """Report the density of a cloud, and warn where it is not what the model was trained for."""
        trained = self.info["densities"]
        report.figures["density"] = round(points_per_m2, 3)
        if trained["low"] / TOLERANCE <= points_per_m2 <= trained["high"] * TOLERANCE:
            return
        few = max(report.figures.get("fewer_than_three", {}).values(), default=0)
        lonely = f"; {100 * few / count:.3g} % have fewer than three neighbors" if few else ""
        report.warnings.append(
            f"the cloud has {points_per_m2:.3g} points/m2, the model was trained on "
            f"{model_description.range_text(trained)}{lonely}. Expect lower accuracy, or train with 'thin'"
        )
