"""Run a pipeline: read, override, expand, check, execute; outputs appear whole or not at all."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
from collections import ChainMap, Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numpy.typing import NDArray

from ..base.errors import InterruptedStage, PipelineError, StageError, suggest
from ..base.files import Output, check_outputs, whole_files
from ..base.json_types import JsonObject, StageJson
from ..base.las import refuse_pipe, supersede_copc
from ..base.las_check import check_complete, check_readable
from ..base.las_points import layout_there
from ..base.messages import Message, Report, Topic
from ..base.octrees import check_copc, check_ept
from ..base.text_points import check_text
from ..stages.registry import stage_types
from . import copies, pdal_facts, runtime
from . import pdal as pdal_env
from .expansion import (
    Expanded,
    check_dimensions,
    check_shared_dimensions,
    expand,
    fuse_scripts,
    stage_files,
)
from .inputs_outputs import (
    ept_address,
    is_reader,
    is_writer,
    locations,
    named_files,
    readers_files,
    with_outputs,
    writers_outputs,
    writes_las,
)
from .interrupts import check_interrupt, deferred_interrupts
from .json_source import Override, PipelineSource, apply_overrides, read_pipeline
from .spatial_reference import check_readers


class Pipeline:
    """A PDAL pipeline that may hold stages of ours.

    Parameters
    ----------
    source : str, Path, list, dict or PipelineSource
        A file name, JSON text, the stages themselves, or what :func:`parse_pipeline` made of text.
    overrides : iterable of Override, optional
        Options set from outside (see :mod:`pdal_stages.pipeline.json_source`).
    ready : sequence of ExpandedStage
        Our stages, in order, where an earlier pipeline with the same stages has made them.
    may_copy : bool
        Whether PDAL need not read and write LAS files where it is not needed for them.

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
        ready: Sequence[runtime.ExpandedStage] = (),
        may_copy: bool = False,
    ) -> None:
        read = source if isinstance(source, PipelineSource) else read_pipeline(source)
        overrides = list(overrides)
        # Those by tag may set the type, and may be those of files.
        stages = apply_overrides(read.stages, [o for o in overrides if o.by_tag])
        stages = apply_overrides(pdal_env.with_types(stages, read.where), overrides)
        self.source = PipelineSource(stages, read.lines, read.name)
        #: Whether PDAL takes no part: the output is a copy of the input.
        self.copied = may_copy and self.is_read_here and copies.written_here(stages)
        self.expanded: Expanded = expand(self.source, ready, self.copied)
        self.metadata: JsonObject = {}
        self.arrays: list = []
        self.log_lines: list[str] = []
        self.warnings: list[Message] = []
        self._where: str | None = None
        self._sets_scales = may_copy  #: whether LAS files hold what a text has
        self._unknown: Collection[str] = ()

    @property
    def reports(self) -> list[tuple[str, list[Report]]]:
        """Each of our stages by name, with a report for each view of points of the last run."""
        return [(ours.stage.place, ours.reports) for ours in self.expanded.ours]

    @property
    def point_counts(self) -> dict[str, int]:
        """Counts of the last run (:class:`.messages.Count`) above 0, by ``type.name``.

        They are sums over views, and over stages of one type.
        """
        counts = Counter[str]()
        for ours in self.expanded.ours:
            for name, count in ours.stage.counts().items():
                numbers = [report.counts.get(count, 0) for report in ours.reports]
                counts[f"{ours.stage.type}.{name}"] += sum(numbers)
        return dict(+counts)

    @property
    def messages(self) -> list[Message]:
        """Warnings of the pipeline, then warnings and notes of our stages, each once."""
        places: dict[Message, dict[str, None]] = {}
        for place, reports in self.reports:
            for message in [message for report in reports for message in report.messages]:
                places.setdefault(message, {})[place] = None
        of_stages = [
            message if len(stages) > 1 else replace(message, place=next(iter(stages)))
            for message, stages in places.items()
        ]
        return [*self.warnings, *of_stages]

    @property
    def log_messages(self) -> list[Message]:
        """Warnings and errors of PDAL's log."""
        return [Message(f"PDAL says: {line}") for line in self.log_lines]

    @property
    def json(self) -> str:
        """The expanded pipeline, which stock ``pdal pipeline`` runs."""
        return json.dumps({"pipeline": pdal_env.for_this_version(self.expanded.stages)}, indent=2)

    def validate(self) -> str:
        """Check outputs and all stages, without reading points; return PDAL's verdict as JSON."""
        self.check_outputs()
        self.prepare()
        return json.dumps({"valid": True, "error_detail": "", "streamable": False}, indent=2)

    def prepare(self) -> None:
        """Let PDAL check its own stages' options and dimensions, without reading points."""
        stages = self.expanded.stages
        try:
            self.settle_inputs()
            # Some of PDAL's writers open their file, and empty it, when they are prepared: they
            # get files in a folder of ours.
            with TemporaryDirectory(prefix="pdal-stages-") as folder:
                names = [os.path.basename(output.path) for output in writers_outputs(stages)]
                elsewhere = [
                    os.path.join(folder, f"{number}-{name.replace('#', '0')}")
                    for number, name in enumerate(names)
                ]
                pdal_env.validate(with_outputs(stages, elsewhere))
        except StageError as error:
            raise self._located(error) from None

    def check_outputs(self, *more: Output, read: Iterable[str] = ()) -> None:
        """Refuse outputs that cannot be written, are inputs, or replace files of another kind.

        Parameters
        ----------
        *more : Output
            What the caller will write beside the pipeline's own.
        read : iterable of str
            Files that the caller reads beside the pipeline's own.
        """
        outputs = [output for ours in self.expanded.ours for output in ours.stage.outputs()]
        outputs = [*writers_outputs(self.expanded.stages), *outputs, *more]
        check_outputs(outputs, [*self.inputs(), *read])

    def inputs(self) -> list[str]:
        """Return the local files that stages read, also through tile indexes, and its own file."""
        stages = self.expanded.stages
        files = [*readers_files(stages), *named_files(stages)]
        for stage in stages:
            if stage["type"] == "readers.tindex":
                with contextlib.suppress(StageError):  # PDAL reports it
                    column = stage.get("tindex_name", "location")
                    files += locations(str(stage.get("filename")), column)
        files += [name for ours in self.expanded.ours for name in stage_files(ours.stage)]
        return [*files, *filter(None, [self.source.name])]

    @property
    def is_read_here(self) -> bool:
        """Return whether it reads LAS files that need no PDAL, and all its filters are ours."""
        return copies.read_here(self.source.stages)

    def run_here(
        self,
        columns: Mapping[str, NDArray],
        wkt: str,
        known: Mapping[str, NDArray] | None = None,
        after: Callable[[runtime.ExpandedStage, Mapping[str, NDArray]], None] | None = None,
    ) -> ChainMap[str, NDArray]:
        """Run its stages without PDAL; see :func:`.copies.run_stages`."""
        for ours in self.expanded.ours:
            ours.reports = []
        seen = copies.run_stages(self.expanded.ours, columns, wkt, known, after)
        self.metadata = _named_metadata({"metadata": {}}, self.expanded)
        return seen

    def set_default(self, number: int, **options: Any) -> None:
        """Set options of one of PDAL's stages that the user has not set."""
        for name, value in options.items():
            self.expanded.stages[number].setdefault(name, value)

    def select(self, where: str | None, unknown: Collection[str] = ()) -> None:
        """Mark the points for which a condition holds, before any stage; see :func:`.selection`.

        `unknown` are dimensions that stages create and the input does not have.
        """
        self._where, self._unknown = where, unknown

    def execute(self, *, arrays: bool = True, loglevel: int = logging.WARNING) -> int:
        """Run the pipeline in this process; return the number of points that came out.

        Files are written in hidden folders and renamed at the end, so an output is whole
        or absent, and an older one stays if the run fails.

        Raises
        ------
        StageError
            What went wrong, where, and how to fix it.
        """
        self.settle_inputs()
        self.check_outputs()
        runtime.remember_stdout()
        for ours in self.expanded.ours:
            ours.reports, ours.failure = [], None
        callbacks = runtime.Callbacks()
        plain = self.expanded.stages
        stages = callbacks.check_ground(plain)
        if self._where:
            first = next(n for n, stage in enumerate(stages) if not is_reader(stage))
            stages.insert(first, callbacks.select(self._where, self._unknown))
        writers = list(filter(is_writer, plain))
        alone = len(writers) == 1 and writers[0] is plain[-1]
        try:
            result, final_names = execute_whole(
                fuse_scripts(stages),
                [output.path for output in writers_outputs(plain)],
                self._add_missing_reports,
                counted=alone,
                arrays=arrays,
                loglevel=loglevel,
            )
        except StageError as error:
            called = [runtime.BY_LABEL.get(str(stage.get("module"))) for stage in stages]
            failure = next((held.failure for held in called if held and held.failure), None)
            if isinstance(failure, InterruptedStage):
                raise KeyboardInterrupt from None
            raise failure or self._located(error) from None
        text = json.dumps(result.metadata)
        for name, final in final_names.items():
            text = text.replace(json.dumps(name), json.dumps(final))
        self.metadata = _named_metadata(json.loads(text), self.expanded)
        self.arrays, self.log_lines = result.arrays, pdal_env.log_lines(result.log)
        return result.count

    def _add_missing_reports(self) -> None:
        """Report on no points for our stages that were not called: newer PDAL leaves them out."""
        for ours in self.expanded.ours:
            if not ours.reports:
                ours.reports.append(runtime.run_on_nothing(ours.stage))

    def settle_inputs(self, pdal: bool = True) -> None:
        """Check all inputs, and settle what follows from them: warnings, scales of text in LAS.

        `pdal`: PDAL will read them.
        """
        stages = self.expanded.stages
        for path in readers_files(stages):
            try:
                refuse_pipe(path)
                with open(path, "rb"):
                    pass
            except OSError as error:
                raise PipelineError("the file cannot be read", where=path, found=error) from None
        if stages and not is_reader(stages[0]):  # newer PDAL refuses it, older runs on nothing
            raise PipelineError(
                "the pipeline does not start with a reader",
                found=self.source.stages[0]["type"],
                cure="Put the file that is to be read first",
            )
        check_dimensions(self.expanded)
        files = readers_files(stages, las=True)
        odd = filter(None, map(check_readable, files))
        self.warnings = [*self.expanded.warnings, *(Message(text, Topic.INPUT) for text in odd)]
        read = [(stage, path) for stage in stages for path in readers_files([stage], las=True)]
        layouts = {p: copies.layout_read_by(each, p) for each, p in read if layout_there(p)}
        check_shared_dimensions(self.expanded, layouts)
        if pdal:
            pdal_facts.check_inputs(stages)
            pdal_facts.check_units(stages)
            pdal_facts.check_flags(stages)
        for stage in stages:
            if stage["type"] == "readers.text":
                self._settle_text(stage)
            elif stage["type"] == "readers.ept":
                check_ept(ept_address(str(stage.get("filename", ""))))
            elif stage["type"] == "readers.copc" and pdal_env.knows_copc():
                for path in readers_files([stage], las=True):
                    check_copc(path)
        if units := [ours.stage.horizontal_unit for ours in self.expanded.ours]:
            self.warnings += check_readers(stages, next(filter(None, units), ""))

    def _settle_text(self, reader: StageJson) -> None:
        """Check a text file; let a writer of LAS hold its coordinates, where no option says how."""
        for path in readers_files([reader]):
            held = check_text(path, reader)
            for stage in filter(writes_las, self.expanded.stages if self._sets_scales else ()):
                stage.update({k: v for k, v in held.las_options().items() if k not in stage})

    def _located(self, error: StageError) -> StageError:
        """Return PDAL's error with the line of the stage that it names, and a similar name."""
        text = str(error.found or "")
        named = _STAGE_TYPE.search(text)
        if not isinstance(error, PipelineError) or error.where is not None or named is None:
            return error
        types = [stage["type"] for stage in self.source.stages]
        if types.count(named[0]) == 1 and self.source.lines[types.index(named[0])]:
            error.where = self.source.where(types.index(named[0]))
        if error.cure is None and "Unexpected argument" in text:
            error.cure = f"List its options with: pdal-stages options {named[0]}"
        if error.cure is None and _NO_STAGE.search(text):
            error.found = text.splitlines()[0]
            theirs = [driver["name"] for driver in pdal_env.drivers()]
            near = suggest(named[0], [*stage_types(), *theirs])
            error.cure = f"{near}List the stages there are with: pdal-stages drivers"
        return error


def execute_whole(
    stages: list[StageJson],
    outputs: Sequence[str],
    check: Callable[[], None],
    *,
    counted: bool = True,
    **options: Any,
) -> tuple[pdal_env.Execution, dict[str, str]]:
    """Run plain stages in this process; their outputs appear whole or not at all.

    Parameters
    ----------
    stages : list of dict
    outputs : sequence of str
        The final names of the files, in the order of their writers.
    check : callable
        Called when all is written, before any output gets its name; it may refuse.
    counted : bool
        Whether each file must hold all points that come out, but for a writer with a `where`.
    **options
        Those of :func:`.pdal.execute`.

    Returns
    -------
    Execution, dict
        The result, and final names by the paths that PDAL wrote to.
    """
    writers = list(filter(is_writer, stages))

    def finish(partial: Path, final: Path, number: int) -> None:
        every = counted and "where" not in writers[number] and "#" not in outputs[number]
        check_complete(partial, final, writers[number], result.count if every else None)
        supersede_copc(partial)

    with whole_files(*outputs, check=finish) as partials:
        run = with_outputs(stages, list(partials))
        with deferred_interrupts():
            result = pdal_env.execute(run, **options)
            check_interrupt()
        check()
    return result, {str(path): final for path, final in zip(partials, outputs, strict=True)}


def run_pipeline(source: str | Path | list | dict, overrides: Iterable[Override] = ()) -> Pipeline:
    """Build, run and return a pipeline."""
    pipeline = Pipeline(source, overrides)
    pipeline.execute()
    return pipeline


_STAGE_TYPE = re.compile(r"\b(?:readers|filters|writers)\.\w+")
_NO_STAGE = re.compile(r"Couldn't create (?:reader|filter|writer) stage")


def _named_metadata(metadata: JsonObject, expanded: Expanded) -> JsonObject:
    """Return PDAL's metadata, with our stages under their own names, not filters.python."""
    inner = metadata.get("metadata")
    if not isinstance(inner, dict):
        return metadata
    ours = stage_types()
    scripts = filter(None, _as_list(inner.pop("filters.python", None)))
    entries = [
        ("filters.python", script)
        for script in scripts
        if not (isinstance(script, dict) and any(name in ours for name in script))
    ]
    entries += [(o.stage.type, report.to_dict()) for o in expanded.ours for report in o.reports]
    for kind, node in entries:
        inner[kind] = [*_as_list(inner[kind]), node] if kind in inner else node
    return metadata


def _as_list(node: object) -> list[object]:
    return node if isinstance(node, list) else [node]
