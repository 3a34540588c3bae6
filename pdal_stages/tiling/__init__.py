"""Pipelines over inputs of any number and size: tiles with a halo, run on Dask, written seamlessly."""

from .settings import TilingOptions
from .tiledrun import TiledRun, run_tiled

__all__ = ["TiledRun", "TilingOptions", "run_tiled"]
