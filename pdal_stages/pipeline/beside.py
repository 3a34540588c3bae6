"""Which dimensions a writer writes: what the inputs have, and what stages made."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..base.errors import OptionError
from ..base.extrabytes import extra_dimensions
from . import pdal as pdal_env


def extra_dims_option(sources: Sequence[str], made: Mapping[str, str]) -> str:
    """The inputs' own extra dimensions and those `made` (name -> PDAL type); ``all`` where the own are not known."""
    own: dict[str, str] = {}
    for source in sources:
        if Path(source).suffix.lower() not in (".las", ".laz"):
            return "all"  # what other formats hold is not known here
        own |= extra_dimensions(source)
    if not all(re.fullmatch(r"[A-Za-z_]\w*", name) for name in own):
        return "all"
    return ",".join(f"{name}={kind}" for name, kind in {**own, **made}.items())


def dimensions_of(reader: Mapping[str, Any]) -> list[str]:
    """The dimensions that a reader gives, of which one point is read."""
    arrays = pdal_env.execute([{**reader, "count": 1}]).arrays
    return list(arrays[0].dtype.names or ()) if arrays else []


def only(writer: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """A writer of text or PLY that writes these dimensions and no others; other formats have none to choose.

    Raises
    ------
    OptionError
        If the format has dimensions, but no option to choose among them.
    """
    kind = writer.get("type") or pdal_env.writer_type(str(writer["filename"]))
    listed = ",".join(dict.fromkeys(names))
    if kind == "writers.text":
        return {**writer, "type": kind, "order": listed, "keep_unspecified": False}
    if kind == "writers.ply":
        return {**writer, "type": kind, "dims": listed}
    if kind in ("writers.gdal", "writers.ogr"):
        return writer
    raise OptionError(
        f"--dimensions is for LAS, LAZ, text and PLY; {kind or 'this format'} takes all there are",
        found=str(writer["filename"]),
        cure="Leave it out, or write a pipeline",
    )
