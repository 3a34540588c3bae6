"""Pictures of point clouds with nothing but NumPy and zlib: for reports, READMEs and a quick look."""

from .png import write_png
from .text import draw_text, text_size
from .views import error_view, height_view, legend, present_classes, ramp, section_view, top_view, triptych

__all__ = [
    "draw_text",
    "error_view",
    "height_view",
    "legend",
    "present_classes",
    "ramp",
    "section_view",
    "text_size",
    "top_view",
    "triptych",
    "write_png",
]
