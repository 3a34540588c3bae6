"""Loading a model: its file is read, what it says is checked, and its classifiers are made."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy.typing as npt

from ..base.errors import ModelError, OptionError, suggest
from ..features.voxels import check_side
from . import model_file
from .model import Model
from .registry import classifier_of, preprocessing


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
            "the model needs what this release does not have", where=file, found=error
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


def assemble(manifest: dict[str, Any], arrays: model_file.Arrays) -> Model:
    """Return the model of a manifest and arrays; ModelError where they contradict each other."""
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
        own_codes = entry.get("codes") or codes
        passes.append(_make_pass(entry, number, arrays[number], own_codes, before))
        before = own_codes
    if before != codes:
        raise ModelError("the last pass has other classes than the model", found=before[:10])
    info = {k: value for k, value in manifest.items() if k not in ("format", "version", "arrays")}
    scores = ("importances", "codes", "factors")
    info["passes"] = [
        {key: entry[key] for key in scores if key in entry} for entry in manifest["passes"]
    ]
    return Model(tuple(passes), classes, info)


def _make_pass(
    entry: Mapping[str, Any],
    number: int,
    arrays: Mapping[str, npt.NDArray[Any]],
    codes: list[int],
    codes_before: list[int],
) -> Any:
    """Return the classifier of a pass, the `number`-th from 0, whose classes are `codes`."""
    here = f"pass {number + 1}"
    if sorted(set(codes)) != codes or len(entry.get("factors") or codes) != len(codes):
        raise ModelError(
            "a pass's classes must ascend, each once, with one factor each", found=codes[:10]
        )
    if (number > 0) != bool(entry["context"]):
        raise ModelError("every pass but the first must read context", found=here)
    classifier: Any = classifier_of(entry["algorithm"]).from_file(entry, arrays, codes)
    if number and classifier.classes_before(codes) != codes_before:
        raise ModelError("a pass reads other classes than the one before gives", found=here)
    importances = entry["importances"]
    if importances is not None and len(importances) != len(entry["feature_names"]):
        raise ModelError(
            "the manifest's importances must have one value per feature", found=len(importances)
        )
    return classifier
