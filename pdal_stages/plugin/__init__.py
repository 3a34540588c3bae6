"""Our stages as PDAL's own, for all that runs PDAL: what ``stage.cpp`` is compiled with, and what it calls."""
