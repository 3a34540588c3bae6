"""A model for a survey without labels, trained on the points that another model is sure of.

Self-training: on a new survey, a model is nearly always right where it is sure. These points show
what roofs, crowns and ground look like with this sensor and point density and in this region, and a
model trained on them alone is better there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base import checks, las
from ..base.errors import StageError
from ..base.files import MODEL, Output, check_outputs, work_folder
from ..classifier.model import load_model
from ..classifier.model_file import digest_of, find
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_las
from ..pipeline.las_chunks import read_chunks
from .classify import ClassifyTask
from .options import TilingOptions
from .train_survey import TrainTask

#: Least reliability of points to train on. With 0.55 the gain is smaller, as errors are learned,
#: too.
SURE = 0.7
#: Samples of each class: enough for one survey, and quick to train.
COUNT = 6_000
#: A class with fewer sure points is left out: they may well be errors of the teacher.
FEWEST = 200
#: Most points to classify: of a larger survey, only some files spread over it.
MOST = 20_000_000


def adapt(
    inputs: Sequence[str],
    model: str,
    teacher: str = "standard",
    sure: float = SURE,
    options: TilingOptions | None = None,
) -> list[str]:
    """Write a model adapted to a survey; returns messages.

    Parameters
    ----------
    inputs : sequence of str
        Files, folders, patterns, tile indexes of one survey; of their classes only noise and
        overlap matter.
    model : str
        The file to write.
    teacher : str
        The model that classifies the survey.
    sure : float
        The least ``Reliability`` of points to train on.
    options : TilingOptions, optional

    Raises
    ------
    StageError
        Where the teacher is sure of fewer than two classes.
    """
    sure, options = checks.number("'--sure'", sure, 0.0, 1.0), options or TilingOptions()
    known, files = load_model(teacher), input_files(inputs)
    check_outputs([Output(model, "model", MODEL)], [*files, *inputs, find(teacher)])
    chosen, told = spread(files)
    with work_folder(model) as folder:
        request = ClassifyRequest(teacher, dimensions=("Reliability",))
        classified = _classified(
            ClassifyTask(tuple(chosen), f"{folder}/classified/", request, options)
        )
        found = sure_points(classified, sure, known.codes.tolist())
        codes = [code for code, count in found.items() if count >= FEWEST]
        if len(codes) < 2:
            counts = ", ".join(f"{count:,} of class {code}" for code, count in found.items())
            raise StageError(
                f"'{teacher}' is sure of {FEWEST:,} points or more in fewer than two of its classes",
                found=counts,
                cure="Adapt to more of the survey, or use that model itself",
            )
        given: dict[str, Any] = {
            "classes": ",".join(map(str, codes)),
            "where": f"Reliability >= {sure:g}",
            "voxel": known.voxel,
            "count": COUNT,
            "folds": 0,  # scoring against the teacher's own answers means nothing
        }
        made = str(folder / "adapted.model")
        TrainTask(classified, made, (), given, options).run()
        new, of = (
            load_model(made),
            {"name": Path(teacher).stem, "sha256": digest_of(teacher), "sure": sure},
        )
        replace(new, info={**new.info, "teacher": of}).save(model)
    missing = [f"{found[code]:,} points of class {code}" for code in found if code not in codes]
    if missing:
        told.append(
            f"'{teacher}' is sure of too few points of a class ({', '.join(missing)}): the new "
            "model leaves it out"
        )
    return told


def _classified(task: ClassifyTask) -> list[str]:
    """The files that a task classifies."""
    if task.in_one_piece:
        return list(task.run_whole().outputs[0].outputs or ())
    run = task.run_tiles()
    if run.failures:
        raise StageError(
            f"{len(run.failures):,} parts of the survey cannot be classified",
            found="; ".join(str(one) for one in run.failures[:3]),
            cure="Repair these files, or leave them out",
        )
    return sorted(str(one) for one in Path(task.output).rglob("*.la[sz]"))


def spread(files: Sequence[str], most: int = MOST) -> tuple[list[str], list[str]]:
    """Files at regular steps, so that they have about `most` points; and messages."""
    headers = [las.header_there(name) for name in files] if all(map(is_las, files)) else []
    points = sum(header.count for header in headers if header)
    step = min(max(1, round(points / most)), len(files))
    if step == 1:
        return list(files), []
    chosen = list(files[step // 2 :: step])
    return chosen, [
        f"{len(chosen):,} of {len(files):,} files are used, one in {step}: their points are enough"
    ]


def sure_points(files: Sequence[str], sure: float, codes: Sequence[int]) -> dict[int, int]:
    """Of each class, the points of classified files whose ``Reliability`` is at least `sure`."""
    total = np.zeros(256, np.int64)
    for name in files:
        for points in read_chunks(name):
            good = np.asarray(points["Reliability"]) >= sure
            total += np.bincount(np.asarray(points.classification)[good], minlength=256)
    return {code: int(total[code]) for code in codes}
