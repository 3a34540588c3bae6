# pdal_stages for QGIS: classify airborne laser scans from the Processing toolbox.  This program is
# free software; you can redistribute it and/or modify it under the terms of the GNU General Public
# License as published by the Free Software Foundation; either version 2 of the License, or (at
# your option) any later version. The package pdal_stages itself, which runs in an environment of
# its own, is under the BSD 3-Clause license.
"""A Processing provider whose algorithms run the command ``pdal-stages`` in its own environment."""


def classFactory(iface):
    """QGIS's way in."""
    from .plugin import Plugin

    return Plugin()
