"""``pdal-stages doctor``: what is installed, and how to get what is missing."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from ..base.errors import PipelineError, StageError, how_to_add
from ..base.memory import free_memory
from ..base.threads import available_threads
from ..base.version import __version__
from ..classifier.model import loaded_model
from ..classifier.model_file import STANDARD
from ..pipeline import pdal as pdal_env
from ..pipeline import runtime
from ..pipeline.pdal_errors import translate
from . import install

#: Extra -> the package that it installs, and its purpose.
_EXTRAS = {
    "dask": ("distributed", "tiles on several hosts"),
    "deep": ("torch", "the neural network"),
    "raster": ("rasterio", "terrain and surface as rasters"),
    "vector": ("pyogrio", "objects as vector files, and polygons of a map"),
}
#: Bytes of free memory that a job needs besides the cloud; less is reported.
_LITTLE_MEMORY = 2 * 2**30
_PACKAGE = Path(__file__).resolve().parents[1]
#: Of ``filters.python``.
_SCRIPT = """
def stage(ins, outs):
    import sys
    try:
        import pdal_stages
        found = pdal_stages.__file__
    except Exception as error:  # raised, it would end the process
        found = f"{type(error).__name__}: {error}"
    with open(pdalargs["answer"], "w") as file:
        file.write(sys.prefix + "\\n" + found)
    return True
"""


@dataclass(frozen=True)
class Finding:
    """One line of the result."""

    what: str
    result: str
    cure: str = ""  #: empty where all is well
    needed: bool = True  #: whether jobs fail without it

    def __str__(self) -> str:
        """Return the line, with the cure below it."""
        if not self.cure:
            return f"ok      {self.what}: {self.result}"
        mark = "MISSING" if self.needed else "no"
        return f"{mark:8}{self.what}: {self.result}\n        -> {self.cure}"


def examine() -> Iterator[Finding]:
    """Yield all findings; each check is independent, so that one fault does not hide the next."""
    for look in (_package, _bindings, _program, _plugin, _machine, _extras):
        try:
            yield from look()
        except StageError as error:
            details = " ".join(str(error.found or "").split())
            yield Finding(error.what, details, error.cure or "See docs/install.md")


def _package() -> Iterator[Finding]:
    python = f"Python {sys.version.split()[0]} of {sys.prefix}"
    yield Finding("pdal_stages", f"{__version__} in {_PACKAGE}, {python}")
    try:
        loaded_model(STANDARD)
        yield Finding("shipped model", STANDARD)
    except StageError as error:
        yield Finding("shipped model", str(error), "Install pdal-stages again")


def _bindings() -> Iterator[Finding]:
    module = pdal_env.bindings()
    yield Finding("PDAL", f"{pdal_env.dotted_version()}, python-pdal {module.__version__}")
    yield _python_of(
        "filters.python in this process", lambda stages: pdal_env.execute(stages, arrays=False)
    )


def _program() -> Iterator[Finding]:
    yield _python_of(f"filters.python in {pdal_env.program()}", _run_program)


def _run_program(stages: list) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "job.json")
        path.write_text(json.dumps(stages))
        try:
            pdal_env.ask_program("pipeline", str(path))
        except PipelineError as error:
            raise translate(str(error.found)) from None


def _python_of(what: str, run: Callable[[list], object]) -> Finding:
    """Return which Python PDAL runs, and whether it has our package."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, "answer")
        name = "pdal_stages_doctor"
        run([pdal_env.ONE_POINT, runtime.python_filter(name, _SCRIPT, {"answer": str(answer)}, {})])
        if not answer.is_file():
            cure = "Install pdal-plugins again, for this PDAL and this Python"
            return Finding(what, "the script did not run", cure)
        prefix, package = answer.read_text().splitlines()[:2]
    python = f"Python of {prefix}"
    if not os.path.isabs(package):
        cure = f"{prefix}/bin/python -m pip install pdal-stages"
        return Finding(what, f"{python}; {package}", cure)
    if Path(package).resolve().parent != _PACKAGE:
        other = f"{python}, which has another pdal_stages: {package}"
        return Finding(what, other, "Keep one of them, or one version")
    return Finding(what, python)


def _plugin() -> Iterator[Finding]:
    good, bad = install.check()
    what = "native stages (pdal pipeline knows our names)"
    cure = "pdal-stages plugin --install; pdal-stages itself does not need it" if bad else ""
    yield Finding(what, bad[-1].split(". ")[0] if bad else good[-1], cure, needed=False)


def _machine() -> Iterator[Finding]:
    free = free_memory()
    cure = "" if free >= _LITTLE_MEMORY else "Work in tiles (--tile), or close other programs"
    described = f"{available_threads()} cores, {free / 2**30:.1f} GB of free memory"
    yield Finding("machine", described, cure, needed=False)


def _extras() -> Iterator[Finding]:
    for extra, (package, purpose) in _EXTRAS.items():
        try:
            yield Finding(f"extra {extra}", f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            cure = f"{how_to_add(extra)}, for {purpose}"
            yield Finding(f"extra {extra}", f"no {package}", cure, needed=False)
