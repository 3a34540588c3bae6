"""Buildings, trees, wires and bridge decks as objects: the same ids and outlines in tiles as in one piece.

Everything is derived from records of cells of an absolute grid (:mod:`.cells`), in which only whole numbers are counted,
added and compared. They do not depend on the order of points, nor on how these are spread over files and tiles.
"""

import importlib

#: Public names and their modules, imported when first used.
_WHERE = {"Cells": "cells", "ObjectSettings": "found", "Objects": "found", "find_objects": "find"}


def __getattr__(name: str):
    if name in _WHERE:
        return getattr(importlib.import_module(f".{_WHERE[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
