"""Basics of all rooms: errors, checks, files, LAS, the grid of cells, threads, messages, units."""
