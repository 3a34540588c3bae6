"""Pipelines: read, override, expand to plain PDAL, run.

Names are imported when first used: the command line reads overrides before it needs NumPy or PDAL.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .run import Pipeline, run_pipeline

__all__ = ["Pipeline", "run_pipeline"]


def __getattr__(name: str):
    if name in __all__:
        from . import run

        return getattr(run, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
