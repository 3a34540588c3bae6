"""Kinds that learn on features: the forest, and learners of other packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy.typing as npt

from ..base.json_types import JsonObject
from .interface import ArrayRule, Trainer

if TYPE_CHECKING:
    from .feature_forest import FeatureForest
    from .learner import Learner


@dataclass(frozen=True)
class FeatureKind:
    """A kind whose learner is imported by `load` when it is first needed."""

    name: str  #: as in ``KINDS``
    load: Callable[[], type[Learner]]

    @property
    def rules(self) -> Mapping[str, ArrayRule]:
        """The arrays of a model file."""
        return self.load().rules

    @property
    def trainer(self) -> Trainer:
        """The trainer of this kind."""
        from .train_forest import FeatureTrainer

        return FeatureTrainer(self.name, self.load())

    def from_file(
        self, entry: JsonObject, arrays: Mapping[str, npt.NDArray], codes: Sequence[int]
    ) -> FeatureForest:
        """Return the pass of a manifest; ModelError where the entry contradicts itself."""
        from .feature_forest import FeatureForest

        return FeatureForest.from_file(entry, arrays, codes, self.load())
