"""Registry of what the rooms above offer to models: kinds of classifiers, and preprocessing.

Imports only go downward, so this room cannot import the network or the stages of pipelines. Such a
room registers itself in its ``__init__``, which the package's own ``__init__`` imports. What it
registers are functions that import the implementation when it is first needed, so that a forest is
applied without the network's modules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from ..base.errors import ModelError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from ..base.files import Output
    from .interface import PassClassifier
    from .model import Model
    from .training_clouds import TrainingCloud
    from .training_options import TrainingOptions

#: The kind of a forest on features.
FOREST = "random_forest"
#: The kind of a forest on features that refines the passes of another model.
REFINED_FOREST = "refined_forest"


class Trainer(Protocol):
    """Module that trains one kind of classifier."""

    #: dimensions that training uses where the points have them -> the dimensions that each is
    #: computed from
    optional_inputs: Mapping[str, tuple[str, ...]]

    def own_options(self, options: Any) -> Any:
        """Return the checked options that only this kind has; None where it has none."""

    def inputs(self, options: TrainingOptions) -> tuple[str, ...]:
        """Return the dimensions that the classifier will read."""

    def outputs(self, options: TrainingOptions) -> list[Output]:
        """Return the files that training writes beside the model."""

    def train(
        self, clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool
    ) -> Model:
        """Train a model on clouds that are prepared already."""


class Preprocessing(Protocol):
    """Module that knows the stages that compute what a model reads, such as heights."""

    def check(self, preparation: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return the stages in one spelling; ModelError for one that no model may carry."""

    def algorithm_versions(self, preparation: Iterable[Mapping[str, Any]]) -> dict[str, int]:
        """Return the version of each stage's algorithm in this release, by its type."""

    def preparation_of(self, names: Iterable[str]) -> list[dict[str, Any]]:
        """Return the stages that compute these dimensions, as far as they are heights."""

    def made_of_coordinates(
        self,
        preparation: Sequence[Mapping[str, Any]],
        xyz: npt.NDArray[np.float64],
        usable: npt.NDArray[np.bool_] | None = None,
        threads: int | None = None,
        classes: npt.NDArray[np.uint8] | None = None,
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the dimensions (n,) that the stages compute from coordinates (n, 3) in meters."""


class _Kind(NamedTuple):
    classifier: Callable[[], type[PassClassifier]]
    trainer: Callable[[], Trainer]


_kinds: dict[str, _Kind] = {}
_preprocessing: list[Callable[[], Preprocessing]] = []


def register_kind(
    name: str, classifier: Callable[[], type[PassClassifier]], trainer: Callable[[], Trainer]
) -> None:
    """Register a kind of classifier by the name that manifests and the option `algorithm` use."""
    _kinds[name] = _Kind(classifier, trainer)


def register_preprocessing(load: Callable[[], Preprocessing]) -> None:
    """Register the module that knows the stages which compute a model's dimensions."""
    _preprocessing.append(load)


def kinds() -> tuple[str, ...]:
    """Return the names of the kinds that can be trained."""
    return tuple(_kinds)


def classifier_of(name: str) -> type[PassClassifier]:
    """Return the class of a kind; ModelError for one that this release does not have."""
    kind = FOREST if name == REFINED_FOREST else name
    if kind not in _kinds:
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    return _kinds[kind].classifier()


def trainer_of(name: str) -> Trainer:
    """Return the module that trains a kind, one of :func:`kinds`."""
    return _kinds[name].trainer()


def preprocessing() -> Preprocessing:
    """Return the module that was registered."""
    return _preprocessing[-1]()
