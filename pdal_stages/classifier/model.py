"""A trained model: what it needs, what it knows, and applying it to a cloud block by block."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError, OptionError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from . import modelfile, smoothing, summary
from .algorithms import algorithm
from .dimensions import gather, required

# What a Model keeps in attributes of its own.
_OWN = {"format", "version", "algorithm", "parameters", "features", "feature_names", "dimensions", "arrays"}
_OWN |= {"shape_bins", "copt_threshold", "feature_seed"}

#: The class of a rejected point where its old class is not known: ASPRS "Unclassified".
UNCLASSIFIED = 1


@dataclass(frozen=True, eq=False)
class Prediction:
    """Classes given to a cloud's points, in its order.

    Attributes
    ----------
    classification : (n,) uint8
        ASPRS codes.
    reliability : (n,) float32
        Probability of the winning class, 0 to 1; 0 for points that were not classified (outside `where`).
    margin : (n,) float32 or None
        Winning minus second probability; 0 outside `where`.
    probabilities : (n, classes) float32 or None
        In the order of ``Model.classes``; 0 outside `where`.
    variance : (n,) float32 or None
        Variance of a class's probability over a network's batches, mean over the classes; 0 outside `where`.
    classified, rejected : int
        Points looked at, and those of them whose reliability was below `reject_below`.
    report : dict
        Counts for the metadata.
    """

    classification: npt.NDArray[np.uint8]
    reliability: npt.NDArray[np.float32]
    margin: npt.NDArray[np.float32] | None
    probabilities: npt.NDArray[np.float32] | None
    classified: int
    rejected: int
    report: dict[str, Any]
    variance: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A trained classifier. Make one with :func:`train` or :func:`load_model`.

    Attributes
    ----------
    plan : FeaturePlan or InputPlan
        Features and dimensions it needs.
    algorithm : object
        The classifier itself, e.g. a :class:`Forest`.
    classes : list of (code, name)
        In the order of the columns of probabilities.
    bins : ShapeBins or None
        Thresholds of the shape distributions' histograms.
    copt_threshold : float or None
        Curvature threshold of ``copt``.
    feature_seed : int
    info : dict
        The rest of the manifest: how it was trained, scores, percentiles, importances.
    seconds : dict
        What training took, by part; not stored.
    """

    plan: Any
    algorithm: Any
    classes: list[tuple[int, str]]
    bins: ShapeBins | None
    copt_threshold: float | None
    feature_seed: int
    info: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    # ---- what it is ----------------------------------------------------------------------------------------

    @property
    def codes(self) -> npt.NDArray[np.uint8]:
        """ASPRS codes, in the order of the columns of probabilities."""
        return np.array([code for code, _ in self.classes], np.uint8)

    @property
    def factors(self) -> npt.NDArray[np.float64] | None:
        """What each class's probability is multiplied by for being frequent (``prior_weight``), or None."""
        priors = self.info.get("priors")
        return None if priors is None else np.array(priors["factors"])

    def _weigh(self, p: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        factors = self.factors
        if factors is None:
            return p
        p = p * factors
        p /= p.sum(axis=1, keepdims=True)
        return p

    @property
    def required_dimensions(self) -> tuple[str, ...]:
        """Dimensions a cloud must have beside its coordinates."""
        return required(self.plan.dimensions)

    @property
    def halo(self) -> float:
        """Metres around a tile whose points a tile's results depend on."""
        return self.plan.halo

    def importances(self, by: str = "feature") -> dict[str, float]:
        """Mean decrease in impurity, summing to 1, largest first.

        Parameters
        ----------
        by : {"column", "feature", "group", "neighborhood", "dimension"}
            Every column; each feature over all neighborhoods (a histogram's bins together); covariance,
            geometry and shape features; each neighborhood; or the points' own dimensions against all others.
        """
        return summary.importances(self, by)

    def describe(self) -> dict[str, Any]:
        """Everything about the model as plain data; ``str(model)`` is the same as text."""
        return summary.describe(self)

    def __repr__(self) -> str:
        return f"<Model {self.algorithm.name} of classes {[code for code, _ in self.classes]}>"

    def __str__(self) -> str:
        return summary.text(self)

    # ---- file ----------------------------------------------------------------------------------------------

    def manifest(self) -> dict[str, Any]:
        """What the model file says beside its arrays."""
        return {
            **self.info,
            "algorithm": self.algorithm.name,
            "parameters": self.algorithm.parameters(),
            "features": self.plan.to_dict(),
            "feature_names": list(self.plan.names),
            "dimensions": list(self.plan.dimensions),
            "shape_bins": None if self.bins is None else self.bins.to_dict(),
            "copt_threshold": self.copt_threshold,
            "feature_seed": self.feature_seed,
        }

    def save(self, path: str | os.PathLike) -> None:
        """Write the model file: whole, or not at all."""
        modelfile.write(path, self.manifest(), self.algorithm.arrays())

    # ---- applying it ---------------------------------------------------------------------------------------

    def predict_features(
        self, values: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float64]]:
        """Classify rows of features (in the order of ``plan.names``).

        Returns
        -------
        labels : (n,) uint8
            ASPRS codes; of equal probabilities the class that comes first.
        probabilities : (n, classes) float64
        """
        array = np.ascontiguousarray(values, dtype=np.float32)
        if array.ndim != 2 or array.shape[1] != len(self.plan.names):
            raise ModelError(
                f"the model takes {len(self.plan.names)} features per point",
                found=f"an array of shape {array.shape}",
            )
        if not np.isfinite(array).all():
            raise ModelError(
                "a feature is not a finite number", cure="Compute features with this package's own stage"
            )
        probabilities = self._weigh(self.algorithm.predict_proba(array))
        return self.codes[probabilities.argmax(axis=1)], probabilities

    def predict(
        self,
        xyz: npt.NDArray[np.float64],
        dimensions: Mapping[str, npt.ArrayLike] | None = None,
        where: npt.ArrayLike | None = None,
        *,
        current: npt.ArrayLike | None = None,
        threads: int | None = None,
        memory_mb: float = 512.0,
        probabilities: bool = False,
        margin: bool = False,
        variance: bool = False,
        reject_below: float | None = None,
        rejected_code: int | None = None,
        smooth: float = 0.0,
        progress: Any = None,
    ) -> Prediction:
        """Classify a cloud: features are computed block by block and classified at once.

        Memory holds the cloud's index, the results and a few blocks of features, whatever the cloud's size.

        Parameters
        ----------
        xyz : (n, 3) float64
            Coordinates in metres.
        dimensions : mapping
            Name to (n,) values; must have ``required_dimensions``.
        where : (n,) bool, optional
            Points to classify. The others keep their class but still serve as neighbors.
        current : (n,) int, optional
            Classes the points have now: what points outside `where`, and rejected ones, keep. Without it
            the former get 0 (never classified) and the latter 1 (unclassified).
        threads, memory_mb
            Cores to use, and memory for the blocks of features under way.
        probabilities, margin, variance : bool
            Whether to return them; the last only a network has.
        reject_below : float, optional
            Points less reliable than this are not given the winning class, and are counted.
        rejected_code : int, optional
            Class of rejected points, instead of their old one.
        smooth : float
            Metres, 0 for none: probabilities become half the point's own, half the mean over the classified
            points in a sphere of that radius around it. Classes, reliability and margin follow from these.
        progress : object, optional
            Handed to the feature engine.
        """
        xyz = np.asarray(xyz, dtype=np.float64)
        n = len(xyz)
        threshold = _checked_reject(reject_below)
        radius = smoothing.checked_radius(smooth)
        if rejected_code is not None and (isinstance(rejected_code, bool) or not 0 <= rejected_code <= 255):
            raise OptionError("'rejected_code' must be a class code from 0 to 255", found=rejected_code)
        rows = _rows(where, n)
        old = None if current is None else _codes_now(current, n)
        whole = getattr(self.algorithm, "whole_cloud", False)
        if variance and not whole:
            raise OptionError(
                "only a network gives a variance",
                found=f"a model of {self.algorithm.name}",
                cure="Use 'margin'",
            )
        fed, notes = gather(self.plan.dimensions, dimensions or {}, n, None if whole else rows)
        chosen = slice(None) if rows is None else rows
        classification = np.zeros(n, np.uint8) if old is None else old.copy()
        reliability = np.zeros(n, np.float32)
        margins = np.zeros(n, np.float32) if margin else None
        shares = np.zeros((n, len(self.classes)), np.float32) if probabilities else None
        variances = np.zeros(n, np.float32) if variance else None
        count = n if rows is None else len(rows)
        codes = self.codes

        def decide(p):
            best = p.argmax(axis=1)
            win = np.take_along_axis(p, best[:, None], axis=1)[:, 0]
            second = np.partition(p, -2, axis=1)[:, -2] if margin and p.shape[1] > 1 else np.zeros(len(p))
            return codes[best], win, win - second, p if probabilities else None

        def classify(values, _rows):
            p = self._weigh(self.algorithm.predict_proba(values))
            return smoothing.count_shares(p) if radius else decide(p)

        rejected = 0
        counted: dict[str, Any] = {}
        blocks: Any = ()
        if count and whole:
            found = self.algorithm.predict_cloud(
                xyz, fed, rows, threads=threads, memory_mb=memory_mb, progress=progress
            )
            blocks = [(chosen, smoothing.count_shares(found.mean) if radius else decide(found.mean))]
            counted.update(found.report)
            if variances is not None:
                variances[chosen] = found.variance
        elif count:
            engine = FeatureEngine(
                xyz,
                self.plan,
                bins=self.bins,
                copt_threshold=self.copt_threshold,
                seed=self.feature_seed,
                threads=threads,
            )
            blocks = engine.blocks(
                queries=rows,
                dimensions=fed,
                threads=threads,
                memory_mb=memory_mb,
                progress=progress,
                apply=classify,
            )
        if radius and count:
            counted["smooth"] = radius
            blocks = _smoothed(xyz, rows, blocks, len(self.classes), radius, threads, decide)
        for at, (code, win, lead, p) in blocks:
            reliability[at] = win
            if margins is not None:
                margins[at] = lead
            if shares is not None:
                shares[at] = p
            low = reliability[at] < threshold  # as stored, so that users can find the same points
            rejected += int(np.count_nonzero(low))
            if rejected_code is not None:
                code = np.where(low, np.uint8(rejected_code), code)
            elif old is not None:
                code = np.where(low, old[at], code)
            else:
                code = np.where(low, np.uint8(UNCLASSIFIED), code)
            classification[at] = code
        if count and not whole:
            for key in ("fewer_than_three", "beyond_halo"):
                if any(engine.report.get(key, {}).values()):
                    counted[key] = {token: m for token, m in engine.report[key].items() if m}
        given, number = np.unique(classification[chosen], return_counts=True)
        report = {
            "points": n,
            "classified": count - rejected,
            "rejected": rejected,
            "outside_where": n - count,
            "classes": {str(int(code)): int(m) for code, m in zip(given, number, strict=True)},
            **{name: m for name, m in notes.items() if m},
            **counted,
        }
        return Prediction(classification, reliability, margins, shares, count, rejected, report, variances)


def load_model(path: str | os.PathLike) -> Model:
    """Read a model file. Nothing in it is executed, and nothing in it is believed unchecked.

    Raises
    ------
    ModelError
        The file is missing, damaged, of a newer version, or not what it says.
    """
    manifest, arrays = modelfile.read(path, lambda name: algorithm(name).rules)
    try:
        return _assemble(manifest, arrays)
    except ModelError as error:
        error.cure = error.cure or modelfile.CURE
        raise error.at(str(path)) from None
    except OptionError as error:  # a feature or neighborhood of another release
        raise ModelError("the model's features are not known here", where=str(path), found=error) from error


def _assemble(manifest: dict[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Model:
    kind = algorithm(manifest["algorithm"])
    plan: Any = (
        kind.plan_of(manifest) if hasattr(kind, "plan_of") else FeaturePlan.from_dict(manifest["features"])
    )
    names = manifest["feature_names"]
    if list(plan.names) != names or list(plan.dimensions) != manifest["dimensions"]:
        pairs = zip([*names, *manifest["dimensions"]], [*plan.names, *plan.dimensions], strict=False)
        first = next((f"'{a}' where '{b}' belongs" for a, b in pairs if a != b), None)
        raise ModelError(
            "the model's features, or their order, are not those its neighborhoods give in this release",
            found=first or f"{len(names)} features, {len(plan.names)} belong",
            cure="Train the model again with this release",
        )
    priors = manifest.get("priors")
    if priors is not None and len(priors["factors"]) != len(manifest["classes"]):
        raise ModelError("the manifest's priors must have one factor per class", found=len(priors["factors"]))
    for key in ("percentiles/low", "percentiles/high", "importances"):
        group: Any = manifest
        for part in key.split("/"):
            group = None if group is None else group[part]
        if group is not None and len(group) != len(names):
            raise ModelError(f"the manifest's {key} must have one value per feature", found=len(group))
    classes = [(entry["code"], entry["name"]) for entry in manifest["classes"]]
    codes = [code for code, _ in classes]
    if sorted(set(codes)) != codes:
        raise ModelError("the model's classes must be ascending, each once", found=codes[:10])
    made = kind.from_arrays(arrays, manifest["parameters"], len(names), len(classes))
    bins = manifest["shape_bins"]
    _check_fitted(plan, bins or {}, manifest["copt_threshold"])
    return Model(
        plan,
        made,
        classes,
        None if bins is None else ShapeBins.from_dict(bins),
        manifest["copt_threshold"],
        manifest["feature_seed"],
        {key: value for key, value in manifest.items() if key not in _OWN},
    )


def _check_fitted(plan: Any, bins: Mapping[str, Any], copt_threshold: float | None) -> None:
    """What the engine would otherwise fit to the cloud at hand must come from the file."""
    if not isinstance(plan, FeaturePlan):
        return
    for part in plan.layout:
        if part.shapes and part.neighborhood.token not in bins:
            raise ModelError(
                "the model lacks the thresholds of shape distributions", found=part.neighborhood.token
            )
        if part.neighborhood.kind == "copt" and copt_threshold is None:
            raise ModelError("the model lacks the curvature threshold of copt")


def _rows(where: npt.ArrayLike | None, n: int) -> npt.NDArray[np.int64] | None:
    if where is None:
        return None
    mask = np.asarray(where)
    if mask.shape != (n,) or mask.dtype != np.bool_:
        raise OptionError(
            "'where' must be one true or false per point", found=f"{mask.dtype} of shape {mask.shape}"
        )
    return None if mask.all() else np.flatnonzero(mask)


def _smoothed(xyz, rows, blocks, classes: int, radius: float, threads: int | None, decide: Any):
    """Blocks of decisions on smoothed probabilities, once those of all points are there."""
    shares = np.zeros((len(xyz), classes), np.uint16)
    for at, block in blocks:
        shares[at] = block
    if rows is not None:
        shares = shares[rows]
    means = smoothing.smooth(xyz if rows is None else xyz[rows], shares, radius, threads)
    for start in range(0, len(means), _DECIDED):
        part = slice(start, start + _DECIDED)
        yield part if rows is None else rows[part], decide(means[part])


#: Points decided on at a time.
_DECIDED = 500_000


def _codes_now(current: npt.ArrayLike, n: int) -> npt.NDArray[np.uint8]:
    array = np.asarray(current)
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise OptionError(
            "'current' must be one class code per point", found=f"{array.dtype} of shape {array.shape}"
        )
    if n and (array.min() < 0 or array.max() > 255):
        raise OptionError(
            "'current' has values that are no class codes", found=f"{array.min()} to {array.max()}"
        )
    return array.astype(np.uint8)


def _checked_reject(value: float | None) -> np.float32:
    if value is None:
        return np.float32(0)
    if isinstance(value, bool) or not 0.0 <= value <= 1.0:
        raise OptionError("'reject_below' must be a probability from 0 to 1", found=value)
    return np.float32(value)
