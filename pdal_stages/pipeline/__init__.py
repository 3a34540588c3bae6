"""Pipelines: read, override, lower to plain PDAL, run, and describe what there is."""

from .run import Pipeline, run_pipeline

__all__ = ["Pipeline", "run_pipeline"]
