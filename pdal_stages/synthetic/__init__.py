"""A generated town under a simulated flight, with true labels: data for tests, demos and benchmarks."""

from .town import Town, TownOptions, make_town, town_chunks
from .townfile import write_town

__all__ = ["Town", "TownOptions", "make_town", "town_chunks", "write_town"]
