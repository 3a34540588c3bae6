"""A tiled run: find inputs, index them, run tiles, put outputs together, report."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import OptionError, PipelineError, StageError
from ..base.files import sweep
from ..base.progress import Progress
from ..base.units import units_of_wkt
from ..base.version import __version__
from ..pipeline import pdal as pdal_env
from ..pipeline.overrides import Override
from ..stages import registry
from .assemble import MOST_AT_ONCE
from .grid import Box, Grid, union
from .pool import Here, OnDask, open_pool
from .settings import TilingOptions
from .sources import Header, Source, check_source, find_sources, read_header
from .store import Store, fingerprint
from .tileplan import TilePlan, check_not_inputs, make_plan, outputs_for

#: Memory of a worker: programs and model, a tile's point, a file's point, and the `memory` option of our stages.
_BASE_MB, _TILE_BYTES, _FILE_BYTES, _BLOCKS_MB = 350, 350, 250, 512
#: Points a core does in a second, for the estimate of a dry run; the figure of the default features.
_RATE = 5_000

#: A run stops when so many tiles failed and none succeeded.
_HOPELESS = 10


@dataclass
class Job:
    """A tile to run.

    Attributes
    ----------
    tile : (int, int)
    name : str
    points : int
        The tile's own; 0 where not known before it is read.
    sources : list of Source
        Inputs that may hold points of it or its surroundings.
    mark : str
        Fingerprint of all that decides its result.
    state : str
        ``waiting``, ``done``, ``kept`` (from an earlier run) or ``failed``.
    report : dict
    reason : str
        Why it failed.
    blocked_by : str
        The unreadable input that it failed for, where that is the reason.
    """

    tile: tuple[int, int]
    name: str
    points: int
    sources: list[Source]
    mark: str = ""
    state: str = "waiting"
    report: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    blocked_by: str = ""
    tries: int = 0


@dataclass
class Output:
    """An input file whose output is put together from tiles."""

    source: Source
    paths: list[Path]
    jobs: list[Job] = field(default_factory=list)
    mark: str = ""
    state: str = "waiting"
    report: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    blocked_by: str = ""
    tries: int = 0


@dataclass
class TiledRun:
    """What a tiled run did.

    Attributes
    ----------
    tiles : list of Job
    outputs : list of Output
        Empty where each tile is an output.
    unreadable : dict of str to str
        Inputs that could not be read, and why.
    notes : list of str
        What the user should know.
    summary : dict
        Figures for people; see :meth:`to_dict`.
    """

    tiles: list[Job]
    outputs: list[Output]
    unreadable: dict[str, str]
    notes: list[str]
    summary: dict[str, Any]

    @property
    def failures(self) -> list[tuple[str, str]]:
        """What failed, and why: inputs with all that waits for them, then other tiles and outputs."""
        found = [
            (path, reason.removeprefix(f"{path}: ") + self._blocked_by(path))
            for path, reason in self.unreadable.items()
        ]
        found += [
            (f"tile {t.name}", t.reason) for t in self.tiles if t.state == "failed" and not t.blocked_by
        ]
        return found + [
            (str(o.paths[0]), o.reason) for o in self.outputs if o.state == "failed" and not o.blocked_by
        ]

    def _blocked_by(self, path: str) -> str:
        """What was not made because an input cannot be read, in words."""
        tiles = sum(job.blocked_by == path for job in self.tiles)
        outputs = [out.paths[0].name for out in self.outputs if out.blocked_by == path]
        parts = [f"{tiles} tile{'s' * (tiles != 1)} there"] if tiles else []
        parts += [*outputs[:5], *([f"{len(outputs) - 5} more outputs"] if len(outputs) > 5 else [])]
        return f" (not made because of it: {', '.join(parts)})" if parts else ""

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able report."""
        return {
            "pdal_stages": __version__,
            **self.summary,
            "notes": self.notes,
            "failures": [{"what": what, "reason": reason} for what, reason in self.failures],
            "tiles": [
                {"name": j.name, "tile": list(j.tile), "state": j.state, "tries": j.tries, "points": j.points}
                | {k: v for k, v in j.report.items() if k not in ("fingerprint",)}
                | ({"reason": j.reason} if j.reason else {})
                for j in self.tiles
            ],
            "outputs": [
                {"input": o.source.path, "output": [str(p) for p in o.paths], "state": o.state}
                | ({"reason": o.reason} if o.reason else {})
                | {k: o.report[k] for k in ("written", "seconds", "cpu_seconds", "peak_mb") if k in o.report}
                for o in self.outputs
            ],
        }


def run_tiled(
    source: str | Path | list | dict,
    tile: float | TilingOptions,
    overrides: Iterable[Override] = (),
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    **options: Any,
) -> TiledRun:
    """Run a pipeline in tiles.

    Parameters
    ----------
    source : str, Path, list or dict
        As for :class:`pdal_stages.Pipeline`.
    tile : float or TilingOptions
        Side of the tiles, in the unit of the coordinates; or all options.
    overrides : iterable of Override
    dry_run : bool
        Only find the tiles; nothing is read but headers, nothing written.
    progress : bool, optional
        Whether to show progress on stderr.
    **options
        The other fields of :class:`TilingOptions`.

    Returns
    -------
    TiledRun
        With the failures of tiles, which do not raise: look at :attr:`TiledRun.failures`.

    Raises
    ------
    StageError
        For what is wrong before any tile, or with every tile.

    Examples
    --------
    >>> from pdal_stages.tiling import run_tiled
    >>> run = run_tiled("classify.json", 500, workers=2)             # doctest: +SKIP
    >>> run.failures                                                 # doctest: +SKIP
    []
    """
    chosen = tile if isinstance(tile, TilingOptions) else TilingOptions(tile, **options)
    plan = make_plan(source, overrides, chosen)
    return _Run(plan, chosen, progress).go(dry_run)


class _Run:
    def __init__(self, plan: TilePlan, options: TilingOptions, progress: bool | None) -> None:
        self.plan, self.options, self.show = plan, options, progress
        self.grid = Grid(options.tile)
        self.started = time.monotonic()
        self.date = time.strftime("%Y-%m-%d %H:%M")
        self.notes = list(plan.notes)
        self.unreadable: dict[str, str] = {}
        self.sources = find_sources(plan.readers)
        if any("t_srs" in reader for reader in plan.readers):
            self.notes.append(
                "readers.tindex: in tiles points keep the reference of their file, t_srs is left out"
            )
        self.headers = self._headers()
        self.per = self._per()
        self.unit = self._unit()
        self.extra = float(options.buffer or 0.0)
        self.halo = plan.halo
        self.index: dict[str, dict[str, Any]] = {}
        self._place_sources()

    # ---- before any work ----------------------------------------------------------------------------

    def _headers(self) -> dict[str, Header]:
        found = {}
        for source in self.sources:
            try:
                found[source.path] = read_header(source)
                check_source(source)
            except StageError as error:
                self.unreadable[source.path] = str(error)
        if len(self.unreadable) == len(self.sources):
            raise self._none_readable()
        lost = len(self.sources) - len(found)
        if lost:
            which = "1 input has" if lost == 1 else f"{lost} inputs have"
            self.notes.append(
                f"{which} no readable header, so its place is not known: tiles beside it may lack neighbors. Once "
                "it can be read, --resume runs those tiles again"
            )
        return found

    def _none_readable(self) -> StageError:
        return StageError(
            "none of the inputs can be read", found=next(iter(self.unreadable.values()), "no input")
        )

    def _per(self) -> str:
        files = all(s.kind == "las" for s in self.sources)
        if self.options.per == "file" and not files:
            raise OptionError("--per file needs LAS or LAZ inputs", cure="Use --per tile")
        return ("file" if files else "tile") if self.options.per == "auto" else self.options.per

    def _unit(self) -> float:
        """Metres per unit of the coordinates, as the first input says that PDAL can read."""
        for first in (s for s in self.sources if s.path not in self.unreadable):
            try:
                metadata = self._metadata(first)
                break
            except PipelineError as error:
                self.unreadable[first.path] = str(error)
        else:
            raise self._none_readable()
        node = metadata.get(first.reader["type"], {})
        srs = (node[0] if isinstance(node, list) else node).get("srs", {})
        wkt = str(srs.get("compoundwkt") or srs.get("wkt") or "")
        needed = bool(self.plan.head)
        try:
            return units_of_wkt(wkt, horizontal=self.plan.unit, vertical="").horizontal
        except StageError:
            if needed and self.plan.halo:
                raise
            return 1.0

    def _metadata(self, source: Source) -> dict[str, Any]:
        """What PDAL's reader says of an input, with as few points read as it can."""
        reader = {**source.reader, "filename": source.path}
        if source.kind == "las":
            reader["count"] = 1
        else:
            x0, y0, _, _ = self.headers[source.path].box
            reader["bounds"] = f"([{x0!r}, {x0 + 1!r}], [{y0!r}, {y0 + 1!r}])"
        return pdal_env.execute([reader], arrays=False).metadata.get("metadata", {})

    def _place_sources(self) -> None:
        """Where readable headers or indexes say that inputs lie; thousands of them are compared at once."""
        self._placed = [s for s in self.sources if s.path in self.headers and self.headers[s.path].count]
        boxes = []
        for source in self._placed:
            index = self.index.get(source.path)
            known = union([(b[0], b[1], b[2], b[3]) for b in index["boxes"]]) if index else None
            boxes.append(known or self.headers[source.path].box)
        self._boxes = np.array(boxes, np.float64).reshape(-1, 4)
        self.bounds = union(boxes)

    def _near(self, box: Box, margin: float) -> list[Source]:
        b = self._boxes
        hits = (b[:, 0] <= box[2] + margin) & (b[:, 2] >= box[0] - margin)
        hits &= (b[:, 1] <= box[3] + margin) & (b[:, 3] >= box[1] - margin)
        return [self._placed[n] for n in np.flatnonzero(hits)]

    # ---- the run ------------------------------------------------------------------------------------

    def go(self, dry_run: bool) -> TiledRun:
        if dry_run:
            return self._dry()
        folder = self._folder()
        with Store(folder) as store:
            if not self.options.resume:
                store.clear()
            self._all_paths()
            try:
                with open_pool(self.options) as pool:
                    return self._work(store, pool)
            finally:
                sweep(folder)  # what workers left that were killed

    def _folder(self) -> Path:
        writers = self.plan.writers
        folder = Path(writers[0]["filename"]).absolute().parent
        if not folder.is_dir():
            raise StageError(
                "the folder of the output does not exist", found=str(folder), cure="Create it first"
            )
        return folder

    def _all_paths(self) -> list[Path]:
        if self.per == "tile":
            return []
        named = outputs_for(self.plan, [s.stem for s in self.sources])
        paths = [p for column in named for p in column]
        check_not_inputs(paths, [s.path for s in self.sources])
        return paths

    def _work(self, store: Store, pool: Here | OnDask) -> TiledRun:
        self._index_all(store, pool)
        jobs = self._jobs()
        outputs = self._outputs(jobs)
        if self.per == "tile":
            self._tile_outputs(jobs)
        self._skip(store, jobs, outputs)
        self._run_jobs(store, pool, jobs, outputs)
        self._clean(store, jobs, outputs)
        return self._result(jobs, outputs, pool)

    def _index_all(self, store: Store, pool: Here | OnDask) -> None:
        waiting: deque[tuple[Source, str]] = deque()
        for source in self.sources:
            if source.kind != "las" or source.path in self.unreadable:
                continue
            mark = fingerprint(source.path, source.stamp(), self.grid.size)
            known = store.index(mark)
            if known is not None:
                self.index[source.path] = known
            else:
                waiting.append((source, mark))
        total = sum(self.headers[s.path].count for s, _ in waiting)
        tries: dict[str, int] = {}

        def tasks():
            if not waiting:
                return None
            source, mark = waiting.popleft()
            task = {"kind": "index", "path": source.path, "size": self.grid.size}
            return (source, mark), json.dumps(task)

        with Progress(total, "reading the inputs", enabled=self._shown()) as progress:
            for (source, mark), answer in pool.run(tasks, lambda: bool(waiting)):
                reason, again = _failure(answer)
                if reason:
                    tries[source.path] = tries.get(source.path, 0) + 1
                    if again and tries[source.path] <= self.options.retries:
                        waiting.append((source, mark))
                    else:
                        self.unreadable[source.path] = reason
                    continue
                found = json.loads(answer)
                self.index[source.path] = found
                store.keep_index(mark, found)
                progress.update(found["count"])
        self._place_sources()

    def _jobs(self) -> list[Job]:
        """Tiles with points of their own, row by row."""
        counts: dict[tuple[int, int], int] = {}
        for source in self.sources:
            if source.path not in self.headers:
                continue
            if source.path in self.index:
                for i, j, n in self.index[source.path]["tiles"]:
                    counts[i, j] = counts.get((i, j), 0) + n
            elif self.headers[source.path].count:
                for tile in self.grid.covering(self.headers[source.path].box):
                    counts.setdefault(tile, 0)
        jobs = []
        margin = self.halo / self.unit
        for tile in sorted(counts, key=lambda t: (t[1], t[0])):
            near = self._near(self.grid.box(tile), margin)
            job = Job(tile, self.grid.name(tile), counts[tile], near)
            bad = [s.path for s in near if s.path in self.unreadable]
            if bad:
                job.state, job.blocked_by = "failed", bad[0]
                job.reason = f"an input here cannot be read: {bad[0]}"
            jobs.append(job)
        for job in jobs:
            job.mark = fingerprint(
                __version__,
                self.plan.head,
                self._files_of(self.plan.head),
                self.plan.creates,
                self.halo,
                self.grid.size,
                job.tile,
                [[s.path, s.stamp(), s.reader] for s in job.sources],
                [self.plan.tail, self._files_of(self.plan.tail)] if self.per == "tile" else "",
            )
        return jobs

    def _files_of(self, stages: list[dict[str, Any]]) -> list[Any]:
        """Size and time of change of files that stages read, e.g. models."""
        found = []
        for stage in stages:
            kind = registry.stages().get(stage["type"])
            for name, value in stage.items():
                if isinstance(value, str) and kind is not None and Path(value).is_file():
                    stat = Path(value).stat()
                    found.append([name, stat.st_size, stat.st_mtime_ns])
        return found

    def _outputs(self, jobs: list[Job]) -> list[Output]:
        if self.per == "tile":
            return []
        named = outputs_for(self.plan, [s.stem for s in self.sources])
        check_not_inputs([p for column in named for p in column], [s.path for s in self.sources])
        by_tile = {job.tile: job for job in jobs}
        outputs = []
        for number, source in enumerate(self.sources):
            out = Output(source, [column[number] for column in named])
            if source.path in self.index:
                out.jobs = [by_tile[i, j] for i, j, _ in self.index[source.path]["tiles"]]
            if source.path in self.unreadable:
                out.state, out.blocked_by = "failed", source.path
                out.reason = f"its input cannot be read: {source.path}"
            out.mark = fingerprint(
                source.path,
                source.stamp(),
                source.reader,
                self.plan.tail,
                self._files_of(self.plan.tail),
                [job.mark for job in out.jobs],
            )
            outputs.append(out)
        return outputs

    def _tile_outputs(self, jobs: list[Job]) -> None:
        named = outputs_for(self.plan, [job.name for job in jobs])
        check_not_inputs([p for column in named for p in column], [s.path for s in self.sources])
        self.tile_paths = {job.tile: [str(column[n]) for column in named] for n, job in enumerate(jobs)}

    def _skip(self, store: Store, jobs: list[Job], outputs: list[Output]) -> None:
        """Take over what an earlier run finished."""
        if not self.options.resume:
            return
        if self.per == "tile":
            for job in jobs:
                if job.state == "waiting" and (known := store.written(job.name, job.mark)) is not None:
                    job.state, job.report = "kept", known
            return
        for out in outputs:
            if out.state == "waiting" and (known := store.written(out.source.key, out.mark)) is not None:
                out.state, out.report = "kept", known
        needed = {job.tile for out in outputs if out.state == "waiting" for job in out.jobs}
        for job in jobs:
            if job.state != "waiting":
                continue
            known = store.finished(job.name, job.mark)
            if known is not None and (job.tile not in needed or store.result(job.name).exists()):
                job.state, job.report = "kept", known
            elif job.tile not in needed:
                job.state = "kept"

    def _run_jobs(self, store: Store, pool: Here | OnDask, jobs: list[Job], outputs: list[Output]) -> None:
        waiting: deque[Any] = deque(job for job in jobs if job.state == "waiting")
        total = sum(job.points for job in waiting)
        good = sum(job.state == "kept" for job in jobs)
        by_job: dict[tuple[int, int], list[Output]] = {}
        for out in outputs:
            for job in out.jobs:
                by_job.setdefault(job.tile, []).append(out)
        for out in outputs:
            self._ready(out, waiting)
        done, tried = good, 0
        reasons: set[str] = set()

        def tasks():
            if not waiting:
                return None
            item = waiting.popleft()
            return item, json.dumps(self._task(store, pool, item))

        with Progress(total, self._label(done, len(jobs)), enabled=self._shown()) as progress:
            for item, answer in pool.run(tasks, lambda: bool(waiting)):
                item.tries += 1
                reason, again = _failure(answer)
                if reason and again and item.tries <= self.options.retries:
                    waiting.append(item)
                    continue
                if reason:
                    item.state, item.reason = "failed", reason
                else:
                    item.state, item.report = "done", json.loads(answer)
                if isinstance(item, Job):
                    done += 1
                    progress.label = self._label(done, len(jobs))
                    progress.update(item.report.get("points", item.points) if not reason else item.points)
                    if not reason:
                        good += 1
                        if self.per == "tile":
                            store.wrote(item.name, item.mark, item.report)
                    for out in by_job.get(item.tile, ()):
                        self._ready(out, waiting)
                    reasons |= {reason} if reason else set()
                    tried += 1
                    if not good and tried >= _HOPELESS and len(reasons) == 1:
                        raise StageError(
                            f"the first {tried} tiles all failed for one reason, so the run was stopped",
                            found=reason,
                        )
                elif not reason:
                    store.wrote(item.source.key, item.mark, item.report)

    def _ready(self, out: Output, waiting: deque) -> None:
        """Put an output to work when the last of its tiles is there."""
        if out.state != "waiting" or any(job.state == "waiting" for job in out.jobs):
            return
        failed = [job for job in out.jobs if job.state == "failed"]
        if failed:
            others = f", and {len(failed) - 1} more of its tiles" if len(failed) > 1 else ""
            out.state, out.reason = "failed", f"tile {failed[0].name} failed{others}"
            if all(job.blocked_by for job in failed):
                out.blocked_by = failed[0].blocked_by
        else:
            out.state = "ready"
            waiting.appendleft(out)

    def _task(self, store: Store, pool: Here | OnDask, item: Job | Output) -> dict[str, Any]:
        if isinstance(item, Output):
            return {
                "kind": "file",
                "source": {**item.source.to_dict(), "key": item.source.key},
                "count": self.index[item.source.path]["count"],
                "scratch": str(store.scratch),
                "results": [str(store.result(job.name)) for job in item.jobs],
                "tail": self.plan.tail,
                "outputs": [str(p) for p in item.paths],
            }
        margin = self.halo / self.unit
        # Farther inputs too: a tile may have to be read with wider surroundings.
        far = self._near(self.grid.box(item.tile), max(4 * margin, margin + self.grid.size))
        task: dict[str, Any] = {
            "kind": "tile",
            "tile": list(item.tile),
            "size": self.grid.size,
            "unit": self.unit,
            "buffer": self.halo,
            "bounds": list(self.bounds),
            "sources": [self._described(s) for s in far if s.path not in self.unreadable],
            "head": self.plan.head,
            "extra": self.extra,
            "creates": self.plan.creates,
            "threads": pool.threads,
            "scratch": str(store.scratch),
            "most_points": self.options.most_points,
            "fingerprint": item.mark,
        }
        if self.per == "file":
            task.update({"result": str(store.result(item.name)), "done": str(store.done(item.name))})
        else:
            task.update({"tail": self.plan.tail, "outputs": self.tile_paths[item.tile]})
        return task

    def _described(self, source: Source) -> dict[str, Any]:
        index = self.index.get(source.path)
        short = {"count": index["count"], "boxes": index["boxes"]} if index else None
        return {**source.to_dict(), "key": source.key, "index": short}

    def _clean(self, store: Store, jobs: list[Job], outputs: list[Output]) -> None:
        """Results whose outputs are all written are not needed any more."""
        needed = {job.tile for out in outputs if out.state == "failed" for job in out.jobs}
        for job in jobs:
            if job.tile not in needed:
                store.result(job.name).unlink(missing_ok=True)

    # ---- telling ------------------------------------------------------------------------------------

    def _shown(self) -> bool | None:
        return self.show

    def _what(self) -> dict[str, Any]:
        """The pipeline, its models and the date, for the report."""
        models = [str(stage["model"]) for stage in self.plan.head if "model" in stage]
        return {"pipeline": self.plan.name, "models": models, "started": self.date}

    @staticmethod
    def _label(done: int, total: int) -> str:
        return f"{done} of {total} tiles"

    def _result(self, jobs: list[Job], outputs: list[Output], pool: Here | OnDask) -> TiledRun:
        seconds = time.monotonic() - self.started
        worked = [job for job in jobs if job.state == "done"]
        classes: dict[str, int] = {}
        for job in jobs:
            for code, count in (job.report.get("classes") or {}).items():
                classes[code] = classes.get(code, 0) + count
        short = [job.name for job in worked if job.report.get("short")]
        if short:
            self.notes.append(
                f"{len(short)} tiles have points whose neighborhoods or terrain reach farther than could be read within "
                f"{self.options.most_points:,} points; they may differ from an untiled run: "
                + ", ".join(short[:5])
            )
        points = sum(job.report.get("points", 0) for job in worked)
        reports = [job.report for job in worked] + [out.report for out in outputs]
        peaks = [report.get("peak_mb", 0.0) for report in reports]
        summary = {
            **self._what(),
            "tile": self.grid.size,
            "buffer_metres": self.halo,
            "metres_per_unit": self.unit,
            "per": self.per,
            "workers": pool.slots,
            "threads_per_worker": pool.threads,
            "inputs": len(self.sources),
            "bounds": list(self.bounds) if math.isfinite(self.bounds[0]) else None,
            "points": points,
            "points_read": sum(job.report.get("read", 0) for job in worked),
            "dropped": sum(job.report.get("dropped", 0) for job in worked),
            "seconds": seconds,
            "points_per_second": points / seconds if seconds else 0.0,
            "cpu_seconds": sum(report.get("cpu_seconds", 0.0) for report in reports),
            "peak_mb_of_a_worker": max(peaks, default=0.0),
            "states": {s: sum(j.state == s for j in jobs) for s in ("done", "kept", "failed")},
            "classes": dict(sorted(classes.items(), key=lambda kv: int(kv[0]))),
        }
        return TiledRun(jobs, outputs, self.unreadable, self.notes, summary)

    def _dry(self) -> TiledRun:
        """Tiles and points as the headers tell."""
        self._all_paths()
        jobs: dict[tuple[int, int], Job] = {}
        for source in self.sources:
            header = self.headers.get(source.path)
            if header is None or not header.count:
                continue
            x0, y0, x1, y1 = header.box
            area = max(x1 - x0, 1e-9) * max(y1 - y0, 1e-9)
            for tile in self.grid.covering(header.box):
                a = self.grid.box(tile)
                wide = max(min(a[2], x1) - max(a[0], x0), 0.0) or (x1 == x0)
                high = max(min(a[3], y1) - max(a[1], y0), 0.0) or (y1 == y0)
                job = jobs.setdefault(tile, Job(tile, self.grid.name(tile), 0, []))
                job.points += round(header.count * min(1.0, wide * high / area))
                job.sources.append(source)
        listed = [jobs[t] for t in sorted(jobs, key=lambda t: (t[1], t[0]))]
        if self.per == "tile":
            outputs_for(self.plan, [j.name for j in listed])
        count = sum(h.count for h in self.headers.values())
        area = sum((h.box[2] - h.box[0]) * (h.box[3] - h.box[1]) for h in self.headers.values() if h.count)
        density = count / area if area else 0.0
        side = self.grid.size + 2 * self.halo / self.unit
        read = min(count, round(density * side * side))
        summary = {
            **self._what(),
            "tile": self.grid.size,
            "buffer_metres": self.halo,
            "metres_per_unit": self.unit,
            "per": self.per,
            "workers": self.options.local_workers,
            "threads_per_worker": self.options.threads,
            "inputs": len(self.sources),
            "bounds": list(self.bounds),
            "points": count,
            "points_of_largest_tile": max((j.points for j in listed), default=0),
            "points_read_by_a_tile": read,
            "memory_mb_of_a_worker": estimate_memory(
                read, count if self.per == "file" else 0, len(self.headers)
            ),
            "assumed_points_per_core_second": _RATE,
            "core_hours": count / _RATE / 3600,
            "states": {"waiting": len(listed)},
        }
        return TiledRun(listed, [], self.unreadable, self.notes, summary)


def estimate_memory(read: int, count: int, files: int) -> float:
    """Megabytes a worker holds at most: see docs/large-areas.md.

    Parameters
    ----------
    read : int
        Points of a tile with its surroundings.
    count, files : int
        Points of all inputs and their number, where each becomes one output; else 0.
    """
    at_once = min(count / max(files, 1), MOST_AT_ONCE)
    return _BASE_MB + max(read * _TILE_BYTES + _BLOCKS_MB * 2**20, at_once * _FILE_BYTES) / 2**20


def _failure(answer: Any) -> tuple[str, bool]:
    """The reason an answer tells of failure, and whether trying again can help."""
    if isinstance(answer, BaseException):
        name = type(answer).__name__
        if name == "KilledWorker":
            return (
                "it killed its worker each time it was tried: too little memory, or a crash in a library",
                False,
            )
        return f"{name}: {answer}", True
    error = json.loads(answer).get("error")
    return (error["reason"], bool(error["again"])) if error else ("", False)
