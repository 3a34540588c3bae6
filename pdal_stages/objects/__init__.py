"""Buildings, trees, wires and bridge decks as objects: the same in tiles as in one piece.

Everything is derived from records of cells of an absolute grid (:mod:`.cells`), which hold whole
numbers only. So results do not depend on the order of points, nor on how these are spread over
files and tiles. An extra: `filters.objects`, `writers.objects` and the command `objects` use it.
"""
