"""A survey, or a file, classified: in one piece where it fits, otherwise in seamless tiles."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..base import las
from ..base.errors import OptionError, StageError
from ..base.files import write_whole
from ..base.outputs import JSON, Output, check_outputs
from ..pipeline.classify_request import ClassifyRequest
from ..pipeline.inputs_outputs import input_files, is_ept, is_folder, is_las, outputs_of
from ..pipeline.run import Pipeline
from .inputs import ept_format, read_ept
from .plan import TilePlan, make_plan
from .report import Job, TiledRun, left_alone
from .run import run_plan
from .settings import TilingOptions, fits_whole


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

    def in_one_piece(self) -> bool:
        """Whether the only input is a file that fits into memory, and nothing asks for tiles."""
        options = self.options
        asked = options.tile is not None or options.per != "auto" or options.scheduler or options.resume
        if len(self.files) > 1 or asked:
            return False
        if not is_las(self.files[0]):
            return not is_ept(self.files[0])
        try:
            header = las.read_header(self.files[0])
        except OSError:
            header = None  # said when it is read
        return header is None or fits_whole(header.count, options.memory)

    def _make_folders(self, outputs: list[str]) -> None:
        """Make the output folder, and those in it that outputs lie in."""
        if not is_folder(self.output):
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
        (source,), (target,) = self.files, outputs_of(self.files, self.output)
        self._make_folders([target])
        return classify_file(self.request, source, target, self.metadata, self.log)

    # ---- in tiles ----------------------------------------------------------------------------------------

    @property
    def _per_tile(self) -> bool:
        return self.options.per == "tile" or any(map(is_ept, self.files))

    @cached_property
    def _pipeline(self) -> Pipeline:
        """What is done, of one input of each kind."""
        heads: list[dict[str, Any]] = []
        for kind, more in (("readers.las", {"use_eb_vlr": True}), ("readers.ept", {})):
            # Of LAS 1.0-1.3 PDAL leaves extra dimensions out unless told.
            if names := [name for name in self.files if is_ept(name) == (kind == "readers.ept")]:
                heads.append({"type": kind, "filename": names[0], "tag": "input", **more})
        target = named = self.output
        if is_folder(self.output):  # '#' may stand for a name with its suffix: always that of a LAS file
            target = str(Path(self.output) / ("#.laz" if self._per_tile else "#"))
            named = "x.laz"
        if target.lower().endswith(".copc.laz"):
            raise OptionError(
                "outputs of tiles are plain LAS or LAZ",
                found=target,
                cure="Name them .laz and convert them afterwards, pdal translate o.laz o.copc.laz. Tiles are for "
                "several inputs, clouds too large for the memory, --tile, --per, --resume and --report",
            )
        alike = one_format(self.files) if self._per_tile else {}
        writer = {**self.request.writer(named), "filename": target, **alike}
        return Pipeline([*heads, *self.request.stages, writer], self.request.overrides, whole=False)

    def plan(self) -> TilePlan:
        """What is done to each tile.

        Raises
        ------
        StageError
            For whatever is wrong with model or options, before any point is read.
        """
        plan = make_plan(self._pipeline, self.options.buffer)
        beside = self.request.beside
        for reader in plan.readers:
            reader["filename"] = [n for n in self.files if is_ept(n) == (reader["type"] == "readers.ept")]
        return replace(
            plan,
            creates=["Classification", *beside] if len(plan.tail) == 1 and plan.creates else plan.creates,
            makes=beside,
            beside=beside,
            whole_names=is_folder(self.output) and self.options.per != "tile",
            name=self.request.model,
        )

    def run_tiles(
        self,
        *,
        dry_run: bool = False,
        finished: Callable[[Written], None] | None = None,
    ) -> TiledRun:
        """Classify all inputs in tiles; `finished` hears of every output that was written."""
        outputs = (
            [] if self._per_tile else outputs_of(self.files, self.output)
        )  # says what is wrong with names
        plan = self.plan()
        if not dry_run:
            self._make_folders(outputs)
        more = [("metadata", self.metadata, JSON), ("log", self.log, "")]
        check_outputs([Output(name, what, kind) for what, name, kind in more if name], self.files)

        def finished_one(job: Job) -> None:
            if finished is not None and job.outputs:
                classes = {int(code): n for code, n in job.record.get("classes", {}).items()}
                finished(Written(job.outputs[0], job.record.get("written", 0), classes))

        source = self._pipeline.source
        return run_plan(plan, self.options, dry_run=dry_run, finished=finished_one, source=source)


def one_format(paths: Sequence[str]) -> dict[str, Any]:
    """Options of ``writers.las`` that hold what each of some inputs holds; none where these are alike LAS files.

    The finest scale along each axis, and of the formats from LAS 1.4 the first that has all colors there are: PDAL forwards
    only what all inputs of a tile share, and has scales of a centimeter and point format 3 for the rest. What cannot be
    read is said when it is.
    """
    formats: set[int] = set()
    places: set[tuple[float, ...]] = set()
    for path in paths:
        try:
            if is_ept(path):
                described = read_ept(path)
                axes = {one["name"]: one for one in described["schema"]}
                formats.add(ept_format(described))
                found = [axes.get(axis, {}).get(name) for name in ("scale", "offset") for axis in "XYZ"]
                places.add(tuple(float(v or (0.001, 0.0)[n > 2]) for n, v in enumerate(found)))
            elif is_las(path) and (header := las.read_header(path)) and header.count:
                formats.add(header.point_format)
                places.add((*header.scales, *header.offsets))
        except (OSError, StageError, ValueError, TypeError):
            continue
    options: dict[str, Any] = {}
    if len(formats) > 1 or any(map(is_ept, paths)):
        colored = 8 if 8 in formats else 7 if formats & {2, 3, 7} else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    for axis, name in enumerate("xyz"):
        if len({(place[axis], place[3 + axis]) for place in places}) > 1:
            options |= {f"scale_{name}": min(place[axis] for place in places), f"offset_{name}": "auto"}
    return options


def classify_file(
    request: ClassifyRequest, source: str, target: str, metadata: str = "", log: str = ""
) -> Written:
    """Classify a file in one piece; `metadata` and `log` are files that are written beside."""
    pipeline = request.pipeline(source, target)
    more = [("log", log, ""), ("metadata", metadata, JSON)]
    pipeline.check_outputs(*(Output(name, what, kind) for what, name, kind in more if name))
    count = pipeline.execute(arrays=False, loglevel=logging.WARNING)
    if metadata:
        write_whole(metadata, (json.dumps(pipeline.metadata, indent=2, default=str) + "\n").encode())
    reports = [each[-1] for _, each in pipeline.reports if each]
    codes = [report.codes for report in reports if report.codes is not None]
    classes = {int(code): n for code, n in (codes[-1] if codes else {}).items()}
    messages = [*(f"PDAL says: {line}" for line in pipeline.log_lines), *pipeline.messages]
    counts = left_alone(report.figures for report in reports)
    return Written(target, count, classes, counts, messages, pipeline.metadata)
