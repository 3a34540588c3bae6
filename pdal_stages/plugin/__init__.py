"""Our stages as PDAL's own, for all that runs PDAL: what the C++ of ``native/`` is compiled from, and what it calls."""
