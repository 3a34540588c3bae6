"""Stages as native PDAL plugins: ``stage.cpp``, its compilation, and the Python that it calls."""
