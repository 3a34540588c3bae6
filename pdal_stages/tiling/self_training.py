"""Train a model for a survey without labels on the points that another model is sure of.

Self-training: on a new survey, a model is nearly always right where it is sure. These points show
what roofs, crowns and ground look like with this sensor and point density and in this region, and a
model trained on them alone is better there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

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
    """Write a model adapted to a survey; return messages.

    Parameters
    ----------
    inputs : sequence of str
        One survey: files, folders, patterns. Of their classes only noise and overlap matter.
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
    teacher_model, files = load_model(teacher), input_files(inputs)
    check_outputs([Output(model, "model", MODEL)], [*files, *inputs, find(teacher)])
    chosen, messages = spread(files)
    with work_folder(model) as folder:
        request = ClassifyRequest(teacher, dimensions=("Reliability",))
        task = ClassifyTask(tuple(chosen), f"{folder}/classified/", request, options)
        classified = _classified(task)
        counts = sure_points(classified, sure, teacher_model.codes.tolist())
        codes = [code for code, count in counts.items() if count >= FEWEST]
        if len(codes) < 2:
            raise StageError(
                f"'{teacher}' is sure of {FEWEST:,} points in fewer than two of its classes",
                found=_listed(counts, counts),
                cure="Adapt to more of the survey, or use that model itself",
            )
        stage = {
            "classes": ",".join(map(str, codes)),
            "where": f"Reliability >= {sure:g}",
            "voxel": teacher_model.voxel,
            "count": COUNT,
            "folds": 0,  # scoring against the teacher's own answers means nothing
        }
        unnamed = str(folder / "adapted.model")
        TrainTask(classified, unnamed, (), stage, options).run()
        known = load_model(unnamed)
        source = {"name": Path(teacher).stem, "sha256": digest_of(teacher), "sure": sure}
        replace(known, info={**known.info, "teacher": source}).save(model)
    missing = [code for code in counts if code not in codes]
    if missing:
        messages.append(
            f"'{teacher}' is sure of too few points of a class ({_listed(counts, missing)}): the "
            "new model leaves it out"
        )
    return messages


def _listed(counts: Mapping[int, int], codes: Iterable[int]) -> str:
    """Return the numbers of points of some classes as text."""
    return ", ".join(f"{counts[code]:,} points of class {code}" for code in codes)


def _classified(task: ClassifyTask) -> list[str]:
    """Classify the files of a task; return the outputs."""
    if task.in_one_piece:
        return list(task.run_whole().outputs[0].outputs or ())
    run = task.run_tiles()
    if run.failures:
        raise StageError(
            f"{len(run.failures):,} parts of the survey cannot be classified",
            found="; ".join(f"{what}: {why}" for what, why in run.failures[:3]),
            cure="Repair these files, or leave them out",
        )
    return sorted(str(path) for path in Path(task.output).rglob("*.la[sz]"))


def spread(files: Sequence[str], most: int = MOST) -> tuple[list[str], list[str]]:
    """Return files at regular steps that have about `most` points together; and messages."""
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
    """Return the points of each class code in files whose ``Reliability`` is at least `sure`."""
    total = np.zeros(256, np.int64)
    for name in files:
        for points in read_chunks(name):
            good = np.asarray(points["Reliability"]) >= sure
            total += np.bincount(np.asarray(points.classification)[good], minlength=256)
    return {code: int(total[code]) for code in codes}
