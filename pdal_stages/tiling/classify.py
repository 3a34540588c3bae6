"""A survey, or a file, classified: in one piece where it fits, otherwise in seamless tiles."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..base import kinds, las
from ..base.errors import OptionError, StageError
from ..base.files import write_whole
from ..base.outputs import Output, check_outputs
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_ept, is_folder, is_las, outputs_of
from ..pipeline.run import Pipeline
from ..pipeline.workers import each_file
from .oneformat import one_format
from .outcome import FileJob, TiledRun, TileJob, left_alone
from .settings import TilingOptions
from .sizing import fits_whole
from .tiledrun import run_plan
from .tileplan import TilePlan, make_plan


@dataclass
class Written:
    """An output that was written."""

    path: str
    points: int
    classes: dict[int, int]  #: number of points by code
    counts: dict[str, int] = field(default_factory=dict)  #: of points that got no class, by reason
    messages: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)  #: PDAL's


@dataclass(frozen=True)
class ClassifyTask:
    """What is to be classified, how, and where to.

    Attributes
    ----------
    inputs : tuple of str
        Files, folders, patterns, tile indexes, EPT sources.
    output : str
        A file; of several inputs a folder, or a name with ``#`` for the input's.
    request : ClassifyRequest
    options : TilingOptions
    metadata, log : str
        Files that are written beside, empty for none.
    """

    inputs: tuple[str, ...]
    output: str
    request: ClassifyRequest = field(default_factory=ClassifyRequest)
    options: TilingOptions = field(default_factory=TilingOptions)
    metadata: str = ""
    log: str = ""

    @cached_property
    def files(self) -> list[str]:
        """All inputs."""
        return input_files(self.inputs)

    @property
    def can_be_cut(self) -> bool:
        """Whether parts of all inputs can be read."""
        return all(is_las(name) or is_ept(name) for name in self.files)

    def in_one_piece(self) -> bool:
        """Whether the only input is a file that fits into memory, and nothing asks for tiles."""
        asked = self.options.tile is not None or self.options.per != "auto" or self.options.scheduler
        if len(self.files) > 1 or asked or self.options.resume:
            return False
        if not is_las(self.files[0]):
            return not is_ept(self.files[0])
        try:
            header = las.read_header(self.files[0])
        except OSError:
            header = None  # said when it is read
        return header is None or fits_whole(header.count, self.options.memory)

    # ---- in one piece ------------------------------------------------------------------------------------

    def outputs(self) -> list[str]:
        """An output for each input.

        Raises
        ------
        StageError
            If one cannot be written, or is an input.
        """
        outputs = outputs_of(self.files, self.output)
        self._make_folders(outputs)
        check_outputs([Output(name) for name in outputs], self.files)
        return outputs

    def _make_folders(self, outputs: list[str]) -> None:
        """Make the output folder, and those in it that outputs lie in."""
        if not self._in_folder:
            return
        for folder in sorted({Path(self.output), *(Path(name).parent for name in outputs)}):
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise StageError(
                    "the output folder cannot be made", found=f"{folder}: {error.strerror}"
                ) from None

    def run_whole(self) -> Written:
        """Classify the only input in one piece."""
        (source,), (target,) = self.files, self.outputs()
        return classify_file(replace(self.request), source, target, self.metadata, self.log)

    def run_each(self, apart: bool = False) -> Iterator[tuple[str, Written | str]]:
        """Classify inputs each by itself: yields an input, and what was written or why it failed, as they finish.

        `apart`: in processes of their own, so that one may crash, and Ctrl-C is heard here.
        """
        outputs = self.outputs()
        work = [(replace(self.request), *pair, "", "") for pair in zip(self.files, outputs, strict=True)]
        workers = max(1, self.options.local_workers)
        for (_, source, *_), answer in each_file(classify_file, work, workers, apart=apart):
            yield source, answer.reason or answer.result

    # ---- in tiles ----------------------------------------------------------------------------------------

    @cached_property
    def _pipeline(self) -> Pipeline:
        """What is done, of one input of each kind."""
        readers = {("readers.ept" if is_ept(name) else "readers.las"): name for name in reversed(self.files)}
        heads: list[dict[str, Any]] = [
            {"type": kind, "filename": name, "tag": "input"} for kind, name in readers.items()
        ]
        for head in heads:
            if head["type"] == "readers.las":  # of LAS 1.0-1.3 PDAL leaves extra dimensions out unless told
                head["use_eb_vlr"] = True
        target = self._target()
        if target.lower().endswith(".copc.laz"):
            raise OptionError(
                "outputs of tiles are plain LAS or LAZ",
                found=target,
                cure="Name them .laz and convert them afterwards, pdal translate o.laz o.copc.laz. Tiles are for "
                "several inputs, clouds too large for the memory, --tile, --per, --resume and --report",
            )
        # In a folder '#' may stand for a name with its suffix: always that of a LAS file.
        named = "x.laz" if self._in_folder else target
        per_tile = self.options.per == "tile" or any(map(is_ept, self.files))
        alike = one_format(self.files) if per_tile else {}
        writer = {**self.request.writer(named), "filename": target, **alike}
        return Pipeline([*heads, *self.request.stages, writer], self.request.overrides, whole=False)

    def plan(self) -> TilePlan:
        """What is done to each tile.

        Raises
        ------
        StageError
            For whatever is wrong with model or options, before any point is read.
        """
        pipeline = self._pipeline
        plan = make_plan(pipeline, self.options.buffer)
        beside = self.request.beside
        tail_only = len(plan.tail) == 1 and beside is not None
        kinds_of_readers = {reader["type"] for reader in plan.readers}
        files = {
            kind: [n for n in self.files if is_ept(n) == (kind == "readers.ept")] for kind in kinds_of_readers
        }
        return replace(
            plan,
            readers=[{**reader, "filename": files[reader["type"]]} for reader in plan.readers],
            creates=["Classification", *(beside or {})] if tail_only and plan.creates else plan.creates,
            makes=plan.makes if beside is None else beside,
            beside=beside,
            whole_names=self._in_folder and self.options.per != "tile",
            name=self.request.model,
        )

    @property
    def _in_folder(self) -> bool:
        return is_folder(self.output)

    def _target(self) -> str:
        """The output with '#' where the input's name goes, or the tile's."""
        if not self._in_folder:
            return self.output
        tiles = self.options.per == "tile" or any(map(is_ept, self.files))
        return str(Path(self.output) / ("#.laz" if tiles else "#"))

    def run_tiles(
        self,
        *,
        dry_run: bool = False,
        finished: Callable[[Written], None] | None = None,
    ) -> TiledRun:
        """Classify all inputs in tiles; `finished` hears of every output that was written."""
        outputs: list[str] = []
        if self.options.per != "tile" and not any(map(is_ept, self.files)):
            outputs = outputs_of(self.files, self.output)  # which says what is wrong with names
        plan = self.plan()
        if not dry_run:
            self._make_folders(outputs)
        more = [("metadata", self.metadata, kinds.JSON), ("log", self.log, "")]
        check_outputs([Output(name, what, kind) for what, name, kind in more if name], self.files)

        def finished_one(job: TileJob | FileJob) -> None:
            if finished is not None:
                for path in (job.outputs or [])[:1]:
                    classes = {int(code): n for code, n in job.record.get("classes", {}).items()}
                    finished(Written(path, job.record.get("written", 0), classes))

        return run_plan(
            plan,
            self.options,
            dry_run=dry_run,
            finished=finished_one,
            source=self._pipeline.source,
        )


def classify_file(
    request: ClassifyRequest,
    source: str,
    target: str,
    metadata: str = "",
    log: str = "",
) -> Written:
    """Classify a file in one piece; `metadata` and `log` are files that are written beside."""
    pipeline = request.pipeline(source, target)
    more = [("log", log, ""), ("metadata", metadata, kinds.JSON)]
    pipeline.check_outputs(*(Output(name, what, kind) for what, name, kind in more if name))
    count = pipeline.execute(arrays=False, loglevel=logging.WARNING)
    if metadata:
        write_whole(metadata, (json.dumps(pipeline.metadata, indent=2, default=str) + "\n").encode())
    reports = [each[-1].figures for _, each in pipeline.reports if each]
    after = [each[-1].codes for _, each in pipeline.reports if each and each[-1].codes is not None]
    classes = {int(code): n for code, n in after[-1].items()} if after and after[-1] else {}
    counts = left_alone(reports)
    messages = [*(f"PDAL says: {line}" for line in pipeline.log_lines), *pipeline.messages]
    return Written(target, count, classes, counts, messages, pipeline.metadata)
