"""What PDAL's errors mean, in our words and with a cure."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ..base.errors import DependencyError, PipelineError
from ..base.las_check import CURE_OF_DAMAGE

_DRIVER_CURE = (
    "filters.python comes with the package pdal-plugins. Install it for this Python (pip install "
    "pdal-plugins), and set PDAL_DRIVER_PATH to the folder that holds "
    "libpdal_plugin_filter_python"
)
_CUT_POINTS = re.compile(r"readers\.las: .*(reading point \d+ of \d+|[Cc]ouldn't read .*point)")
#: The command that reads and writes all files itself, without PDAL, for hints.
COPIES = "pdal-stages classify (LAS to LAS, an output for each input)"
FLAGS_IN_CLASSES = (
    "this PDAL reads the flags (synthetic, key-point, withheld) of LAS 1.0-1.3 as parts of the "
    "class, and would make other classes of them here"
)
FLAGS_CURE = (
    "Convert it first: laspy.convert(laspy.read(IN), point_format_id=6).write(OUT), 7 with colors; "
    "or keep it LAS 1.2 and apart from those of LAS 1.4; or use PDAL 2.6. pdal-stages classify "
    "needs none of this where it writes no other format"
)
BROKEN_REFERENCE = "the spatial reference in the file cannot be read"
REFERENCE_CURE = (
    "Name the right one, --readers.las.override_srs=EPSG:CODE "
    '(in a pipeline "override_srs" of the reader)'
)
NAME_CURE = "Give a code, EPSG:CODE or EPSG:CODE+CODE with that of the heights, or well-known text"


def translate(message: str, before: Sequence[str] = ()) -> PipelineError | DependencyError:
    """Return PDAL's error text as one of our errors, with a cure where the cause is known.

    `before` are the last lines of the log.
    """
    text = message.strip()
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # PDAL quotes names of files, which may hold line breaks.
    one_line = "; ".join([*lines, *before])
    if re.search(r"(create|load|find).*filters\.python", text) or (
        "filters.python" in text and "driver" in text.lower()
    ):
        return DependencyError("PDAL has no filters.python", found=one_line, cure=_DRIVER_CURE)
    if "ModuleNotFoundError" in text and "pdal_stages" in text:
        cure = "Install it into the Python that the plugin of filters.python was built for"
        what = "the Python that PDAL runs does not have pdal_stages"
        return DependencyError(what, found=lines[-1], cure=cure)
    if _CUT_POINTS.search(text):
        what = "the LAS file is damaged: its points cannot be decoded"
        return PipelineError(what, found=one_line, cure=CURE_OF_DAMAGE)
    if "convert spatial reference" in text:
        return PipelineError(BROKEN_REFERENCE, found=one_line, cure=REFERENCE_CURE)
    if "Could not import coordinate system" in text:
        what = "PDAL knows no reference system of this name"
        return PipelineError(what, found=one_line, cure=NAME_CURE)
    if "dimension with invalid name" in text:
        cure = f"Run it with {COPIES}, which takes names as they are"
        return PipelineError("PDAL refuses the name of a dimension", found=one_line, cure=cure)
    if "Traceback (most recent call last)" in text:  # of a script; a list in older PDAL
        lines = [line.strip(" '") for line in text.replace("\\n", "\n").splitlines()]
        place = [line for line in lines if line.startswith("File ")][-1:]
        last = [line for line in lines if line][-1]
        return PipelineError("a script of filters.python failed", found="; ".join([last, *place]))
    return PipelineError("PDAL could not run the pipeline", found=one_line)
