"""Pipelines over inputs of any number and size: tiles with a halo, on one host or many, written seamlessly."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .report import TiledRun
    from .run import run_tiled
    from .settings import TilingOptions

__all__ = ["TiledRun", "TilingOptions", "run_tiled"]
_WHERE = {"TiledRun": "report", "TilingOptions": "settings", "run_tiled": "run"}


def __getattr__(name: str):
    """What was asked for alone: ``objects`` runs no tiles."""
    if name not in _WHERE:
        raise AttributeError(f"module '{__name__}' has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_WHERE[name]}", __name__), name)
    globals()[name] = value
    return value
