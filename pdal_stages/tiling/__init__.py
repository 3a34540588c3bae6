"""Pipelines over inputs of any number and size: tiles with a halo, on one host or many, written seamlessly."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .run import TiledRun, TilingOptions, run_tiled

__all__ = ["TiledRun", "TilingOptions", "run_tiled"]


def __getattr__(name: str):
    """What was asked for alone: ``objects`` runs no tiles."""
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute {name!r}")
    from . import run

    return getattr(run, name)
