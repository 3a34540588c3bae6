"""The option `extra_dims` of a writer of LAS: what the inputs have, and what stages made."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..base.las import extra_dimensions


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
