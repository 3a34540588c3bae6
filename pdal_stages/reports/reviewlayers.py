"""Styles for QGIS of the layers that ``review`` writes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

#: Fill of patches, from those with least to expect to those with most.
_INKS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
_LOOKED_AT = "120,170,120,90"


def _symbol(number: int, color: str, edge: str = "80,40,20,255", width: str = "0.3") -> str:
    return (
        f'<symbol type="fill" name="{number}" alpha="1"><layer class="SimpleFill" enabled="1" pass="0">'
        f'<Option type="Map"><Option type="QString" name="color" value="{color}"/>'
        f'<Option type="QString" name="outline_color" value="{edge}"/>'
        f'<Option type="QString" name="outline_width" value="{width}"/></Option></layer></symbol>'
    )


def _style(renderer: str) -> str:
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        f'<qgis version="3.22" styleCategories="Symbology">{renderer}</qgis>\n'
    )


def patch_style(errors: NDArray[np.float64]) -> str:
    """Patches by the points expected wrong, in four steps; green where ``done`` is 1."""
    positive = errors[errors > 0]
    steps = np.quantile(positive, [0.5, 0.8, 0.95]) if len(positive) else np.array([1.0, 2.0, 3.0])
    bounds = [f"{value:.0f}" for value in steps]
    rules = [f"expected &lt; {bounds[0]}"]
    rules += [f"expected >= {a} and expected &lt; {b}" for a, b in pairwise(bounds)]
    rules += [f"expected >= {bounds[-1]}"]
    labels = [
        f"below {bounds[0]} points expected wrong",
        f"{bounds[0]} to {bounds[1]}",
        f"{bounds[1]} to {bounds[2]}",
        f"{bounds[2]} and more",
    ]
    listed = "".join(
        f'<rule key="{{{n}}}" symbol="{n}" label="{label}" filter="done = 0 and ({rule})"/>'
        for n, (label, rule) in enumerate(zip(labels, rules, strict=True))
    )
    done = len(labels)
    listed += f'<rule key="{{{done}}}" symbol="{done}" label="looked at" filter="done = 1"/>'
    symbols = "".join(_symbol(n, ink) for n, ink in enumerate((*_INKS, _LOOKED_AT)))
    return _style(
        f'<renderer-v2 type="RuleRenderer"><rules key="{{root}}">{listed}</rules><symbols>{symbols}</symbols></renderer-v2>'
    )


def tile_style() -> str:
    """Outlines of tiles."""
    return _style(
        '<renderer-v2 type="singleSymbol"><symbols>'
        + _symbol(0, "0,0,0,0", "60,60,60,255", "0.5")
        + "</symbols></renderer-v2>"
    )
