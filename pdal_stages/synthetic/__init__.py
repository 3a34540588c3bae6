"""A generated town under a simulated flight, with true classes (an extra)."""

from .town import Town, make_town, write_town

__all__ = ["Town", "make_town", "write_town"]
