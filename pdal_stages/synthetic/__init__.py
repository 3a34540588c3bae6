"""A generated town under a simulated flight, with true labels: data for tests, demos and benchmarks."""

from .command import main
from .las import write_town
from .town import Town, TownOptions, make_town, town_chunks

__all__ = ["Town", "TownOptions", "main", "make_town", "town_chunks", "write_town"]
