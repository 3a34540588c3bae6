"""Basics of all rooms, which import nothing above them.

Errors, messages and checks; whole files, LAS files with their octrees, vector files; the grid of
cells, hashes, units and class codes; compiled kernels, threads, memory and progress; the version.
"""
