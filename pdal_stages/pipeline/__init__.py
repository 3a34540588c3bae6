"""Pipelines: read, override, expand to plain PDAL, run."""
