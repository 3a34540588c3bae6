"""``filters.modelclassifier``: apply a model file, write ASPRS classes [B16, W18]."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import OptionError
from ..base.progress import Progress
from ..classifier import Model, load_model
from ..classifier.smoothing import FARTHEST
from .base import Stage
from .options import Option
from .points import Points


class ModelClassifier(Stage):
    type = "filters.modelclassifier"
    summary = "Apply a model file: compute what the model needs block by block, and write classes"
    source = "[B16] section 3.4, [W18] section 3.3, [WM19] for networks"
    where_help = "Points outside keep their class but still serve as neighbors."
    options = (
        Option("model", "filename", None, "The model file to apply", required=True),
        Option(
            "probabilities",
            "boolean",
            False,
            "Also write the probability of each class, as Probability_<code>",
        ),
        Option("margin", "boolean", False, "Also write Margin, the winning probability minus the second"),
        Option(
            "variance",
            "boolean",
            False,
            "Also write Variance, that of the probabilities over a network's batches (alsnet only)",
        ),
        Option(
            "reject_below",
            "number",
            None,
            "Points less reliable than this are not given the winning class, and are counted",
            minimum=0,
            maximum=1,
        ),
        Option(
            "rejected_code",
            "integer",
            None,
            "Class code of rejected points; default: they keep the class they had",
            minimum=0,
            maximum=255,
        ),
        Option(
            "smooth",
            "number",
            0.0,
            "Average probabilities with those of the points in a sphere of this radius, half and half; 0: do not",
            minimum=0,
            maximum=FARTHEST,
            unit="m",
        ),
        Option(
            "memory",
            "integer",
            512,
            "Memory for blocks of points, over the cloud itself",
            minimum=16,
            unit="MB",
        ),
    )
    details = """
Computes the features the model needs block by block and classifies them at once, so memory does not grow with their
number. A model asked for a dimension that the points lack names the dimension and the stage that makes it.
`Reliability` is the probability of the winning class. `smooth` (1 m, say)
makes classes calmer: a point's probabilities become half its own and half the mean over its neighbors, as far as
these are classified too; class, reliability and margin follow.
With LAS 1.0-1.3 the synthetic, key-point and withheld flags of each point stay. Codes above 31
need LAS 1.4 (`"minor_version": 4, "dataformat_id": 6`), which is checked before any work is done.
"""
    dimensions_help = """- Reads: X, Y, Z, `Classification`, and what the model names (`pdal-stages model FILE`)
- Writes: `Classification` (uint8_t), `Reliability` (float); on request `Margin`, `Variance` and `Probability_<code>` (float)
- Halo: that of the model's neighborhoods, and `smooth`"""
    before = ({"type": "filters.hag_minima"},)
    after = ({"type": "writers.las", "filename": "output.laz", "forward": "all", "extra_dims": "all"},)
    example = {"type": "filters.modelclassifier", "model": "town.model"}

    @classmethod
    def check(cls, options: dict[str, Any]) -> None:
        model = cls.model(options)
        if options["variance"] and not getattr(model.algorithm, "whole_cloud", False):
            raise OptionError(
                "option 'variance' is for networks; this model is another",
                found=model.algorithm.name,
                cure="Use 'margin'",
            )

    @classmethod
    def model(cls, options: dict[str, Any]) -> Model:
        """The loaded model; read once per process as long as the file stays the same."""
        path = Path(options["model"])
        try:
            stat = path.stat()
            stamp = (stat.st_mtime_ns, stat.st_size)
        except OSError:
            return load_model(path)  # says what is wrong
        return _load(str(path), stamp)

    @classmethod
    def reads(cls, options: dict[str, Any]) -> list[str]:
        return list(cls.model(options).required_dimensions)

    @classmethod
    def creates(cls, options: dict[str, Any]) -> dict[str, str]:
        out = {"Classification": "uint8_t", "Reliability": "float"}
        if options["margin"]:
            out["Margin"] = "float"
        if options["variance"]:
            out["Variance"] = "float"
        if options["probabilities"]:
            out.update({f"Probability_{code}": "float" for code, _ in cls.model(options).classes})
        return out

    @classmethod
    def halo(cls, options: dict[str, Any]) -> float:
        return cls.model(options).halo + cls.inner_reach(options)

    @classmethod
    def inner_reach(cls, options: dict[str, Any]) -> float:
        return options["smooth"] + 0.001 if options["smooth"] else 0.0  # a distance rounds

    @classmethod
    def largest_class(cls, options: dict[str, Any]) -> int:
        return max([code for code, _ in cls.model(options).classes] + [options["rejected_code"] or 0])

    @classmethod
    def run(cls, points: Points, options: dict[str, Any]) -> dict[str, NDArray]:
        creates = cls.creates(options)
        if points.count == 0:
            return {}
        model = cls.model(options)
        chosen = points.count if points.mask is None else int(np.count_nonzero(points.mask))
        with Progress(chosen, cls.type) as progress:
            found = model.predict(
                points.xyz,
                {name: points.dimension(name) for name in model.required_dimensions},
                points.mask,
                current=points.class_codes,
                threads=options["threads"],
                memory_mb=options["memory"],
                probabilities=options["probabilities"],
                margin=options["margin"],
                variance=options["variance"],
                reject_below=options["reject_below"],
                rejected_code=options["rejected_code"],
                smooth=options["smooth"],
                progress=progress,
            )
        values: dict[str, NDArray] = {
            "Classification": found.classification,
            "Reliability": found.reliability,
        }
        if found.margin is not None:
            values["Margin"] = found.margin
        if found.variance is not None:
            values["Variance"] = found.variance
        if found.probabilities is not None:
            for column, (code, _) in enumerate(model.classes):
                values[f"Probability_{code}"] = found.probabilities[:, column]
        if points.mask is not None:  # what was there before stays outside `where`
            for name in creates:
                if name != "Classification":
                    values[name] = np.where(points.mask, values[name], points.arrays[name])
        values["Classification"] = points.with_codes(values["Classification"])
        points.report.update(found.report)
        return values


@lru_cache(maxsize=4)
def _load(path: str, stamp: tuple[int, int]) -> Model:
    return load_model(path)
