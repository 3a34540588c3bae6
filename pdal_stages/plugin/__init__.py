"""Our stages as native PDAL plugins: the build of ``stage.cpp``, and the Python code that it
calls.
"""
