"""The request of ``classify``, and the pipeline for one file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ..base.asprs import OVERLAP, TERRAIN, WIRE
from ..base.dimensions import HEIGHT
from ..base.errors import ModelError, OptionError, suggest
from ..base.json_types import StageJson
from ..base.selections import split_selection
from ..classifier.model import Model, loaded_model
from ..classifier.model_file import STANDARD
from ..stages import preprocessing
from ..stages.points import SELECTED
from ..stages.registry import stage_from, stage_types
from ..stages.where_expression import Expression
from .inputs_outputs import writes_las
from .json_source import Override, overridden
from .pdal import reader_of, writer_of
from .run import Pipeline

#: The stage whose ground bridge decks lead on to.
_GROUND = preprocessing.GROUND_FILTER
#: Dimensions that are written besides the input's own by default.
WRITTEN = ("HeightAboveGround", "Reliability")


@dataclass(frozen=True)
class ClassifyRequest:
    """Settings of a classification, independent of the inputs."""

    model: str = STANDARD  #: a model file, or the name of a shipped one
    overrides: tuple[Override, ...] = ()  #: options of stages, which may name another model
    #: Classify only the points for which this holds, with the classes that they have in the input.
    where: str | None = None
    #: Created dimensions to write besides the input's own; ``all`` and ``none`` are allowed.
    dimensions: tuple[str, ...] = WRITTEN
    #: options of ``filters.modelclassifier``, such as ``keep_sure`` and ``vegetation_heights``
    classifier_options: Mapping[str, object] = field(default_factory=dict)
    noise: bool = True  #: mark low and high noise first
    towers: bool = True  #: find what holds wires, where the model has these
    bridges: bool = False  #: find bridge decks, where heights are those of `_GROUND`
    polygons: tuple[str, ...] = ()  #: as ``filters.polygons`` takes them
    given_ground: bool = False  #: points of the classes TERRAIN are the ground, and stay so

    @property
    def _inside(self) -> StageJson:
        """The condition of stages: points that were marked as they came in, before any stage."""
        return {"where": f"{SELECTED} == 1"} if self.where else {}

    @cached_property
    def _classifier(self) -> StageJson:
        """The classifier as an object of a pipeline, before overrides."""
        stage: StageJson = {
            "type": "filters.modelclassifier",
            "model": self.model,
            "compact": True,
            **self._inside,
            **self.classifier_options,
        }
        for option, prefix in (("margin", "Margin"), ("probabilities", "Probability_")):
            if any(name.startswith(prefix) for name in self.dimensions):
                stage[option] = True
        return stage

    @cached_property
    def _settled(self) -> StageJson:
        """The classifier with overrides."""
        return overridden(self._classifier, self.overrides)

    @property
    def cost(self) -> list[str]:
        """The expected cost of `keep_sure`, as lines of text; empty without it."""
        if self._settled.get("keep_sure") is None:
            return []
        stage: Any = stage_from(self._settled)
        return stage.limits.describe_cost(dict(stage.model.classes))

    @cached_property
    def loaded(self) -> Model:
        """The model that will be applied, after overrides."""
        return loaded_model(self._settled["model"])

    @cached_property
    def stages(self) -> list[StageJson]:
        """The stages: noise, preprocessing of what the model reads, the classifier, corrections."""
        if by_hand := self.loaded.info.get("by_hand"):
            raise ModelError(
                "the model reads dimensions of stages that a model file does not hold",
                where=self.model,
                found=", ".join(by_hand),
                cure="Write a pipeline: the reader, these stages with the options of the training, "
                "filters.modelclassifier, and the writer",
            )
        if self.where:
            Expression(self.where)  # which refuses what it cannot read
        prepared, keep_ground = self._prepared()
        noise: StageJson = {"type": "filters.detachednoise", **self._inside}
        if keep_ground:
            others = " && ".join(f"Classification != {code}" for code in TERRAIN)
            noise["where"] = f"{noise['where']} && {others}" if self.where else others
        classifier = {**self._classifier, **({"given_ground": True} if keep_ground else {})}
        first = [noise] if self.noise else []
        return [*first, *prepared, classifier, *self._corrections(keep_ground)]

    def _prepared(self) -> tuple[list[StageJson], bool]:
        """Return the stages before the classifier, and whether they take ground that is given.

        The model names these stages, or they follow from its dimensions.
        """
        needed = self.loaded.required_dimensions
        stages = self.loaded.info.get("preparation") or preprocessing.preparation_of(needed)
        if self.given_ground:
            if not any(stage["type"] == _GROUND for stage in stages):
                types = ", ".join(stage["type"] for stage in stages) or "no heights"
                raise OptionError(
                    f"--ground given needs a model whose heights come from {_GROUND}",
                    found=f"{self.model}: {types}",
                    cure="Leave it out, or take another model",
                )
            stages = preprocessing.with_given_ground(stages)
        if self.bridges:
            stages = [{**s, "ground": True} if s["type"] == _GROUND else s for s in stages]
        return stages, any(stage.get("given_ground") for stage in stages)

    def _corrections(self, keep_ground: bool) -> list[StageJson]:
        """Return the stages after the classifier: towers, bridges, polygons."""
        settled = self._settled
        shared: StageJson = {name: settled[name] for name in ("ignore", "keep") if name in settled}
        kept = split_selection(shared.get("keep", OVERLAP))
        stages: list[StageJson] = []
        keep_more: StageJson = {}
        if keep_ground:
            keep_more["keep"] = [*(kept if isinstance(kept, list) else [kept]), *TERRAIN]
        heights = HEIGHT.name in self.loaded.required_dimensions
        if self.towers and heights and WIRE in self.loaded.codes:
            stages.append({"type": "filters.towers", **shared, **keep_more})
        if self.bridges:
            stages.append({"type": "filters.bridges", **shared, **keep_more})
        if self.polygons:
            polygons = {"type": "filters.polygons", "polygons": list(self.polygons)}
            stages.append({**polygons, **shared})
        return [{**stage, **self._inside} for stage in stages]

    @cached_property
    def creates(self) -> dict[str, str]:
        """The dimensions that the stages create, except classes: name -> PDAL type."""
        created: dict[str, str] = {}
        for stage in self.stages:
            if stage["type"] in preprocessing.HEIGHTS_OF_PDAL:
                created["HeightAboveGround"] = "double"
            elif stage["type"] in stage_types():
                created |= stage_from(overridden(stage, self.overrides)).creates()
        created.pop("Classification", None)
        return created

    @cached_property
    def extra_dims(self) -> dict[str, str]:
        """The dimensions that are written besides the input's own: name -> PDAL type."""
        created = self.creates
        for name in self.dimensions:
            if name not in ("all", "none", *created) and self.dimensions != WRITTEN:
                raise OptionError(
                    "--dimensions names a dimension no stage creates",
                    found=name,
                    cure=f"{suggest(name, list(created))}There are {', '.join(created)}; or all, "
                    "or none",
                )
        every = "all" in self.dimensions
        return {name: kind for name, kind in created.items() if every or name in self.dimensions}

    def writer(self, target: str) -> StageJson:
        """Return the writer of an output; OptionError for files that `classify` does not write."""
        if Path(target).suffix.lower() in (".tif", ".tiff", ".gpkg", ".shp", ".geojson"):
            raise OptionError(
                "classify writes points",
                found=target,
                cure="Name a .laz or .las file. Buildings, trees and more: pdal-stages objects; "
                "rasters: docs/large-areas.md",
            )
        writer = writer_of(target)
        to_las = "type" in writer and writes_las(writer)
        if not to_las and self.dimensions != WRITTEN and "all" not in self.dimensions:
            raise OptionError(
                "--dimensions is for LAS and LAZ; other formats get all dimensions",
                found=target,
                cure="Leave it out, or write a pipeline",
            )
        return writer

    def pipeline(self, source: str, target: str) -> Pipeline:
        """Return the pipeline that classifies one file; everything else in it is kept."""
        stages = [reader_of(source, "input"), *self.stages, self.writer(target)]
        pipeline = Pipeline(stages, self.overrides, may_copy=True)
        for stage, name in zip(
            pipeline.source.stages[:: len(stages) - 1], (source, target), strict=True
        ):
            if os.path.normpath(str(stage.get("filename"))) != os.path.normpath(name):
                raise OptionError(
                    "classify names its files itself",
                    found=f"{stage['type']}.filename={stage.get('filename')}",
                    cure="Give the files as arguments: pdal-stages classify INPUT OUTPUT",
                )
        return pipeline
