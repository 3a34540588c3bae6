"""A classifier of points in the manner of scikit-learn."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.validation import check_is_fitted

from ..base.errors import OptionError
from .algorithms import Prediction
from .training import train
from .trainoptions import DEFAULT_PASSES, TrainingOptions


class PointClassifier(ClassifierMixin, BaseEstimator):
    """A forest on the multi-scale features of points: ``PointClassifier().fit(xyz, y).predict(xyz)``.

    ``X`` is a whole cloud, coordinates in meters: a point's features follow from the points around it, so rows cannot be
    dealt out as scikit-learn's own cross-validation does. Labels 0, 1, 7, 12 and 18 are left out unless `classes`
    names them, as in all training here.

    Parameters
    ----------
    neighborhoods, feature_set, classes, count, trees, min_samples_leaf, prior_weight, passes, thin, seed, threads
        As for :class:`TrainingOptions`, which says what the defaults are.
    options : TrainingOptions, optional
        All options instead; the others are not looked at.

    Attributes
    ----------
    model_ : Model
        Its `save` writes the file that ``filters.modelclassifier`` applies.
    classes_ : (k,) uint8
        ASPRS codes, in the order of the columns of :meth:`predict_proba`.
    n_features_in_ : int
        3.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> xyz = rng.uniform(0, 30, (2000, 3)) * [1, 1, 0.01]
    >>> xyz[:500] += [0, 0, 6]
    >>> y = np.where(xyz[:, 2] > 3, 6, 2)
    >>> model = PointClassifier(neighborhoods="k10", count=100, trees=5, passes=1).fit(xyz, y)
    >>> float((model.predict(xyz) == y).mean())
    1.0
    """

    def __init__(
        self,
        neighborhoods: Any = TrainingOptions.neighborhoods,
        feature_set: Any = TrainingOptions.feature_set,
        *,
        classes: Any = TrainingOptions.classes,
        count: int = TrainingOptions.count,
        trees: Any = TrainingOptions.trees,
        min_samples_leaf: Any = TrainingOptions.min_samples_leaf,
        prior_weight: float = TrainingOptions.prior_weight,
        passes: int = DEFAULT_PASSES,
        thin: Any = TrainingOptions.thin,
        seed: int = TrainingOptions.seed,
        threads: int | None = TrainingOptions.threads,
        options: TrainingOptions | None = None,
    ) -> None:
        self.neighborhoods = neighborhoods
        self.feature_set = feature_set
        self.classes = classes
        self.count = count
        self.trees = trees
        self.min_samples_leaf = min_samples_leaf
        self.prior_weight = prior_weight
        self.passes = passes
        self.thin = thin
        self.seed = seed
        self.threads = threads
        self.options = options

    def fit(
        self, X: npt.ArrayLike, y: npt.ArrayLike, dimensions: Mapping[str, npt.ArrayLike] | None = None
    ) -> PointClassifier:
        """Train on a cloud (n, 3) with class codes (n,); `dimensions` (name to (n,) values) are heights by default."""
        options = self.options
        if options is None:
            given = {k: v for k, v in self.get_params(deep=False).items() if k != "options"}
            options = TrainingOptions(**given)
        if not isinstance(options, TrainingOptions):
            raise OptionError("'options' must be TrainingOptions", found=repr(options)[:60])
        self.model_ = train(X, y, options, dimensions=dimensions, progress=False)
        self.classes_ = self.model_.codes
        self.n_features_in_ = 3
        return self

    def _predicted(self, X: npt.ArrayLike, dimensions: Any, **more: Any) -> Prediction:
        check_is_fitted(self)
        return self.model_.predict(np.asarray(X), dimensions, threads=self.threads, **more)

    def predict(
        self, X: npt.ArrayLike, dimensions: Mapping[str, npt.ArrayLike] | None = None
    ) -> npt.NDArray[np.uint8]:
        """ASPRS codes of a cloud's points, (n,)."""
        return self._predicted(X, dimensions).classification

    def predict_proba(
        self, X: npt.ArrayLike, dimensions: Mapping[str, npt.ArrayLike] | None = None
    ) -> npt.NDArray[np.float32]:
        """Probabilities of ``classes_``, (n, k)."""
        found = self._predicted(X, dimensions, probabilities=True).probabilities
        assert found is not None
        return found

    def save(self, path: str | os.PathLike) -> None:
        """Write the model file."""
        check_is_fitted(self)
        self.model_.save(path)
