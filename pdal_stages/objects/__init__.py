"""Buildings, trees, wires and bridge decks as objects: the same ids and outlines in tiles as in one piece.

Everything is derived from records of cells of an absolute grid (:mod:`.cells`), in which only whole numbers are counted,
added and compared. They do not depend on the order of points, nor on how these are spread over files and tiles.
"""
