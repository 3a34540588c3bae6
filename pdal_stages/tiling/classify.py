"""Classify a file or a survey: in one piece where it fits into memory, else in seamless tiles."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from ..base import las
from ..base.errors import DimensionError, OptionError
from ..base.files import Output, check_outputs, create_folder
from ..base.las_points import layout_there
from ..pipeline.classify_file import classify_file
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_folder, is_las, outputs_of
from ..pipeline.pdal import knows_copc, writer_of
from ..stages.where_expression import Expression
from .inputs import InputSource, one_format
from .jobs import OutputJob, TiledRun, WritingJob
from .options import TilingOptions, fits_whole
from .records import OutputRecord


@dataclass(frozen=True)
class ClassifyTask:
    """Inputs, output and settings of a classification."""

    inputs: tuple[str, ...]  #: files, folders, patterns, tile indexes
    output: str  #: a file; of several inputs a folder, or a name with ``#`` for the input's
    request: ClassifyRequest = field(default_factory=ClassifyRequest)
    options: TilingOptions = field(default_factory=TilingOptions)
    extra_files: tuple[Output, ...] = ()  #: files that the caller writes

    @cached_property
    def files(self) -> list[str]:
        """Return all inputs."""
        return input_files(self.inputs)

    @cached_property
    def in_one_piece(self) -> bool:
        """Return whether one input fits into memory, and no option asks for tiles."""
        options = self.options
        tiles = options.tile is not None or options.per != "file"
        if len(self.files) > 1 or tiles or options.scheduler or options.resume:
            return False
        if not is_las(self.files[0]):
            return True
        header = las.header_there(self.files[0])
        return header is None or fits_whole(header.count, options.memory)

    @property
    def _per_tile(self) -> bool:
        return self.options.per == "tile"

    @cached_property
    def outputs(self) -> list[str]:
        """Return an output file for each input; empty where each tile is an output."""
        if self._per_tile:
            return []
        target = str(Path(self.output) / "#") if is_folder(self.output) else self.output
        return outputs_of(self.files, target, copc=self.in_one_piece and knows_copc())

    @contextmanager
    def folders(self) -> Iterator[None]:
        """Create the output folders; remove those that are still empty at the end."""
        created: list[Path] = []
        names = [f"{self.output}/#", *self.outputs] if is_folder(self.output) else []
        try:
            for folder in sorted({folder for name in names for folder in Path(name).parents}):
                if not folder.is_dir():
                    create_folder(folder, "the output")
                    created.append(folder)
            yield
        finally:
            for folder in reversed(created):
                with suppress(OSError):
                    folder.rmdir()

    def run_whole(self, *, dry_run: bool = False) -> TiledRun:
        """Classify the only input in one piece; a run without tiles, with PDAL's metadata."""
        (source,), (target,) = self.files, self.outputs
        header = las.header_there(source) if is_las(source) else None
        summary = {
            "pipeline": self.request.model,
            "models": [self.request.model],
            "started": time.strftime("%Y-%m-%d %H:%M"),
            "per": "file",
            "inputs": 1,
            "bounds": list(header.box) if header and header.count else None,
        }
        output = OutputJob(source, source=InputSource(source, {}), outputs=[target])
        if dry_run:
            self.request.pipeline(source, target)
            check_outputs(self.extra_files, self.inputs)
            summary |= {"points": header.count if header else 0, "states": {"waiting": 0}}
            return TiledRun([], [output], {}, [], [], summary)
        seconds, cpu_seconds = time.perf_counter(), time.process_time()
        with self.folders():
            pipeline = self.request.pipeline(source, target)
            pipeline.check_outputs(*self.extra_files, read=self.inputs)
            count, messages = classify_file(pipeline, self.request, source)
        reports = [each[-1] for _, each in pipeline.reports if each]
        classes = [report.codes for report in reports if report.codes is not None][-1:]
        output.state = "done"
        output.record = OutputRecord([], count, classes[0] if classes else {})
        seconds = time.perf_counter() - seconds
        summary |= {
            "points": count,
            "seconds": seconds,
            "points_per_second": count / seconds if seconds else 0.0,
            "cpu_seconds": time.process_time() - cpu_seconds,
            "states": {},
            "classes": output.record.classes,
            "point_counts": pipeline.point_counts,
        }
        texts = [*map(str, messages)]
        return TiledRun([], [output], {}, [], texts, summary, metadata=pipeline.metadata)

    def run_tiles(
        self, *, dry_run: bool = False, finished: Callable[[WritingJob], None] | None = None
    ) -> TiledRun:
        """Classify all inputs in tiles; call `finished` with every output that was written."""
        from .plan import plan_of_files
        from .tiled_run import run_plan

        if odd := [name for name in self.files if not is_las(name)]:
            raise OptionError(
                "several inputs, and the options of tiles, need LAS, LAZ or COPC, which can be cut "
                "into tiles",
                found=odd[0],
                cure="Convert them first (pdal translate INPUT input.laz, of EPT a part with "
                "--readers.ept.bounds), or classify them one at a time without tile options",
            )
        self._refuse_other_dimensions()
        target = named = self.output
        if is_folder(target) or Path(target).name == "#":
            folder = Path(target) if is_folder(target) else Path(target).parent
            target, named = str(folder / ("#.laz" if self._per_tile else "#")), "x.laz"
        if las.named_copc(target):
            raise OptionError(
                "runs in tiles write plain LAS or LAZ",
                found=target,
                cure="Name them .laz and convert them afterwards, pdal translate o.laz o.copc.laz",
            )
        alike = one_format(self.files) if self._per_tile else {}
        writer = {**writer_of(named), "filename": target, **alike}
        stages = [*self.request.stages, writer]
        plan, pipeline = plan_of_files(
            self.files, stages, self.request.overrides, self.options.buffer
        )
        extra_dims = self.request.extra_dims
        plan = replace(
            plan,
            creates=["Classification", *extra_dims]
            if len(plan.per_output) == 1 and plan.creates
            else plan.creates,
            makes=extra_dims,
            extra_dims=extra_dims,
            where=self.request.where,
            name=self.request.model,
        )
        with nullcontext() if dry_run else self.folders():
            outputs = [Output(name) for name in self.outputs if Path(name).parent.is_dir()]
            read = [*self.inputs, *self.files, *pipeline.inputs()]
            check_outputs([*outputs, *self.extra_files], read)
            return run_plan(
                plan, self.options, dry_run=dry_run, finished=finished, pipeline=pipeline
            )

    def _refuse_other_dimensions(self) -> None:
        """Refuse a `where` that names a dimension which an input does not have."""
        if not self.request.where:
            return
        condition = Expression(self.request.where)
        for path in self.files:
            if layout := layout_there(path):
                try:
                    condition.check(layout.fields.keys())
                except DimensionError as error:
                    raise error.at(path) from None
