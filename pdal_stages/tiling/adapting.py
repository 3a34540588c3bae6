"""A model for a survey without labels, trained on the points that another model is sure of.

Self-training: on a new survey, a model is nearly always right where it is sure. These points show what roofs, crowns and
ground look like with this sensor and point density and in this region, and a model trained on them alone is better there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base import checks, las
from ..base.errors import StageError
from ..base.files import MODEL, Output, check_outputs, work_folder
from ..classifier.model import load_model
from ..classifier.modelfile import digest_of
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_las
from ..pipeline.parts import las_chunks
from .classify import ClassifyTask
from .settings import TilingOptions
from .training import TrainTask

#: Least reliability of points to train on. With 0.55 the gain is smaller, as errors are learned, too.
SURE = 0.7
#: Samples of each class: enough for one survey, and quick to train.
COUNT = 6_000
#: A class with fewer sure points is left out: they may well be errors of the teacher.
FEWEST = 200
#: Most points to classify: of a larger survey, only some files spread over it.
MOST = 20_000_000


@dataclass(frozen=True)
class AdaptTask:
    """A model to be adapted to a survey."""

    #: files, folders, patterns, tile indexes of one survey; of their classes only noise and overlap matter
    inputs: Sequence[str]
    model: str  #: the file to write
    teacher: str = "standard"  #: the model that classifies the survey
    sure: float = SURE  #: the least ``Reliability`` of points to train on
    options: TilingOptions = field(default_factory=TilingOptions)

    def run(self) -> list[str]:
        """Write the model; returns messages. StageError where the teacher is sure of fewer than two classes."""
        sure = checks.number("'--sure'", self.sure, 0.0, 1.0)
        teacher, files = load_model(self.teacher), input_files(self.inputs)
        check_outputs([Output(self.model, "model", MODEL)], files)
        chosen, told = spread(files)
        with work_folder(self.model) as folder:
            classified = self._classified(chosen, folder)
            found = sure_points(classified, sure, teacher.codes.tolist())
            codes = [code for code, count in found.items() if count >= FEWEST]
            if len(codes) < 2:
                counts = ", ".join(f"{count:,} of class {code}" for code, count in found.items())
                raise StageError(
                    f"'{self.teacher}' is sure of {FEWEST:,} points or more in fewer than two of its classes",
                    found=counts,
                    cure="Adapt to more of the survey, or use that model itself",
                )
            given: dict[str, Any] = {
                "classes": ",".join(map(str, codes)),
                "where": f"Reliability >= {sure:g}",
                "voxel": teacher.voxel,
                "count": COUNT,
                "folds": 0,  # scoring against the teacher's own answers means nothing
            }
            made = str(folder / "adapted.model")
            TrainTask(classified, made, (), given, self.options).run()
            new, name = load_model(made), Path(self.teacher).stem
            of = {"name": name, "sha256": digest_of(self.teacher), "sure": sure}
            replace(new, info={**new.info, "teacher": of}).save(self.model)
        missing = [f"{found[code]:,} points of class {code}" for code in found if code not in codes]
        if missing:
            told.append(
                f"'{self.teacher}' is sure of too few points of a class ({', '.join(missing)}): the new model leaves it out"
            )
        return told

    def _classified(self, files: Sequence[str], folder: Path) -> list[str]:
        """The inputs as the teacher classifies them."""
        request = ClassifyRequest(self.teacher, dimensions=("Reliability",))
        task = ClassifyTask(tuple(files), f"{folder}/classified/", request, self.options)
        if task.in_one_piece:
            return [task.run_whole().path]
        run = task.run_tiles()
        if run.failures:
            raise StageError(
                f"{len(run.failures):,} parts of the survey cannot be classified",
                found="; ".join(str(one) for one in run.failures[:3]),
                cure="Repair these files, or leave them out",
            )
        return sorted(str(one) for one in (folder / "classified").rglob("*.la[sz]"))


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
        for points in las_chunks(name):
            good = np.asarray(points["Reliability"]) >= sure
            total += np.bincount(np.asarray(points.classification)[good], minlength=256)
    return {code: int(total[code]) for code in codes}
