"""The request of ``classify``, and the pipeline for one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ..base.asprs import GROUND, OVERLAP
from ..base.errors import ModelError, OptionError, suggest
from ..base.las_repair import extra_dimensions
from ..classifier.model import loaded_model
from ..classifier.model_file import STANDARD
from ..stages import preprocessing
from ..stages.points import SELECTED
from ..stages.registry import stage_from, stage_types
from .inputs_outputs import is_las, overridden, reader_of, writer_of
from .las_output import extra_dims_option
from .overrides import Override
from .run import Pipeline
from .stage_files import LAS_WRITERS

#: The stage whose ground bridge decks lead on to.
_GROUND = preprocessing.GROUND_FILTER

#: Dimensions that are written besides the input's own by default.
WRITTEN = ("HeightAboveGround", "Reliability")

#: How the names begin of dimensions that hold what the input has, while stages make others of the
#: same names.
_KEPT = "PdalStagesKept"


def _ferry(pairs: list[str]) -> list[dict[str, Any]]:
    return [{"type": "filters.ferry", "dimensions": ",".join(pairs)}] if pairs else []


@dataclass(frozen=True)
class ClassifyRequest:
    """How points are to be classified, independent of the inputs."""

    model: str = STANDARD  #: a model file, or the name of a shipped one
    overrides: tuple[Override, ...] = ()  #: options of stages, which may name another model
    #: Classify only the points for which this holds, with the classes that they have in the input.
    where: str | None = None
    #: Created dimensions to write besides the input's own; ``all`` and ``none`` are allowed.
    dimensions: tuple[str, ...] = WRITTEN
    #: options of ``filters.modelclassifier``, such as ``keep_sure`` and ``vegetation_heights``
    classifier_options: Mapping[str, Any] = field(default_factory=dict)
    noise: bool = True  #: mark low and high noise first
    bridges: bool = (
        False  #: find bridge decks, where heights come from ``filters.hag_morphological``
    )
    wires: bool = False  #: find wires, where heights are computed
    towers: bool = False  #: find wires, and their towers
    polygons: tuple[str, ...] = ()  #: as ``filters.polygons`` takes them
    given_ground: bool = False  #: points of class 2 are the ground, and stay so

    @property
    def _inside(self) -> dict[str, str]:
        return {"where": self.where} if self.where else {}

    @cached_property
    def _classifier(self) -> dict[str, Any]:
        stage: dict[str, Any] = {
            "type": "filters.modelclassifier",
            "model": self.model,
            "compact": True,
            **self._inside,
            **({"mark": SELECTED} if self.where else {}),
            **self.classifier_options,
        }
        for option, name in (("margin", "Margin"), ("probabilities", "Probability_")):
            if any(one.startswith(name) for one in self.dimensions):
                stage[option] = True
        return stage

    @property
    def cost(self) -> list[str]:
        """The expected cost of `keep_sure`, as lines of text; none without it."""
        given = overridden(self._classifier, self.overrides)
        if given.get("keep_sure") is None:
            return []
        stage: Any = stage_from(given)
        return stage.limits.describe_cost(dict(stage.model.classes))

    @cached_property
    def loaded(self) -> Any:
        """The model that will be applied, after overrides."""
        return loaded_model(overridden(self._classifier, self.overrides)["model"])

    @cached_property
    def stages(self) -> list[dict[str, Any]]:
        """The stages: noise, preparation of what the model reads, the classifier, corrections."""
        if by_hand := self.loaded.info.get("by_hand"):
            raise ModelError(
                "the model reads dimensions of stages that a model file does not hold",
                where=self.model,
                found=", ".join(by_hand),
                cure="Write a pipeline: the reader, these stages with the options of the training, "
                "filters.modelclassifier, and the writer",
            )
        prepared = self._prepared
        if self.bridges:
            prepared = [
                {**stage, "ground": True} if stage["type"] == _GROUND else stage
                for stage in prepared
            ]
        noise, classifier = {"type": "filters.detachednoise", **self._inside}, self._classifier
        if self._ground_is_given:
            ground = f"Classification != {GROUND}"
            noise["where"] = f"({self.where}) && {ground}" if self.where else ground
            classifier = {**classifier, "given_ground": True}
        return [*([noise] if self.noise else []), *prepared, classifier, *self._corrections]

    @property
    def _prepared(self) -> list[dict[str, Any]]:
        """The stages before the classifier, as the model says or its dimensions need."""
        needed = self.loaded.required_dimensions
        stages = self.loaded.info.get("preparation") or preprocessing.preparation_of(needed)
        if not self.given_ground:
            return stages
        if not any(stage["type"] == _GROUND for stage in stages):
            raise OptionError(
                f"--ground given needs a model whose heights come from {_GROUND}",
                found=f"{self.model}: "
                f"{', '.join(stage['type'] for stage in stages) or 'no heights'}",
                cure="Leave it out, or take another model",
            )
        return preprocessing.with_given_ground(stages)

    @property
    def _ground_is_given(self) -> bool:
        return any(stage.get("given_ground") for stage in self._prepared)

    @property
    def _corrections(self) -> list[dict[str, Any]]:
        """Return the corrections after the classifier, for models with the classes they need, and
        polygons last.

        They take the points that the classifier marked: `where` would see its new classes by then.
        """
        settled = overridden(self._classifier, self.overrides)
        taken: dict[str, Any] = {
            name: settled[name] for name in ("ignore", "keep") if name in settled
        }
        wanted = {
            "filters.bridges": self.bridges,
            "filters.wires": self.wires,
            "filters.polygons": bool(self.polygons),
        }
        inside = {"where": f"{SELECTED} == 1"} if self.where else {}
        stages = [{"type": kind, **taken, **inside} for kind, chosen in wanted.items() if chosen]
        for stage in stages:
            if stage["type"] == "filters.wires" and self.towers:
                stage["towers"] = True
            if self._ground_is_given and stage["type"] != "filters.polygons":
                kept = stage.get("keep", OVERLAP)
                stage["keep"] = [*(kept if isinstance(kept, list) else [kept]), GROUND]
        if self.polygons:
            stages[-1]["polygons"] = list(self.polygons)
        return stages

    @cached_property
    def _creates(self) -> dict[str, str]:
        """The dimensions that the stages make, except classes: name -> PDAL type."""
        made: dict[str, str] = {}
        for stage in self.stages:
            if stage["type"] in preprocessing.OF_PDAL:
                made["HeightAboveGround"] = "double"
            elif stage["type"] in stage_types():
                made |= stage_from(overridden(stage, self.overrides)).creates()
        for name in ("Classification", SELECTED):
            made.pop(name, None)
        return made

    @cached_property
    def extra_dims(self) -> dict[str, str]:
        """The dimensions that are written besides the input's own: name -> PDAL type."""
        made = self._creates
        for name in self.dimensions:
            if name not in ("all", "none", *made) and self.dimensions != WRITTEN:
                raise OptionError(
                    "--dimensions names a dimension no stage creates",
                    found=name,
                    cure=f"{suggest(name, list(made))}There are {', '.join(made)}; or all, or none",
                )
        if "all" in self.dimensions:
            return made
        return {name: kind for name, kind in made.items() if name in self.dimensions}

    def pipeline(self, source: str, target: str) -> Pipeline:
        """Read a file, compute heights where the model needs them, classify, and write with
        everything else kept.
        """
        if Path(target).suffix.lower() in (".tif", ".tiff", ".gpkg", ".shp", ".geojson"):
            raise OptionError(
                "classify writes points",
                found=target,
                cure="Name a .laz or .las file. Buildings, trees and more: --objects FILE; "
                "rasters: docs/large-areas.md",
            )
        writer = writer_of(target)
        if writer.get("type") in LAS_WRITERS:
            listed = extra_dims_option([source], self.extra_dims)
            writer |= {"extra_dims": listed} if listed else {}
        elif self.dimensions != WRITTEN and "all" not in self.dimensions:
            raise OptionError(
                "--dimensions is for LAS and LAZ; other formats get all dimensions",
                found=target,
                cure="Leave it out, or write a pipeline",
            )
        # What stages make on the way must not replace what the input has under the same name.
        to_las = writer.get("type") in LAS_WRITERS  # others get all dimensions
        own = extra_dimensions(source) if to_las and is_las(source) else {}
        kept = [name for name in own if name in self._creates and name not in self.extra_dims]
        keep = _ferry([f"{name}=>{_KEPT}{name}" for name in kept])
        put_back = _ferry([f"{_KEPT}{name}=>{name}" for name in kept])
        stages = [reader_of(source, "input"), *keep, *self.stages, *put_back, writer]
        return Pipeline(stages, self.overrides)
