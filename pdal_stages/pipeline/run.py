"""Run a pipeline: read, override, validate, expand, execute, report; outputs whole or not at
all.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ..base.errors import InterruptedStage, PipelineError, StageError, suggest
from ..base.files import Output, check_outputs, whole_files
from ..base.las import refuse_pipe
from ..base.las_check import check_complete, check_readable
from ..base.report import Report
from ..stages.registry import stage_types
from . import las_output, runtime
from . import pdal as pdal_env
from .expansion import Expanded, check_dimensions, expand, merge_filters
from .inputs_outputs import check_octrees, locations, stage_files
from .json_source import PipelineSource, read_pipeline
from .overrides import Override, apply_overrides
from .spatial_reference import check_readers, plane_unit
from .stage_files import (
    is_reader,
    is_writer,
    named_files,
    readers_files,
    with_outputs,
    writers_outputs,
)


class Pipeline:
    """A PDAL pipeline that may hold stages of ours.

    Parameters
    ----------
    source : str, Path, list, dict or PipelineSource
        A file name, JSON text, the stages themselves, or what :func:`parse_pipeline` made of text.
    overrides : iterable of Override, optional
        Options set from outside (see :mod:`pdal_stages.pipeline.json_source`).
    whole : bool
        False: only to be run in tiles.

    Raises
    ------
    PipelineError, OptionError
        Everything about our stages that can be checked before reading points.

    Examples
    --------
    >>> import pdal_stages as ps
    >>> pipeline = ps.Pipeline(["in.laz", {"type": "filters.hag_minima"}, "out.laz"])
    >>> pipeline.execute()                                          # doctest: +SKIP
    1065
    """

    def __init__(
        self,
        source: str | Path | list | dict | PipelineSource,
        overrides: Iterable[Override] = (),
        *,
        whole: bool = True,
    ) -> None:
        read = source if isinstance(source, PipelineSource) else read_pipeline(source)
        overrides = list(overrides)
        named = apply_overrides(
            read.stages, [one for one in overrides if one.by_tag]
        )  # of files, too
        stages = apply_overrides(pdal_env.typed(named, read.where), overrides)
        self.source = PipelineSource(stages, read.lines, read.name)
        self.expanded: Expanded = expand(self.source, whole)
        self.metadata: dict[str, Any] = {}
        self.arrays: list = []
        self.log_lines: list[str] = []
        self.warnings: list[str] = []

    @property
    def reports(self) -> list[tuple[str, list[Report]]]:
        """Of the last run: each of our stages by name, with a report for each view of points."""
        return [(ours.stage.place, ours.reports) for ours in self.expanded.ours]

    @property
    def left_alone(self) -> dict[str, int]:
        """Points that stages of the last run counted (:attr:`Stage.counts`): ``type.name`` ->
        number above 0.
        """
        return {
            f"{ours.stage.type}.{name}": number
            for ours in self.expanded.ours
            for name in ours.stage.counts
            if ours.reports and (number := ours.reports[-1].figures.get(name, 0))
        }

    @property
    def messages(self) -> list[str]:
        """Warnings of the pipeline, then warnings and notes of our stages; what several stages
        report comes once.
        """
        places: dict[str, dict[str, None]] = {}
        for place, reports in self.reports:
            for text in [text for report in reports for text in report.messages]:
                places.setdefault(text, {})[place] = None
        of_stages = [
            text if len(said) > 1 else f"{next(iter(said))}: {text}"
            for text, said in places.items()
        ]
        return [*self.warnings, *of_stages]

    @property
    def json(self) -> str:
        """The expanded pipeline, which stock ``pdal pipeline`` runs."""
        return json.dumps({"pipeline": pdal_env.adapted(self.expanded.stages)}, indent=2)

    def validate(self) -> str:
        """Check outputs and let PDAL check its own stages' options, without reading points; PDAL's
        answer, as JSON.
        """
        self.check_outputs()
        self.prepare()
        return json.dumps({"valid": True, "error_detail": "", "streamable": False}, indent=2)

    def prepare(self) -> None:
        """Let PDAL check its own stages' options and dimensions, without reading points; outputs
        are not looked at.
        """
        stages = self.expanded.stages
        try:
            self._check_inputs()
            # Some of PDAL's writers open their file, and empty it, when they are prepared: theirs
            # are in a folder of ours.
            with TemporaryDirectory(prefix="pdal-stages-") as folder:
                names = [
                    os.path.basename(one.path).replace("#", "0") for one in writers_outputs(stages)
                ]
                elsewhere = [os.path.join(folder, f"{n}-{name}") for n, name in enumerate(names)]
                pdal_env.validate(with_outputs(stages, elsewhere))
        except StageError as error:
            raise self._located(error) from None

    def check_outputs(self, *more: Output, read: Iterable[str] = ()) -> None:
        """Refuse outputs that cannot be written, that are inputs, or that replace files of another
        kind.

        Parameters
        ----------
        *more : Output
            What the caller will write beside the pipeline's own.
        read : iterable of str
            Files that the caller reads beside the pipeline's own.
        """
        own = [output for ours in self.expanded.ours for output in ours.stage.outputs()]
        check_outputs(
            [*writers_outputs(self.expanded.stages), *own, *more], [*self.inputs(), *read]
        )

    def inputs(self) -> list[str]:
        """Local files that are read: by readers, also through tile indexes, by other stages, and
        the pipeline itself.
        """
        stages = self.expanded.stages
        indexed: list[str] = []
        for one in stages:
            if one["type"] == "readers.tindex":
                with contextlib.suppress(StageError):  # PDAL reports it
                    indexed += locations(
                        str(one.get("filename")), one.get("tindex_name", "location")
                    )
        named = [name for ours in self.expanded.ours for name in stage_files(ours.stage)]
        return [
            *readers_files(stages),
            *indexed,
            *named_files(stages),
            *named,
            *filter(None, [self.source.name]),
        ]

    def __or__(self, other: Any) -> Pipeline:
        """The pipeline with more stages: objects of python-pdal, ours or PDAL's, or another
        pipeline's.
        """
        stages = other.source.stages if isinstance(other, Pipeline) else pdal_env.stages_of(other)
        if stages is None:
            return NotImplemented
        lines = [*self.source.lines, *(0 for _ in stages)]
        return Pipeline(PipelineSource([*self.source.stages, *stages], lines, self.source.name))

    def __ror__(self, other: Any) -> Pipeline:
        """Stages before the pipeline: objects of ours; PDAL's own raise before they ask."""
        stages = pdal_env.stages_of(other)
        return NotImplemented if stages is None else Pipeline(stages) | self

    def execute(self, *, arrays: bool = True, loglevel: int = logging.WARNING) -> int:
        """Run the pipeline in this process; the number of points that came out.

        Files are written in hidden folders and renamed at the end, so an output is whole
        or absent, and an older one stays if the run fails.

        Raises
        ------
        StageError
            What went wrong, where, and how to fix it.
        """
        self._check_inputs()
        self.check_outputs()
        stages = self.expanded.stages
        outputs = [output.path for output in writers_outputs(stages)]
        sources = readers_files(stages, las=True)
        writers = list(filter(is_writer, stages))
        alone = len(writers) == 1 and writers[0] is stages[-1] and "where" not in writers[0]

        def finish(made: Path, final: Path, number: int) -> None:
            count = result.count if alone and "#" not in outputs[0] else None
            check_complete(made, final, writers[number], count)
            las_output.finish(made, sources, plane_unit(stages, result.metadata))

        runtime.remember_stdout()
        for ours in self.expanded.ours:
            ours.reports, ours.failure = [], None
        callbacks = runtime.Callbacks()
        run = callbacks.check_ground(stages)
        try:
            with whole_files(*outputs, check=finish) as partials:
                run = with_outputs(run, list(partials))
                for number, stage in enumerate(run):
                    if is_writer(stage):
                        run[number] = las_output.uncompressed_writer(stage, run[:number])
                with pdal_env.gentle():
                    result = pdal_env.execute(merge_filters(run), arrays=arrays, loglevel=loglevel)
                    pdal_env.check_interrupt()
                compressed = las_output.compress(partials)
                for ours in self.expanded.ours:
                    if not ours.reports:  # newer PDAL leaves filters out where there are no points
                        ours.reports.append(runtime.run_on_nothing(ours.stage))
        except StageError as error:
            called = [runtime.made.get(str(stage.get("module"))) for stage in run]
            failure = next((one.failure for one in called if one and one.failure), None)
            if isinstance(failure, InterruptedStage):
                raise KeyboardInterrupt from None
            raise failure or self._located(error) from None
        names = {str(made): final for made, final in zip(partials, outputs, strict=True)}
        names |= {made: names.get(target, target) for made, target in compressed.items()}
        self.metadata = _renamed(_named_metadata(result.metadata, self.expanded), names)
        self.arrays, self.log_lines = result.arrays, pdal_env.log_lines(result.log)
        return result.count

    def _check_inputs(self) -> None:
        """Open all inputs and check the headers of LAS files: PDAL reads damaged ones as if whole,
        or crashes.
        """
        for path in readers_files(self.expanded.stages):
            try:
                refuse_pipe(path)
                with open(path, "rb"):
                    pass
            except OSError as error:
                raise PipelineError("the file cannot be read", where=path, found=error) from None
        stages = self.expanded.stages
        if stages and not is_reader(
            stages[0]
        ):  # newer PDAL refuses it, older PDAL runs it on nothing
            ours = {one.index: one.stage.type for one in self.expanded.ours}
            found = ours.get(0, stages[0]["type"])
            cure = "Put the file that is to be read first"
            raise PipelineError("the pipeline does not start with a reader", found=found, cure=cure)
        check_dimensions(self.expanded)
        odd = (check_readable(path) for path in readers_files(self.expanded.stages, las=True))
        self.warnings = [*self.expanded.warnings, *filter(None, odd)]
        check_octrees(self.expanded.stages)
        creates = {name for ours in self.expanded.ours for name in ours.stage.creates()}
        put_back = " ".join(str(s["dimensions"]) for s in stages if s["type"] == "filters.ferry")
        creates = {name for name in creates if f"=>{name}" not in put_back}
        self.warnings += las_output.replaced(readers_files(stages, las=True), creates)
        units = [ours.stage.horizontal_unit for ours in self.expanded.ours]
        if units:
            self.warnings += check_readers(self.expanded.stages, next(filter(None, units), ""))

    def _located(self, error: StageError) -> StageError:
        """PDAL's error, with the line of the stage that it names and the most similar stage
        name.
        """
        if not isinstance(error, PipelineError) or error.where is not None:
            return error
        found = str(error.found or "")
        if (named := _STAGE_TYPE.search(found)) is None:
            return error
        given = [stage["type"] for stage in self.source.stages]
        if given.count(named[0]) == 1 and self.source.lines[given.index(named[0])]:
            error.where = self.source.where(given.index(named[0]))
        if error.cure is None and "Unexpected argument" in found:
            error.cure = f"List its options with: pdal-stages options {named[0]}"
        if error.cure is None and _NO_STAGE.search(found):
            error.found = found.splitlines()[0]
            theirs = [
                one["name"] for one in json.loads(pdal_env.ask_program("--drivers", "--showjson"))
            ]
            near = suggest(named[0], [*stage_types(), *theirs])
            error.cure = f"{near}List the stages there are with: pdal-stages drivers"
        return error


def run_pipeline(source: str | Path | list | dict, overrides: Iterable[Override] = ()) -> Pipeline:
    """Build, run and return a pipeline."""
    pipeline = Pipeline(source, overrides)
    pipeline.execute()
    return pipeline


_STAGE_TYPE = re.compile(r"\b(?:readers|filters|writers)\.\w+")
_NO_STAGE = re.compile(r"Couldn't create (?:reader|filter|writer) stage")


def _named_metadata(metadata: dict[str, Any], expanded: Expanded) -> dict[str, Any]:
    """PDAL's metadata, with our stages under their own names instead of filters.python."""
    inner = metadata.get("metadata")
    if not isinstance(inner, dict):
        return metadata
    scripts = filter(None, _several(inner.pop("filters.python", None)))
    theirs = [
        s for s in scripts if not (isinstance(s, dict) and any(name in stage_types() for name in s))
    ]
    named = [
        (ours.stage.type, report.to_dict()) for ours in expanded.ours for report in ours.reports
    ]
    for kind, node in [*(("filters.python", node) for node in theirs), *named]:
        inner[kind] = [*_several(inner[kind]), node] if kind in inner else node
    return metadata


def _several(node: Any) -> list[Any]:
    return node if isinstance(node, list) else [node]


def _renamed(node: Any, names: Mapping[str, str]) -> Any:
    """Metadata with the final names of files."""
    if isinstance(node, dict):
        return {key: _renamed(value, names) for key, value in node.items()}
    if isinstance(node, list):
        return [_renamed(value, names) for value in node]
    return names.get(node, node) if isinstance(node, str) else node
