"""Basics of all rooms, which import nothing above them.

Errors, messages, checks and reports; whole files, LAS files, octrees and vector files; the grid of
cells, hashes, units and class codes; compiled kernels, threads, memory and progress; the version.
"""
