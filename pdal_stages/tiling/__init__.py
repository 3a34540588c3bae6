"""Pipelines over inputs of any number and size: tiles with a halo, on one host or many, written seamlessly."""

from .outcome import TiledRun
from .settings import TilingOptions
from .tiledrun import run_tiled

__all__ = ["TiledRun", "TilingOptions", "run_tiled"]
