"""A trained model: what it needs, what it knows, its file, and applying it to a cloud."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.asprs import GROUND
from ..base.errors import DimensionError, ModelError, OptionError, suggest
from ..base.report import Report
from ..features import FeaturePlan
from ..features.cell_means import density
from ..features.point_grid import build_grid, check_xyz
from ..features.registry import ALGORITHM_VERSION
from ..features.voxels import check_side, represent
from . import model_description, model_file
from .auto_context import WeightedPass, plan_of, predict
from .feature_forest import weighed
from .input_dimensions import list_values, optional_dimensions, required_dimensions
from .interface import InputPlan, Prediction, PredictionOptions, PredictRequest
from .registry import classifier_of, preprocessing

#: The class of a rejected point where its old class is not known: ASPRS "Unclassified".
UNCLASSIFIED = 1
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
        return list(map(WeightedPass, self.passes, map(len, self.codes_of), factors))

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
        n = len(xyz)
        given = self._prepared(xyz, dict(dimensions or {}), ignore, how.threads, current)
        asked = (
            np.ones(n, np.bool_)
            if where is None
            else _checked("where", where, n, "b", "true or false")
        )
        there, ignored = None, 0
        if (
            ignore is not None
            and (gone := _checked("ignore", ignore, n, "b", "true or false")).any()
        ):
            there, ignored = np.flatnonzero(~gone), int(np.count_nonzero(gone))
            asked = asked & ~gone
        rows = None if asked.all() else np.flatnonzero(asked)
        codes, factors = self.codes, self.factors
        now = (
            None
            if current is None
            else _checked("current", current, n, "iu", "class code").astype(np.uint8)
        )
        out: dict[str, npt.NDArray[Any]] = {
            "classification": np.zeros(n, np.uint8) if now is None else now.copy(),
            "reliability": np.zeros(n, np.float32),
            **{
                name: np.zeros(n, np.float32)
                for name in ("margin", "variance")
                if getattr(how, name)
            },
            **(
                {"probabilities": np.zeros((n, len(codes)), np.float32)}
                if how.probabilities
                else {}
            ),
        }
        second, may = may_be_ground is not None, asked
        if may_be_ground is not None:
            may = _checked("may_be_ground", may_be_ground, n, "b", "true or false")
            out["second"], out["second_share"] = np.zeros(n, np.uint8), np.zeros(n, np.float32)
        values = list_values(self.plan.dimensions, given, n, there)
        representatives = represent(xyz, self.voxel, values, rows, there)
        del values, there
        taken: npt.NDArray[Any] | None = None
        if representatives is not None:  # from here on nobody looks at the others
            rows, taken = representatives.wanted, representatives.rows
            xyz = xyz[taken]
            representatives = replace(representatives, rows=taken[:0])
        order, grid = None, None
        if self._cell is not None and len(xyz):
            # one copy of the coordinates, in the order in which all is computed
            grid = build_grid(xyz, self._cell)
            order, xyz = grid.order, grid.coordinates
            grid = replace(grid, order=np.arange(len(order), dtype=order.dtype))
            if rows is not None:
                rows = np.flatnonzero(np.isin(order, rows))
            taken = order if taken is None else taken[order]
        if taken is not None:
            needed = (*self.required_dimensions, *self.optional_dimensions)
            given = {name: np.asarray(given[name])[taken] for name in needed if name in given}
        shown = progress if representatives is None else None
        request = PredictRequest(
            xyz, given, rows, how.threads, how.memory_mb, shown, grid, how.variance, how.device
        )
        # Before the search structures are there, with which it would be the most that is held.
        found = density(xyz) if self.info.get("densities") is not None and request.count else 0.0
        for at, decided in predict(
            self.weighted_passes, request, lambda p: decide(weighed(p, factors), codes, how, second)
        ):
            place: Any = slice(None)
            if order is not None:
                at = order[at]
            if representatives is not None:
                at, place = representatives.members(at)
                if progress is not None:
                    progress.update(len(at))
            for name, values in decided.items():
                out[name][at] = values[place]
        if second:
            moved = _move_from_ground(out, asked & ~may)
            request.report.figures["too_far_for_ground"] = moved
        self._report_density(request.report, found, request.count)
        request.report.warnings.extend(self.outdated)
        if len(xyz) < n - ignored:
            request.report.figures["representatives"] = len(xyz)
        unsure = _reject(out, asked, now, how)
        count = int(np.count_nonzero(asked))
        number = np.bincount(out["classification"][asked], minlength=256)
        report = Report(
            {
                "points": n,
                "classified": count - len(unsure),
                "rejected": len(unsure),
                "outside_where": n - ignored - count,
                **({"ignored": ignored} if ignored else {}),
                "classes": {
                    str(code): int(number[code]) for code in np.flatnonzero(number).tolist()
                },
            }
        )
        report.merge(request.report)
        return Prediction(**out, unsure=unsure, report=report)

    @property
    def gives_variance(self) -> bool:
        """Whether the model is a network alone, which sees each point in several batches."""
        return len(self.passes) == 1 and self.passes[0].features is None

    def _prepared(
        self,
        xyz: npt.NDArray[np.float64],
        given: dict[str, npt.ArrayLike],
        ignore: npt.ArrayLike | None,
        threads: int | None,
        current: npt.ArrayLike | None = None,
    ) -> dict[str, npt.ArrayLike]:
        """The dimensions, with heights made as in training where they are missing and the model says how."""
        missing = [name for name in self.required_dimensions if name not in given]
        preparation = self.info.get("preparation") or []
        if not missing:
            return given
        usable = None if ignore is None else ~np.asarray(ignore, bool)
        classes = None if current is None else np.asarray(current).astype(np.uint8)
        made = preprocessing().made_of_coordinates(preparation, xyz, usable, threads, classes)
        if made.keys() & given.keys() and made.keys() & set(
            missing
        ):  # heights of two kinds would be mixed
            raise DimensionError(
                f"the dimension {missing[0]} is missing",
                found=", ".join(given),
                cure=f"Leave out {', '.join(sorted(made.keys() & given.keys()))}: all are then made as in training, by "
                f"{json.dumps(preparation[0])}",
            )
        return {**made, **given}

    @property
    def _cell(self) -> float | None:
        """Of the grid that its features are computed by; None where it has none."""
        return next(
            (one.features.plan.cell for one in self.passes if one.features is not None), None
        )

    def _report_density(self, report: Report, found: float, count: int) -> None:
        """How dense the cloud is; a warning where that is not what the model was trained for."""
        trained = self.info.get("densities")
        if trained is None or not count:
            return
        report.figures["density"] = round(found, 3)
        if not trained["low"] / TOLERANCE <= found <= trained["high"] * TOLERANCE:
            few = max(report.figures.get("fewer_than_three", {}).values(), default=0)
            lonely = f"; {100 * few / count:.3g} % have fewer than three neighbors" if few else ""
            report.warnings.append(
                f"the cloud has {found:.3g} points/m2, the model was trained on "
                f"{model_description.range_text(trained)}{lonely}. Expect lower accuracy, or train with 'thin'"
            )


def decide(
    p: npt.NDArray[np.floating],
    codes: npt.NDArray[np.uint8],
    options: PredictionOptions,
    second: bool = False,
) -> dict[str, npt.NDArray[Any]]:
    """Return the winner of each row of probabilities (n, classes), of equal ones the first class, and what is wanted.

    With `second`, also the class that would win without it, and its probability.
    """
    best = p.argmax(axis=1)
    win = np.take_along_axis(p, best[:, None], axis=1)[:, 0]
    out = {"classification": codes[best], "reliability": win}
    if options.margin:
        out["margin"] = win - np.partition(p, -2, axis=1)[:, -2] if p.shape[1] > 1 else win
    if second:
        others = p.copy()
        np.put_along_axis(others, best[:, None], -1.0, axis=1)
        next_best = others.argmax(axis=1)
        out["second"] = codes[next_best]
        out["second_share"] = np.take_along_axis(p, next_best[:, None], axis=1)[:, 0]
    return {**out, "probabilities": p} if options.probabilities else out


def _move_from_ground(out: dict[str, npt.NDArray[Any]], forbidden: npt.NDArray[np.bool_]) -> int:
    """Give points (n,) that must not be ground, but are, their second class; returns how many there were."""
    second, share = out.pop("second"), out.pop("second_share")
    rows = np.flatnonzero(forbidden & (out["classification"] == GROUND))
    out["classification"][rows], out["reliability"][rows] = second[rows], share[rows]
    if "margin" in out:
        out["margin"][rows] = 0.0
    return len(rows)


def _reject(
    out: dict[str, npt.NDArray[Any]],
    asked: npt.NDArray[np.bool_],
    current: npt.NDArray[np.uint8] | None,
    options: PredictionOptions,
) -> npt.NDArray[np.int64]:
    """The points that were `asked` for (n,) and are not reliable enough; they do not get the winning class."""
    code = out["classification"]
    least = np.full(256, options.reject_below or 0.0, np.float32)
    for one, limit in (options.limits or {}).items():
        least[one] = max(least[one], limit)
    if not least.any():
        return np.zeros(0, np.int64)
    low = np.flatnonzero(asked & (out["reliability"] < least[code]))
    kept = UNCLASSIFIED if current is None else current[low]
    code[low] = kept if options.rejected_code is None else options.rejected_code
    return low


def load_model(path: str | os.PathLike) -> Model:
    """Read a model file, or a shipped model by its name. Nothing in it is executed or believed unchecked.

    The stages that it wants before it (``info["preparation"]``) are of a short list, with options in bounds.

    Raises
    ------
    ModelError
        The file is missing, damaged, of a newer version, not what it says, or asks for what no model may ask for.
    """
    name = os.fspath(path)
    file = model_file.find(name)
    try:
        model = assemble(*model_file.read(file, lambda name: classifier_of(name).rules))
        if asked := model.info.get("preparation"):
            model.info["preparation"] = preprocessing().check(asked)
        return model
    except ModelError as error:
        others = [one for one in model_file.shipped() if one != name]
        near = "" if os.path.lexists(name) else suggest(name, others)
        error.cure = f"{near}{error.cure or model_file.CURE}"
        raise error.at(file) from error.__cause__
    except OptionError as error:  # a feature of another release, say
        raise ModelError(
            "the model needs what this release does not have", where=file, found=error
        ) from error


def loaded_model(path: str) -> Model:
    """The same, read once per process as long as the file stays the same."""
    path = model_file.find(path)
    try:
        stat = os.stat(path)
    except (OSError, ValueError):  # the latter for a name that holds a null
        return load_model(path)  # says what is wrong
    return _loaded(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _loaded(path: str, *stamp: int) -> Model:
    return load_model(path)


def assemble(manifest: dict[str, Any], arrays: model_file.Arrays) -> Model:
    """The model that a file's manifest and arrays describe; what they say is checked against each other."""
    classes = [(entry["code"], entry["name"]) for entry in manifest["classes"]]
    codes = [code for code, _ in classes]
    if sorted(set(codes)) != codes:
        raise ModelError("the model's classes must be ascending, each once", found=codes[:10])
    check_side(manifest.get("voxel") or 0.0)
    priors = manifest.get("priors")
    if priors is not None and len(priors["factors"]) != len(classes):
        raise ModelError(
            "the manifest's priors must have one factor per class", found=len(priors["factors"])
        )
    passes, before = [], codes
    for number, entry in enumerate(manifest["passes"]):
        own = entry.get("codes") or codes
        if sorted(set(own)) != own or len(entry.get("factors") or own) != len(own):
            raise ModelError(
                "a pass's classes must ascend, each once, with one factor each", found=own[:10]
            )
        if (number > 0) != bool(entry["context"]):
            raise ModelError(
                "every pass but the first must read context", found=f"pass {number + 1}"
            )
        made: Any = classifier_of(entry["algorithm"]).from_file(entry, arrays[number], own)
        if number and made.classes_before(own) != before:
            raise ModelError(
                "a pass reads other classes than the one before gives", found=f"pass {number + 1}"
            )
        before = own
        importances = entry["importances"]
        if importances is not None and len(importances) != len(entry["feature_names"]):
            raise ModelError(
                "the manifest's importances must have one value per feature", found=len(importances)
            )
        passes.append(made)
    info = {
        key: value for key, value in manifest.items() if key not in ("format", "version", "arrays")
    }
    scores = ("importances", "codes", "factors")
    info["passes"] = [
        {key: entry[key] for key in scores if key in entry} for entry in manifest["passes"]
    ]
    if before != codes:
        raise ModelError("the last pass has other classes than the model", found=before[:10])
    return Model(tuple(passes), classes, info)


def _checked(name: str, given: npt.ArrayLike, n: int, kinds: str, what: str) -> npt.NDArray[Any]:
    """An array of n points of some NumPy kinds, or an OptionError."""
    array = np.asarray(given)
    if array.shape != (n,) or array.dtype.kind not in kinds:
        raise OptionError(
            f"'{name}' must be one {what} per point", found=f"{array.dtype} of shape {array.shape}"
        )
    if n and kinds != "b" and (array.min() < 0 or array.max() > 255):
        raise OptionError(
            f"'{name}' must be one {what} per point", found=f"{array.min()} to {array.max()}"
        )
    return array
