"""Loading a model: read its file, check what it says of itself, and make the classifiers of its passes."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

from ..base.errors import ModelError, OptionError, suggest
from ..features.voxels import check_side
from . import model_file
from .model import Model
from .registry import classifier_of, preprocessing


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
