"""The errors of the package: what is wrong, where, what was found, and how to fix it."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import ModuleType


class StageError(Exception):
    """An error a user can act on.

    Parameters
    ----------
    what : str
        What is wrong, as one clause.
    where : str, optional
        The stage type and tag, the file, or the option.
    found : object, optional
        The value that was found; of an OSError, the system's message.
    cure : str, optional
        What to do about it.
    """

    def __init__(
        self, what: str, *, where: str | None = None, found: object = None, cure: str | None = None
    ) -> None:
        self.what = what
        self.where = where
        self.found = (found.strerror or str(found)) if isinstance(found, OSError) else found
        self.cure = cure
        super().__init__(what)

    def __str__(self) -> str:
        """Return place, problem, found value and cure as sentences."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        if self.found is not None:
            text += f" (found {self.found})"
        text = _sentence(text) + (f" {_sentence(self.cure)}" if self.cure else "")
        # Names of files and dimensions may hold line breaks, and must not pass for lines.
        return text.replace("\n", "\\n").replace("\r", "\\r")

    def at(self, where: str) -> StageError:
        """Name the place of the error unless it already has one; return the error."""
        if self.where is None:
            self.where = where
        return self

    def prefixed(self, place: str) -> StageError:
        """Put a place before the one that the error has; return the error."""
        self.where = f"{place}: {self.where}" if self.where else place
        return self

    def __reduce__(self):
        """Keep the keyword arguments across process borders (Dask)."""
        more = {"where": self.where, "found": self.found, "cure": self.cure}
        return partial(type(self), self.what, **more), ()


def _sentence(text: str) -> str:
    text = text.strip()
    return text if text.endswith((".", "?", "!")) else f"{text}."


class WriteError(StageError):
    """A file cannot be written."""


class OptionError(StageError):
    """A stage option is unknown, of the wrong type, out of range or contradictory."""


class DimensionError(StageError):
    """A dimension that is needed is missing, or one that is created cannot be."""


class ModelError(StageError):
    """A model file cannot be read, is damaged, or does not fit the cloud."""


class PipelineError(StageError):
    """A pipeline cannot be parsed, validated, expanded or run."""


class InterruptedStage(StageError):
    """Ctrl-C came while a stage ran inside PDAL; the runners make it a KeyboardInterrupt again."""


class NoTerrainError(StageError):
    """None of the points can be terrain; with more points around them, some may be."""


class DependencyError(StageError):
    """An optional program or package is missing."""


def suggest(word: str, known: Iterable[str]) -> str:
    """Return ``Did you mean 'x'? `` for the nearest known word, or an empty string."""
    near = difflib.get_close_matches(str(word), list(known), n=1, cutoff=0.6)
    return f"Did you mean '{near[0]}'? " if near else ""


def how_to_add(extra: str) -> str:
    """Return the command that installs one of our extras."""
    root = Path(__file__).resolve().parents[2]
    if Path(sys.prefix) == root / ".venv" and (root / "scripts" / "setup").is_file():
        return f"{root}/scripts/setup {extra}"
    return f"pip install 'pdal-stages[{extra}]' (from a clone: pip install '.[{extra}]')"


def optional_import(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional package, or raise a DependencyError that names our extra with it."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise DependencyError(
            f"{purpose} needs the Python package '{module}'",
            found=str(error),
            cure=f"Install it with: {how_to_add(extra)}",
        ) from error
