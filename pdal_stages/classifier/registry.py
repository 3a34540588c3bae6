"""Registry of what the rooms above offer to models: kinds of classifiers, and preprocessing.

Imports only go downward, so this room cannot import the network or the stages of pipelines. Such a
room registers itself in its ``__init__``, which the package's own ``__init__`` imports. What it
registers are functions that import the implementation when it is first needed, so that a forest is
applied without the network's modules.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from ..base.errors import ModelError

if TYPE_CHECKING:
    from .interface import PassClassifier

#: The kind of a forest on features.
FOREST = "random_forest"
#: The kind of a forest on features that refines the passes of another model.
REFINED_FOREST = "refined_forest"


class _Kind(NamedTuple):
    classifier: Callable[[], type[PassClassifier]]
    trainer: Callable[[], Any]


_kinds: dict[str, _Kind] = {}
_preprocessing: list[Callable[[], Any]] = []


def register_kind(
    name: str, classifier: Callable[[], type[PassClassifier]], trainer: Callable[[], Any]
) -> None:
    """Register a kind of classifier by the name that manifests and the option `algorithm` use.

    Its trainer is a module with

    - ``optional_inputs``: dimensions that training uses where the points have them, each with the
      dimensions that it is computed from;
    - ``own_options(options)``: the checked options that only this kind has, or None;
    - ``inputs(options)``: the dimensions that the classifier will read;
    - ``outputs(options)``: the files that training writes beside the model;
    - ``train(clouds, options, progress)``: a ``Model``, trained on clouds that are prepared.
    """
    _kinds[name] = _Kind(classifier, trainer)


def register_preprocessing(load: Callable[[], Any]) -> None:
    """Register the module that knows the stages which compute a model's dimensions.

    It has

    - ``check(preparation)``: the stages in one spelling; ModelError for one that no model may have;
    - ``algorithm_versions(preparation)``: the version of each stage's algorithm in this release;
    - ``preparation_of(names)``: the stages that compute these dimensions, as far as they are
      heights;
    - ``made_of_coordinates(preparation, xyz, usable, threads, classes)``: the dimensions (n,) that
      the stages compute from coordinates (n, 3) in meters.
    """
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


def trainer_of(name: str) -> Any:
    """Return the module that trains a kind, one of :func:`kinds`."""
    return _kinds[name].trainer()


def preprocessing() -> Any:
    """Return the module that was registered."""
    return _preprocessing[-1]()
