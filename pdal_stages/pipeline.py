"""Run a pipeline: read, override, validate, lower, execute, report; outputs whole or not at all."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from . import pdal_env, runtime
from .errors import PipelineError, StageError
from .files import check_writable, partial_name
from .lowering import Lowered, lower
from .overrides import Override, apply_overrides
from .pipelinefile import PipelineSource, read_pipeline


class Pipeline:
    """A PDAL pipeline that may hold stages of ours.

    Parameters
    ----------
    source : str, Path, list or dict
        A file name, JSON text, or the stages themselves.
    overrides : iterable of Override, optional
        Options set from outside (see :mod:`pdal_stages.overrides`).

    Raises
    ------
    PipelineError, OptionError
        Everything about our stages that can be known before reading points.

    Examples
    --------
    >>> import pdal_stages as ps
    >>> pipeline = ps.Pipeline(["in.laz", {"type": "filters.hag_minima"}, "out.laz"])
    >>> pipeline.execute()                                          # doctest: +SKIP
    1065
    """

    def __init__(self, source: str | Path | list | dict, overrides: Iterable[Override] = ()) -> None:
        read = read_pipeline(source)
        self.source = PipelineSource(apply_overrides(read.stages, overrides), read.lines, read.name)
        self.lowered: Lowered = lower(self.source)
        self.metadata: dict[str, Any] = {}
        self.arrays: list = []
        self.log = ""
        self.reports: list[tuple[str, list[dict[str, Any]]]] = []

    @property
    def json(self) -> str:
        """The lowered pipeline, which stock ``pdal pipeline`` runs."""
        return json.dumps({"pipeline": self.lowered.stages}, indent=2)

    def validate(self) -> None:
        """Check outputs and let PDAL check its own stages' options, without reading points."""
        for stage in self.lowered.stages:
            if _is_writer(stage, self.lowered.stages):
                check_writable(stage["filename"])
        _validate_with_pdal(self.lowered.stages)

    def execute(self, *, arrays: bool = True) -> int:
        """Run the pipeline in this process; the number of points that came out.

        Files are written under a hidden name and renamed at the end, so an output is whole
        or absent, and an older one stays if the run fails.

        Raises
        ------
        StageError
            What went wrong, where, and the cure.
        """
        stages, renames = _partial_outputs(self.lowered.stages)
        for ours in self.lowered.ours:
            runtime.remember_stdout(ours.label)
        failure: StageError | None = None
        try:
            try:
                result = pdal_env.execute(stages, arrays=arrays)
            finally:
                self.reports = []
                for ours in self.lowered.ours:
                    reports, failed = runtime.collect(ours.label)
                    failure = failure or failed
                    self.reports.append((ours.place, reports))
            _rename(renames)
        except StageError as error:
            raise failure or error from None
        finally:
            _discard(renames)
        self.metadata = _named_metadata(result.metadata, self.reports)
        self.arrays, self.log = result.arrays, result.log
        return result.count


def run_pipeline(source: str | Path | list | dict, overrides: Iterable[Override] = ()) -> Pipeline:
    """Build, run and return a pipeline."""
    pipeline = Pipeline(source, overrides)
    pipeline.execute()
    return pipeline


def _is_writer(stage: dict[str, Any], stages: list[dict[str, Any]]) -> bool:
    if "filename" not in stage or not isinstance(stage["filename"], str):
        return False
    type_name = stage.get("type", "")
    if type_name:
        return type_name.startswith("writers.") and "://" not in stage["filename"]
    return len(stages) > 1 and stage is stages[-1]


def _partial_outputs(stages: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[tuple[Path, Path]]]:
    """Stages whose writers write beside the final name, and what to rename."""
    out, renames = [], []
    finals: set[Path] = set()
    for stage in stages:
        if _is_writer(stage, stages):
            final = Path(stage["filename"])
            check_writable(final)
            if final.absolute() in finals:
                raise PipelineError(
                    "two writers write the same file", found=str(final), cure="Give each its own name"
                )
            finals.add(final.absolute())
            partial = partial_name(final)
            stage = {**stage, "filename": str(partial)}
            renames.append((partial, final))
        out.append(stage)
    return out, renames


def _expanded(partial: Path) -> list[Path]:
    """Files a writer made; one name with '#' stands for several."""
    if "#" not in partial.name:
        return [partial] if partial.exists() else []
    pattern = glob.escape(str(partial)).replace("#", "*")
    return [
        Path(p) for p in sorted(glob.glob(pattern, include_hidden=True) if _HIDDEN else glob.glob(pattern))
    ]


_HIDDEN = "include_hidden" in (glob.glob.__kwdefaults__ or {})


def _rename(renames: list[tuple[Path, Path]]) -> None:
    for partial, final in renames:
        for path in _expanded(partial):
            if "#" in partial.name:
                before, _, after = partial.name.partition("#")
                number = path.name[len(before) : len(path.name) - len(after)]
                target = final.with_name(final.name.replace("#", number, 1))
            else:
                target = final
            os.replace(path, target)


def _discard(renames: list[tuple[Path, Path]]) -> None:
    for partial, _ in renames:
        for path in _expanded(partial):
            path.unlink(missing_ok=True)


def _validate_with_pdal(stages: list[dict[str, Any]]) -> None:
    import subprocess

    text = json.dumps({"pipeline": stages})
    done = subprocess.run(
        [pdal_env.program(), "pipeline", "--validate", "--stdin"],
        input=text,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    try:
        verdict = json.loads(done.stdout)
    except ValueError:
        verdict = {"valid": done.returncode == 0, "error_detail": (done.stderr or done.stdout).strip()}
    if not verdict.get("valid", False):
        raise pdal_env.translate(str(verdict.get("error_detail") or "the pipeline is not valid"))


def _named_metadata(
    metadata: dict[str, Any], reports: list[tuple[str, list[dict[str, Any]]]]
) -> dict[str, Any]:
    """PDAL's metadata, with our stages under their own names instead of filters.python."""
    inner = metadata.get("metadata")
    if not isinstance(inner, dict):
        return metadata
    theirs = inner.pop("filters.python", None)
    rest = [m for m in (theirs if isinstance(theirs, list) else [theirs]) if m and not _is_ours(m)]
    if rest:
        inner["filters.python"] = rest if len(rest) > 1 else rest[0]
    for name, views in reports:
        kind = name.partition(" ")[0]
        for report in views:
            if kind not in inner:
                inner[kind] = report
            else:
                before = inner[kind] if isinstance(inner[kind], list) else [inner[kind]]
                inner[kind] = [*before, report]
    return metadata


def _is_ours(node: Any) -> bool:
    from .stages.registry import stages

    return isinstance(node, dict) and any(name in stages() for name in node)
