"""Deliverables of a classified survey: terrain, surface and canopy as rasters, and its report.

Extra ``raster``: rasterio writes the rasters, startinpy triangulates the ground.
"""

from .cells import SurfaceOptions
from .make_surfaces import write_surfaces
from .survey_report import write_report

__all__ = ["SurfaceOptions", "write_report", "write_surfaces"]
