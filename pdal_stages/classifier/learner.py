"""Learners on features: what a forest is to this package, and another may be.

``KINDS["boosting"] = FeatureKind("boosting", lambda: Booster)`` (``KINDS`` of :mod:`.interface`,
``FeatureKind`` of :mod:`.feature_kind`) registers one for this process, the entry
point ``pdal_stages.kinds`` for all. It then gets samples, features, passes with context,
cross-validation and calibration as the forest does, and is applied in tiles like it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt

from ..base.json_types import JsonObject
from ..base.progress import Progress
from .interface import ArrayRule
from .training_options import TrainingOptions

_Learner = TypeVar("_Learner", bound="Learner")


class Learner(Protocol):
    """Class probabilities of points from their features, and how that is learned and stored."""

    #: the arrays of a model file; a name that ends in ``*`` stands for many
    rules: ClassVar[Mapping[str, ArrayRule]]

    @classmethod
    def fit(
        cls: type[_Learner],
        values: npt.NDArray[np.float32],
        label: npt.NDArray,
        weight: npt.NDArray[np.int64],
        trees: int | Sequence[int],
        options: TrainingOptions,
        progress: Progress | None = None,
    ) -> tuple[_Learner, npt.NDArray[np.float64] | None]:
        """Learn from samples; return the learner, and the importances of features or None.

        Parameters
        ----------
        values : (n, features) float32
            Finite.
        label : (n,) int
            Class positions; every class occurs, if only with weight 0.
        weight : (n,) int
            Times a row counts; rows of weight 0 take no part.
        trees : int or sequence of int
            How large it is to be; of several numbers the best. `progress` is told each tree.
        options : TrainingOptions
        """

    @classmethod
    def from_arrays(
        cls: type[_Learner], arrays: Mapping[str, npt.NDArray], n_features: int, n_classes: int
    ) -> _Learner:
        """Return the learner of a model file's arrays; ModelError unless all of them fit."""

    def arrays(self) -> Mapping[str, npt.NDArray]:
        """Return the arrays that a model file stores."""

    def parameters(self) -> JsonObject:
        """Return what a manifest says of it beside its arrays, such as its size."""

    def predict_proba(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Return class probabilities (n, classes) of rows (n, features)."""


@runtime_checkable
class ContributingLearner(Learner, Protocol):
    """A learner that tells what each feature adds to a probability."""

    def contributions(
        self, values: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return probabilities (classes,) before any feature, and what features add to them.

        The latter are (n, features, classes) for rows (n, features); both sum to the probabilities.
        """
