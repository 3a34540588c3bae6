"""A generated town under a simulated flight, with true labels: data for tests, demos and benchmarks."""

from .town import Town, TownOptions, make_town, write_town

__all__ = ["Town", "TownOptions", "make_town", "write_town"]
